"""The loss that clones actions: of demonstrations, and of the run itself where they were better."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from merl.core import Batch


def cloning_loss(mean: Tensor, batch: Batch) -> Tensor:
    """Return the squared error of actions (B, A) on the batch's demonstrations, a scalar.

    Synthetic batches, with which updates are timed, have none: then all their actions count.
    """
    shown = batch.action if batch.shown is None else batch.shown
    return (mean[: len(shown)].float() - shown).square().mean()


def better_loss(mean: Tensor, batch: Batch, q: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the squared error on the demonstrations and on own actions of higher value, a scalar.

    The Q-filter of Nair et al. 2018 (arXiv:1709.10089), applied to own experience; demonstrations
    always count.

    Args:
        mean: the actor's actions (B, A).
        batch: the batch.
        q: maps actions (B, A) to their values (B,), without gradient.
    """
    goal = batch.action
    counts = (q(goal) > q(mean.detach())).float()
    if batch.shown is not None:
        count = len(batch.shown)
        goal = torch.cat([batch.shown, goal[count:]])
        counts = torch.cat([torch.ones_like(counts[:count]), counts[count:]])
    return (counts * (mean.float() - goal).square().mean(dim=1)).mean()
