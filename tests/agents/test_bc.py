"""Behaviour cloning: the loss, and what it trains."""

from __future__ import annotations

import torch

from merl.agents.ddpg import cloning_loss
from merl.core import Batch


def test_the_loss_is_the_squared_error_on_the_demonstrations_alone() -> None:
    action = torch.tensor([[1.0, 0.0], [0.0, 0.0], [9.0, 9.0]])
    zeros = torch.zeros(3)
    # The intended actions count, not the executed ones.
    batch = Batch({}, action + 5, zeros, zeros, {}, shown=action[:2])
    mean = torch.zeros(3, 2, requires_grad=True)
    loss = cloning_loss(mean, batch)
    assert loss.item() == 0.25  # of four numbers one is off by 1; the third sample does not count
    loss.backward()
    assert mean.grad is not None
    assert mean.grad.tolist() == [[-0.5, 0.0], [0.0, 0.0], [0.0, 0.0]]
