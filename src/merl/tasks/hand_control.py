"""Control of the Jaco hand in space, for a person with a keyboard or a gamepad."""

from __future__ import annotations

import numpy as np

from merl.tasks.controller import Controller
from merl.tasks.kinematics import Array

AXES = ("right, left", "away from the camera, towards it", "up, down", "turn", "close, open")
"""What each number of a command moves."""
SPEED = 0.25
"""Speed of the hand, m/s."""
TURN = 1.5
"""Its turn about the vertical, rad/s."""
GRIP = 1.5
"""Speed of the fingers, rad/s."""


class HandControl(Controller):
    """Controller that moves the hand by a person's commands; see `Controller`.

    Attributes:
        command: (5,), in [-1, 1], in the order of `AXES`.
    """

    command: Array = np.zeros(len(AXES))

    def _act(self) -> Array:
        x, y, z, turn, fingers = self.command
        twist = np.array([SPEED * x, SPEED * y, SPEED * z, 0.0, 0.0, TURN * turn])
        return self.limited(self.arm.turn(self.q, twist), np.full(3, GRIP * fingers))
