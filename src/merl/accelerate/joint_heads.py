"""All heads of a critic in the same kernels, for a GPU.

There the number of kernels limits the speed; on a CPU stacking the weights costs more than it
saves.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from merl.networks.critic import Critic
from merl.networks.heads import MLP
from merl.networks.precision import compute_dtype


def join_heads(critic: nn.Module) -> None:
    """Let a critic compute its heads at once; only rounding changes.

    Args:
        critic: a `Critic`; its method `forward` is replaced.
    """
    assert isinstance(critic, Critic)
    heads = critic.heads

    def forward(latent: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        return tuple(at_once(heads, torch.cat([latent, action], dim=-1)).squeeze(-1))

    module: nn.Module = critic
    module.forward = forward


def at_once(heads: Sequence[MLP], x: Tensor) -> Tensor:
    """Apply N heads of the same shape to one input, with joint products and norms.

    Args:
        heads: the heads.
        x: (B, n).

    Returns:
        The outputs of the heads, (N, B, m), equal to those of separate calls except for rounding.
    """
    hidden = list(zip(*(head.hidden for head in heads), strict=True))
    own = x.dtype
    linear = _side_by_side([[each.linear for each in same] for same in hidden], compute_dtype(x))
    exact = _side_by_side(
        [*([each.norm for each in same] for same in hidden), [head.output for head in heads]], own
    )
    x = x.expand(len(heads), *x.shape)
    for layer in heads[0].hidden:
        x = _linear(x, next(linear), next(linear)).to(own)
        if isinstance(layer.norm, nn.LayerNorm):
            x = functional.layer_norm(x, layer.norm.normalized_shape, eps=layer.norm.eps)
            scale, offset = next(exact)[:, None], next(exact)[:, None]
            x = torch.addcmul(offset, x, scale)
        x = torch.relu(x)
    with torch.autocast(x.device.type, enabled=False):
        return _linear(x, next(exact), next(exact))


def _linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Apply N linear layers, (N, B, n) by (N, m, n) to (N, B, m), in the weights' precision."""
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


def _side_by_side(layers: Sequence[Sequence[nn.Module]], dtype: torch.dtype) -> Iterator[Tensor]:
    """Stack the parameters of each layer's N modules to tensors (N, ...) of type `dtype`."""
    parameters = [p for head in zip(*layers, strict=True) for m in head for p in m.parameters()]
    if not parameters:
        return iter(())
    count = len(layers[0])
    whole: tuple[Tensor, ...] = _SideBySide.apply(count, dtype, *parameters)  # type: ignore[no-untyped-call]
    return iter(whole)


class _SideBySide(torch.autograd.Function):
    """Stack of parameters a1, b1, ..., a2, b2, ... to (a1, a2), (b1, b2), ..., in one kernel."""

    @staticmethod
    def forward(
        ctx: Any, count: int, dtype: torch.dtype, *parameters: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.own, ctx.count = parameters[0].dtype, count
        whole = tuple(
            p.new_empty((count, *p.shape), dtype=dtype)
            for p in parameters[: len(parameters) // count]
        )
        torch._foreach_copy_([each[head] for head in range(count) for each in whole], parameters)
        return whole

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        each = [gradient[head] for head in range(ctx.count) for gradient in gradients]
        own = [g if g.dtype == ctx.own else g.new_empty(g.shape, dtype=ctx.own) for g in each]
        if own[0] is not each[0]:
            torch._foreach_copy_(own, each)
        return (None, None, *own)
