"""MLP heads over a latent, and the actors built from them (MERL C.1)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

Norm = Literal["layer", "none"]


class Hidden(nn.Module):
    """Linear layer, optional norm and ReLU; the norm runs in the precision of the weights."""

    def __init__(self, in_features: int, width: int, norm: Norm) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, width)
        self.norm: nn.Module = nn.Identity()
        if norm == "layer":
            self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in_features) to (B, width)."""
        return torch.relu(self.norm(self.linear(x).to(self.linear.weight.dtype)))


class Output(nn.Linear):
    """Last linear layer, always in the precision of the weights: bf16 rounds Q too coarsely."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, in_features) to (B, out_features)."""
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.to(self.weight.dtype))


@dataclass(frozen=True)
class HeadSize:
    """Shape of an actor or critic head.

    Attributes:
        layers: number of linear layers, including the output layer.
        width: width of each hidden layer.
        norm: normalisation before each ReLU: LayerNorm or none.
    """

    layers: int
    width: int
    norm: Norm = "layer"


class MLP(nn.Sequential):
    """MLP of the given shape, with ReLU after each layer but the last."""

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
    """pi_theta: network from the latent to the mean action."""

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.layers = MLP(latent_dim, action_dim, size)

    def forward(self, latent: Tensor) -> Tensor:
        """Compute the mean action (B, A), in (-1, 1), from the latent (B, d)."""
        return torch.tanh(self.layers(latent))

    @staticmethod
    def best(mean: Tensor) -> Tensor:
        """Return the action without noise for an output of `forward`: the mean."""
        return mean


class GaussianActor(nn.Module):
    """pi_theta of SAC: network from the latent to mean and log std of a Gaussian, before its tanh.

    Another tanh maps log sigma to [-10, 2], so that no bound cuts off its gradient.
    """

    LEAST, GREATEST = -10.0, 2.0

    def __init__(self, latent_dim: int, action_dim: int, size: HeadSize) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.layers = MLP(latent_dim, 2 * action_dim, size)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Compute mu and log sigma, (B, A) each, from the latent (B, d)."""
        mean, raw = self.layers(latent).chunk(2, dim=-1)
        log_std = self.LEAST + (self.GREATEST - self.LEAST) * (torch.tanh(raw) + 1) / 2
        return mean, log_std

    @staticmethod
    def best(output: tuple[Tensor, Tensor]) -> Tensor:
        """Return the action without noise for an output of `forward`: tanh(mu)."""
        return torch.tanh(output[0])
