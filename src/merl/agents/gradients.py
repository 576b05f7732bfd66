"""Control of gradients: through a clamp, and not into frozen weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor, nn


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Disable the gradients of the module's weights, which compiled code would always compute."""
    weights = [weight for weight in module.parameters() if weight.requires_grad]
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_(True)


def clamp_straight_through(action: Tensor) -> Tensor:
    """Clamp the action to [-1, 1], with the gradient of the unclamped action."""
    return action + (action.clamp(-1.0, 1.0) - action).detach()
