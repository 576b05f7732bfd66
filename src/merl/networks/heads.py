"""Heads: MLPs over a latent, and the actors that are made of one (MERL C.1)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

Norm = Literal["layer", "none"]


class Hidden(nn.Module):
    """Linear, a norm (or none) and ReLU; the norm in the precision of the weights."""

    def __init__(self, in_features: int, width: int, norm: Norm) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, width)
        self.norm: nn.Module = nn.Identity()
        if norm == "layer":
            self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_features) to (B, width)."""
        return torch.relu(self.norm(self.linear(x).to(self.linear.weight.dtype)))


class Output(nn.Linear):
    """The last linear layer, always in the precision of the weights: bf16 would round Q away."""

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_features) to (B, out_features)."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


@dataclass(frozen=True)
class HeadSize:
    """The shape of actor and critic.

    Attributes:
        layers: linear layers, the output layer counted.
        width: of each hidden layer.
        norm: before each ReLU: LayerNorm or none.
    """

    layers: int
    width: int
    norm: Norm = "layer"


class MLP(nn.Sequential):
    """Layers of that shape; ReLU after each but the last."""

    def __init__(self, in_features: int, out_features: int, size: HeadSize) -> None:
        widths = [in_features] + [size.width] * (size.layers - 1)
        hidden = [Hidden(a, b, size.norm) for a, b in pairwise(widths)]
        super().__init__(*hidden, Output(widths[-1], out_features))

    @property
    def hidden(self) -> list[Hidden]:
        """All layers but the last."""
        return [layer for layer in self if isinstance(layer, Hidden)]

    @property
    def output(self) -> Output:
        """The last layer."""
        layer = self[-1]
        assert isinstance(layer, Output)
        return layer


class Actor(nn.Module):
    """pi_theta: the latent to the mean action."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.layers = MLP(latent_dim, action_dim, size)

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
        self.action_dim = action_dim
        self.layers = MLP(latent_dim, 2 * action_dim, size)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """(B, d) to mu and log sigma, (B, A) each."""
        mean, raw = self.layers(latent).chunk(2, dim=-1)
        log_std = self.LEAST + (self.GREATEST - self.LEAST) * (torch.tanh(raw) + 1) / 2
        return mean, log_std
