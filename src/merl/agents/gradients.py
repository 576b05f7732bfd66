"""Where gradients go: past a clamp, and not into weights that a loss must not move."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor, nn


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """No gradient of the module's weights: compiled code would take it, asked for or not."""
    weights = [weight for weight in module.parameters() if weight.requires_grad]
    for weight in weights:
        weight.requires_grad_(False)
    try:
        yield
    finally:
        for weight in weights:
            weight.requires_grad_(True)


def clamp_straight_through(action: Tensor) -> Tensor:
    """The action in [-1, 1], with the gradient as if it had not been clamped."""
    return action + (action.clamp(-1.0, 1.0) - action).detach()
