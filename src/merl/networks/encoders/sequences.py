"""Encoders of histories, such as the samples of a force-torque sensor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from merl.modalities import Sequence


class Conv1dEncoder(nn.Module):
    """Three 1-D convolutions over time, each with 32 channels, stride 2 and ReLU.

    Args:
        sequence: the modality.

    Attributes:
        features: length of the flat output.
    """

    CHANNELS, LAYERS = 32, 3

    def __init__(self, sequence: Sequence) -> None:
        super().__init__()
        samples, source = sequence.shape
        layers: list[nn.Module] = []
        for _ in range(self.LAYERS):
            layers += [nn.Conv1d(source, self.CHANNELS, kernel_size=3, stride=2, padding=1)]
            layers += [nn.ReLU()]
            samples, source = (samples + 1) // 2, self.CHANNELS
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.features = samples * self.CHANNELS

    def forward(self, samples: Tensor) -> Tensor:
        """Encode (B, T, n) to (B, F)."""
        encoded: Tensor = self.layers(samples.transpose(1, 2))
        return encoded


class TransformerEncoder(nn.Module):
    """A small transformer: two layers of width 32 with four heads; the newest token is the result.

    Args:
        sequence: the modality.

    Attributes:
        features: length of the output.
    """

    WIDTH, HEADS, LAYERS = 32, 4, 2

    def __init__(self, sequence: Sequence) -> None:
        super().__init__()
        samples, numbers = sequence.shape
        self.features = self.WIDTH
        self.project = nn.Linear(numbers, self.WIDTH)
        self.position = nn.Parameter(0.02 * torch.randn(samples, self.WIDTH))
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(
                self.WIDTH,
                self.HEADS,
                dim_feedforward=2 * self.WIDTH,
                dropout=0.0,
                batch_first=True,
                norm_first=True,
            )
            for _ in range(self.LAYERS)
        )
        self.norm = nn.LayerNorm(self.WIDTH)

    def forward(self, samples: Tensor) -> Tensor:
        """Encode (B, T, n) to (B, 32)."""
        tokens = self.project(samples) + self.position
        for layer in self.layers:
            tokens = layer(tokens)
        encoded: Tensor = self.norm(tokens[:, -1])
        return encoded
