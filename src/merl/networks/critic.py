"""Critic: Q-functions over a latent (MERL C.1), two of them or an ensemble."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from merl.networks.heads import MLP, HeadSize
from merl.networks.returns import Returns, Scalar


class Critic(nn.Module):
    """Q_phi1 to Q_phiN, separate heads over one latent; two for clipped double Q (TD3).

    Args:
        latent_dim: d.
        action_dim: A.
        size: shape of each head.
        returns: how an output represents the return; by default as the value itself.
        count: N, at least 2; more are an ensemble (REDQ, Chen et al. 2021; RLPD, Ball et al. 2023).

    Attributes:
        returns: how an output represents the return.
    """

    def __init__(
        self,
        latent_dim: int,
        action_dim: int,
        size: HeadSize,
        returns: Returns | None = None,
        count: int = 2,
    ) -> None:
        super().__init__()
        self.returns = returns or Scalar()
        outputs = self.returns.outputs
        self._names = [f"q{number + 1}" for number in range(count)]
        for name in self._names:
            self.add_module(name, MLP(latent_dim + action_dim, outputs, size))

    @property
    def heads(self) -> list[MLP]:
        """All heads, in order."""
        return [getattr(self, name) for name in self._names]

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """Map latent (B, d) and action (B, A) to each head's output: (B,), or logits (B, bins)."""
        both = torch.cat([latent, action], dim=-1)
        return tuple(head(both).squeeze(-1) for head in self.heads)

    def loss(self, outputs: Sequence[Tensor], y: Tensor) -> Tensor:
        """Return the sum of the heads' losses, a scalar, for their outputs and targets y (B,)."""
        return torch.stack([self.returns.loss(output, y) for output in outputs]).sum()

    def values(self, latent: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """Compute each head's value, (B,), from latent (B, d) and action (B, A)."""
        return tuple(self.returns.value(output) for output in self(latent, action))

    def smaller(self, latent: Tensor, action: Tensor, pair: Tensor | None = None) -> Tensor:
        """Return the smaller value (B,) of the two heads, or of the `pair` (2,) in an ensemble."""
        values = self.values(latent, action)
        if pair is not None:
            values = torch.stack(values)[pair].unbind()
        first, second = values
        return torch.minimum(first, second)

    def rating(self, latent: Tensor, action: Tensor) -> Tensor:
        """Return the value (B,) that actions are chosen by: the smaller of two, the mean of more.

        The mean of an ensemble is what RLPD's actor follows.
        """
        values = self.values(latent, action)
        if len(values) > 2:
            return torch.stack(values).mean(dim=0)
        return torch.minimum(*values)

    def draw_pair(self, generator: torch.Generator) -> Tensor | None:
        """Draw two different heads of an ensemble, int64 (2,); None if there are only two."""
        count = len(self._names)
        if count == 2:
            return None
        # Not `randperm`, which waits for a GPU.
        ranks = torch.rand(count, generator=generator, device=generator.device)
        return ranks.topk(2).indices
