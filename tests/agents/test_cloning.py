"""The loss that clones actions."""

from __future__ import annotations

import torch

from merl.agents.cloning import better_loss, cloning_loss
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


def test_own_actions_count_where_they_are_better() -> None:
    shown = torch.tensor([[0.5, 0.5]])
    action = torch.tensor([[9.0, 9.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 0.0]])
    zeros = torch.zeros(4)
    batch = Batch({}, action, zeros, zeros, {}, shown=shown)
    mean = torch.zeros(4, 2, requires_grad=True)
    loss = better_loss(mean, batch, lambda actions: actions[:, 0])  # the first number is its value
    # (0.25 + 0.25) / 2 of the demonstration and 1 / 2 of the second sample, over four samples; the
    # third is worse than the actor's, and the fourth is equal.
    assert loss.item() == (0.25 + 0.5) / 4
    loss.backward()
    assert mean.grad is not None
    assert mean.grad.tolist() == [[-0.125, -0.125], [-0.25, 0.0], [0.0, 0.0], [0.0, 0.0]]


def test_a_demonstration_counts_whatever_its_value() -> None:
    batch = Batch({}, torch.zeros(1, 1), torch.zeros(1), torch.zeros(1), {}, torch.ones(1, 1))
    assert better_loss(torch.zeros(1, 1), batch, lambda actions: -actions[:, 0]).item() == 1.0
