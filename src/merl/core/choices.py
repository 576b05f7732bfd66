"""The choices of a task: here, so that a config can name them without loading the simulator."""

from __future__ import annotations

from typing import Literal

HandStart = Literal["above", "around", "holding", "carrying"]
"""Where the hand starts: above the workspace, open around the box, closed around the box, or closed
around the box and somewhere on the way to the target."""
RewardForm = Literal["paper", "staged"]
"""Form of the reward, for tasks with a target.

- `paper`: Eqs. 4 and 5 with epsilon_pushing = epsilon_lifting = 0.05 as bound and margin.
- `staged`: the authors' later code. It adds a `success` term (N = 3 and 5). `floating` is steeper,
  and is 0 unless the object is off the floor.
"""
ProprioSet = Literal["paper", "full"]
"""Which numbers `proprio` holds."""
StateSet = Literal["absolute", "relative"]
"""Which numbers `state` holds."""
