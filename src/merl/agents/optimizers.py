"""Adam: made, one step, and its saved state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


def adam(parameters: Sequence[Tensor], rate: float, *, capturable: bool) -> torch.optim.Adam:
    """Make Adam over these parameters.

    Args:
        parameters: to learn.
        rate: step size.
        capturable: whether a CUDA graph can hold its step.
    """
    return torch.optim.Adam(parameters, lr=rate, fused=True, capturable=capturable)


def step_optimizer(
    optimizer: torch.optim.Optimizer, loss: Tensor, parameters: Sequence[Tensor]
) -> None:
    """Take one gradient step on these parameters; other gradients stay as they are."""
    optimizer.zero_grad()
    torch.autograd.backward(loss, inputs=parameters)
    optimizer.step()


def load_optimizer(optimizer: torch.optim.Optimizer, saved: Mapping[str, Any]) -> None:
    """Restore Adam's moments, as copies in the memory order of the weights.

    The fused step walks raw memory: moments in another order would meet the wrong weights. Whether
    the step can be part of a CUDA graph depends on the current device, not on the saved one.
    """
    capturable = [group["capturable"] for group in optimizer.param_groups]
    optimizer.load_state_dict(dict(saved))
    for group, own in zip(optimizer.param_groups, capturable, strict=True):
        group["capturable"] = own
    for parameter, moments in optimizer.state.items():
        for name in ("exp_avg", "exp_avg_sq"):
            moments[name] = torch.empty_like(parameter).copy_(moments[name])
        moments["step"] = moments["step"].clone()
