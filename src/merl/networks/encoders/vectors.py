"""Encoders of vectors."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from merl.modalities import Modality


class Standardize(nn.Module):
    """Standardisation of a vector: each entry minus its mean, divided by its standard deviation.

    Without it, a velocity of 5 rad/s dominates a position of 5 cm. Mean and deviation are those of
    the vectors passed to `observe`, and stay fixed after `STEADY` samples. Results are clipped to
    `FARTHEST` deviations: the entries of an object that rests most of the time are hundreds of
    deviations off when it is touched, and would dominate the rest (docs/explanation/state.md).

    Args:
        features: length of the vector, or of each sample of a history.
    """

    STEADY = 100_000
    SMALLEST = 0.01  # lower bound of the deviation: a constant entry may vary later
    FARTHEST = 5.0  # bound of the result, in deviations
    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("variance", torch.ones(features))
        self.register_buffer("count", torch.zeros(()))

    @torch.no_grad()
    def observe(self, vector: Tensor) -> None:
        """Update mean and deviation from (B, n) or (B, T, n), until `STEADY` samples were seen."""
        vector = vector.flatten(0, -2)
        wanted = self.count < self.STEADY
        self.count += len(vector) * wanted
        share = wanted * len(vector) / self.count
        variance, mean = torch.var_mean(vector, dim=0, correction=0)
        change = mean - self.mean
        self.variance.lerp_(variance, share).add_(share * (1 - share) * change.square())
        self.mean.add_(share * change)

    def forward(self, vector: Tensor) -> Tensor:
        """Standardise (B, n) or (B, T, n) to the same shape, in [-5, 5]."""
        scale = self.variance.clamp(min=self.SMALLEST**2).rsqrt()
        return ((vector - self.mean) * scale).clamp(-self.FARTHEST, self.FARTHEST)


class Identity(nn.Flatten):
    """g_zeta of the final MERL: a vector as it is, a history as one long vector.

    Args:
        modality: the modality.

    Attributes:
        features: length of the encoding.
    """

    def __init__(self, modality: Modality) -> None:
        super().__init__()
        self.features = math.prod(modality.shape)


class MLPEncoder(nn.Sequential):
    """g_zeta of Figure 5: two linear layers with ReLU (MERL C.1).

    Args:
        modality: the modality.
        width: width of both layers.

    Attributes:
        features: length of the encoding.
    """

    def __init__(self, modality: Modality, width: int) -> None:
        length = math.prod(modality.shape)
        layers = nn.Linear(length, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        super().__init__(nn.Flatten(), *layers)
        self.features = width
