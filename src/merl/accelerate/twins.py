"""Both heads of a twin critic in the same kernels, for a GPU.

There the number of kernels limits the speed; on a CPU stacking the weights costs more than it
saves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from merl.networks.critic import TwinCritic
from merl.networks.heads import MLP
from merl.networks.precision import compute_dtype


def join_heads(critic: nn.Module) -> None:
    """Let a twin critic compute both heads at once; only rounding changes.

    Args:
        critic: a `TwinCritic`; its method `forward` is replaced.
    """
    assert isinstance(critic, TwinCritic)
    q1, q2 = critic.q1, critic.q2

    def forward(latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        first, second = twins(q1, q2, torch.cat([latent, action], dim=-1))
        return first.squeeze(-1), second.squeeze(-1)

    module: nn.Module = critic
    module.forward = forward


def twins(first: MLP, second: MLP, x: Tensor) -> tuple[Tensor, Tensor]:
    """Apply two heads of the same shape to one input, with joint products and norms.

    Args:
        first: first head.
        second: second head, of the same shape.
        x: (B, n).

    Returns:
        The output of each head, (B, m), equal to that of a separate call except for rounding.
    """
    hidden = list(zip(first.hidden, second.hidden, strict=True))
    own = x.dtype
    linear = _side_by_side([(a.linear, b.linear) for a, b in hidden], compute_dtype(x))
    exact = _side_by_side(
        [*((a.norm, b.norm) for a, b in hidden), (first.output, second.output)], own
    )
    x = x.expand(2, *x.shape)
    for layer in first.hidden:
        x = _both(x, next(linear), next(linear)).to(own)
        if isinstance(layer.norm, nn.LayerNorm):
            x = functional.layer_norm(x, layer.norm.normalized_shape, eps=layer.norm.eps)
            scale, offset = next(exact)[:, None], next(exact)[:, None]
            x = torch.addcmul(offset, x, scale)
        x = torch.relu(x)
    with torch.autocast(x.device.type, enabled=False):
        q1, q2 = _both(x, next(exact), next(exact))
    return q1, q2


def _both(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply two linear layers, (2, B, n) by (2, m, n) to (2, B, m), in the weights' precision."""
    layers: Tensor = _Linears.apply(x.to(weight.dtype), weight, bias)  # type: ignore[no-untyped-call]
    return layers


class _Linears(torch.autograd.Function):
    """`baddbmm` with weight gradients in the memory order of the weights, which saves a copy."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return torch.baddbmm(bias[:, None], x, weight.mT)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (g,), (x, weight) = gradients, ctx.saved_tensors
        x_needs, weight_needs, bias_needs = ctx.needs_input_grad
        return (
            g @ weight if x_needs else None,
            g.mT @ x if weight_needs else None,
            g.sum(dim=1) if bias_needs else None,
        )


def _side_by_side(
    pairs: Sequence[tuple[nn.Module, nn.Module]], dtype: torch.dtype
) -> Iterator[Tensor]:
    """Stack the parameters of each pair of modules to tensors (2, ...) of type `dtype`."""
    parameters = [p for side in zip(*pairs, strict=True) for m in side for p in m.parameters()]
    if not parameters:
        return iter(())
    whole: tuple[Tensor, ...] = _SideBySide.apply(dtype, *parameters)  # type: ignore[no-untyped-call]
    return iter(whole)


class _SideBySide(torch.autograd.Function):
    """Stack of parameters a1, b1, ..., a2, b2, ... to (a1, a2), (b1, b2), ..., in one kernel."""

    @staticmethod
    def forward(ctx: Any, dtype: torch.dtype, *parameters: Tensor) -> tuple[Tensor, ...]:
        ctx.own = parameters[0].dtype
        whole = tuple(
            p.new_empty((2, *p.shape), dtype=dtype) for p in parameters[: len(parameters) // 2]
        )
        torch._foreach_copy_([both[side] for side in range(2) for both in whole], parameters)
        return whole

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        each = [both[side] for side in range(2) for both in gradients]
        own = [g if g.dtype == ctx.own else g.new_empty(g.shape, dtype=ctx.own) for g in each]
        if own[0] is not each[0]:
            torch._foreach_copy_(own, each)
        return (None, *own)
