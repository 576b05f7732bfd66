"""Heads: the actor and the twin critic over a latent (MERL C.1)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn


class _Hidden(nn.Module):
    """Linear, LayerNorm (or none) and ReLU; the norm in the precision of the weights."""

    def __init__(self, in_features: int, width: int, layer_norm: bool) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, width)
        self.norm = nn.LayerNorm(width) if layer_norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.norm(self.linear(x).to(self.linear.weight.dtype)))


@dataclass(frozen=True)
class HeadSize:
    """The shape of actor and critic.

    Attributes:
        layers: linear layers, the output layer counted.
        width: of each hidden layer.
        layer_norm: LayerNorm before each ReLU.
    """

    layers: int
    width: int
    layer_norm: bool = True


def mlp(in_features: int, out_features: int, size: HeadSize) -> nn.Sequential:
    """An MLP of that shape; ReLU after each layer but the last."""
    widths = [in_features] + [size.width] * (size.layers - 1)
    hidden = [_Hidden(a, b, size.layer_norm) for a, b in pairwise(widths)]
    return nn.Sequential(*hidden, nn.Linear(widths[-1], out_features))


class Actor(nn.Module):
    """pi_theta: the latent to the mean action."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.layers = mlp(latent_dim, action_dim, size)

    def forward(self, latent: Tensor) -> Tensor:
        """(B, d) to (B, A), in (-1, 1)."""
        raw = self.layers(latent)
        return torch.tanh(raw.to(self.layers[-1].weight.dtype))


class TwinCritic(nn.Module):
    """Q_phi1 and Q_phi2, two heads of their own over one latent (clipped double Q, TD3)."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.q1, self.q2 = (mlp(latent_dim + action_dim, 1, size) for _ in range(2))

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Latent (B, d) and action (B, A) to the two values, (B,) each."""
        both = torch.cat([latent, action], dim=-1)
        dtype = self.q1[-1].weight.dtype
        return self.q1(both).squeeze(-1).to(dtype), self.q2(both).squeeze(-1).to(dtype)
