"""Adam: construction, one step, and restoring its state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


def adam(parameters: Sequence[Tensor], rate: float, *, capturable: bool) -> torch.optim.Adam:
    """Make Adam for these parameters.

    Args:
        parameters: parameters to train.
        rate: step size.
        capturable: whether a CUDA graph can contain its step.
    """
    return torch.optim.Adam(parameters, lr=rate, fused=True, capturable=capturable)


def step_optimizer(
    optimizer: torch.optim.Optimizer, loss: Tensor, parameters: Sequence[Tensor]
) -> None:
    """Take one gradient step on these parameters; other gradients stay unchanged."""
    optimizer.zero_grad()
    torch.autograd.backward(loss, inputs=parameters)
    optimizer.step()


def load_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Restore Adam's moments, as copies in the memory order of the weights.

    The fused step reads raw memory: moments in another order would be paired with the wrong
    weights. `capturable` is kept as set for the current device, not as saved.
    """
    capturable = [group["capturable"] for group in optimizer.param_groups]
    optimizer.load_state_dict(dict(saved))
    for group, own in zip(optimizer.param_groups, capturable, strict=True):
        group["capturable"] = own
    for parameter, moments in optimizer.state.items():
        for name in ("exp_avg", "exp_avg_sq"):
            moments[name] = torch.empty_like(parameter).copy_(moments[name])
        moments["step"] = moments["step"].clone()
