"""The twin critic over a latent (MERL C.1): one value after the other, or both at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from merl.networks.heads import MLP, HeadSize
from merl.networks.precision import compute_dtype
from merl.networks.returns import Returns, Scalar


class TwinCritic(nn.Module):
    """Q_phi1 and Q_phi2, two heads of their own over one latent (clipped double Q, TD3).

    Attributes:
        at_once: compute both in the same kernels. A GPU is held up by the number of kernels, a CPU
            by laying the weights beside each other; None: on a GPU.
        returns: what an output says about the return.
    """

    at_once: bool | None = None

    def __init__(
        self, latent_dim: int, action_dim: int, size: HeadSize, returns: Returns | None = None
    ) -> None:
        super().__init__()
        self.returns = returns or Scalar()
        outputs = self.returns.outputs
        self.q1, self.q2 = (MLP(latent_dim + action_dim, outputs, size) for _ in range(2))

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Latent (B, d) and action (B, A) to an output of each head: (B,), or logits (B, bins)."""
        both = torch.cat([latent, action], dim=-1)
        at_once = both.is_cuda if self.at_once is None else self.at_once
        if at_once:
            q1, q2 = twins(self.q1, self.q2, both)
        else:
            q1, q2 = self.q1(both), self.q2(both)
        return q1.squeeze(-1), q2.squeeze(-1)

    def values(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Latent (B, d) and action (B, A) to the two values, (B,) each."""
        q1, q2 = self(latent, action)
        return self.returns.value(q1), self.returns.value(q2)


def twins(first: MLP, second: MLP, x: Tensor) -> tuple[Tensor, Tensor]:
    """Two heads of one shape over the same input, each product and each norm for both in one.

    Args:
        first: a head.
        second: likewise.
        x: (B, n).

    Returns:
        What each head makes of it, (B, m): apart from rounding, what it gives by itself.
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
    """Two linear layers: (2, B, n) by (2, m, n) to (2, B, m), in the precision of the weights."""
    layers: Tensor = _Linears.apply(x.to(weight.dtype), weight, bias)  # type: ignore[no-untyped-call]
    return layers


class _Linears(torch.autograd.Function):
    """As `baddbmm`, but for gradients that lie as the weights do: they need no copy to be taken."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return torch.baddbmm(bias[:, None], x, weight.mT)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (g,), (x, weight) = gradients, ctx.saved_tensors
        of_x, of_weight, of_bias = ctx.needs_input_grad
        return (
            g @ weight if of_x else None,
            g.mT @ x if of_weight else None,
            g.sum(dim=1) if of_bias else None,
        )


def _side_by_side(
    pairs: Sequence[tuple[nn.Module, nn.Module]], dtype: torch.dtype
) -> Iterator[Tensor]:
    """The parameters of each pair of modules as one tensor (2, ...) each, in that precision."""
    parameters = [p for side in zip(*pairs, strict=True) for m in side for p in m.parameters()]
    if not parameters:
        return iter(())
    whole: tuple[Tensor, ...] = _SideBySide.apply(dtype, *parameters)  # type: ignore[no-untyped-call]
    return iter(whole)


class _SideBySide(torch.autograd.Function):
    """Parameters a1, b1, ..., a2, b2, ... to (a1, a2), (b1, b2), ...: all of them in one kernel."""

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
