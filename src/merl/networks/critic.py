"""Twin critic over a latent (MERL C.1)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from merl.networks.heads import MLP, HeadSize
from merl.networks.returns import Returns, Scalar


class TwinCritic(nn.Module):
    """Q_phi1 and Q_phi2, two separate heads over one latent (clipped double Q, TD3).

    Attributes:
        returns: how an output represents the return.
    """

    def __init__(
        self, latent_dim: int, action_dim: int, size: HeadSize, returns: Returns | None = None
    ) -> None:
        super().__init__()
        self.returns = returns or Scalar()
        outputs = self.returns.outputs
        self.q1, self.q2 = (MLP(latent_dim + action_dim, outputs, size) for _ in range(2))

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Map latent (B, d) and action (B, A) to each head's output: (B,), or logits (B, bins)."""
        both = torch.cat([latent, action], dim=-1)
        return self.q1(both).squeeze(-1), self.q2(both).squeeze(-1)

    def values(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the two values, (B,) each, from latent (B, d) and action (B, A)."""
        q1, q2 = self(latent, action)
        return self.returns.value(q1), self.returns.value(q2)
