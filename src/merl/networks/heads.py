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


class _Output(nn.Linear):
    """The last linear layer, always in the precision of the weights: bf16 would round Q away."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


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
    return nn.Sequential(*hidden, _Output(widths[-1], out_features))


class Actor(nn.Module):
    """pi_theta: the latent to the mean action."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.layers = mlp(latent_dim, action_dim, size)

    def forward(self, latent: Tensor) -> Tensor:
        """(B, d) to (B, A), in (-1, 1)."""
        return torch.tanh(self.layers(latent))


class GaussianActor(nn.Module):
    """pi_theta of SAC: the latent to the mean and the spread of a Gaussian, before its tanh.

    log sigma is brought into [-10, 2] by a tanh of its own, so that its gradient never ends at a
    bound.
    """

    LEAST, GREATEST = -10.0, 2.0

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.layers = mlp(latent_dim, 2 * action_dim, size)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """(B, d) to mu and log sigma, (B, A) each."""
        mean, raw = self.layers(latent).chunk(2, dim=-1)
        log_std = self.LEAST + (self.GREATEST - self.LEAST) * (torch.tanh(raw) + 1) / 2
        return mean, log_std


class TwinCritic(nn.Module):
    """Q_phi1 and Q_phi2, two heads of their own over one latent (clipped double Q, TD3)."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.q1, self.q2 = (mlp(latent_dim + action_dim, 1, size) for _ in range(2))

    def forward(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Latent (B, d) and action (B, A) to the two values, (B,) each."""
        both = torch.cat([latent, action], dim=-1)
        return self.q1(both).squeeze(-1), self.q2(both).squeeze(-1)
