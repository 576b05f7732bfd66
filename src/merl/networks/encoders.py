"""Encoders: one per modality, updated by the critic's loss alone (MERL 4.1, C.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from merl.core import MerlError


class ConvEncoder(nn.Module):
    """f_xi: four 3x3 convolutions of 32 channels, each with ReLU (SAC+AE, MERL C.1).

    Args:
        in_channels: channels of the stacked frames.
        image_size: (H, W) of a frame, in pixels.
        channels: channels of each convolution.
        strides: one stride per convolution; the paper's are 2, 1, 1, 1.

    Attributes:
        features: length of the flat output.
    """

    def __init__(
        self,
        in_channels: int,
        image_size: tuple[int, int],
        channels: int = 32,
        strides: Sequence[int] = (2, 1, 1, 1),
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        height, width = image_size
        for index, stride in enumerate(strides):
            source = in_channels if index == 0 else channels
            layers += [nn.Conv2d(source, channels, kernel_size=3, stride=stride), nn.ReLU()]
            height, width = ((side - 3) // stride + 1 for side in (height, width))
        if height < 1 or width < 1:
            raise MerlError(
                f"an image of {image_size[0]}x{image_size[1]} pixels is too small for strides "
                f"{tuple(strides)}: use a larger image or smaller strides"
            )
        self.features = channels * height * width
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Tensor) -> Tensor:
        """Images (B, C, H, W) in [-0.5, 0.5] to features (B, F): rows, columns, channels."""
        maps: Tensor = self.convolutions(images)  # (B, 32, h, w)
        return maps.permute(0, 2, 3, 1).flatten(1)  # a view: the memory is channels-last


class IdentityEncoder(nn.Module):
    """g_zeta of the final MERL: the joints speak for themselves (MERL C.1, Figure 5)."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.features = features

    def forward(self, vector: Tensor) -> Tensor:
        """(B, n) as it is."""
        return vector


class MLPEncoder(nn.Module):
    """g_zeta of the ablation: a 2-layer MLP with ReLU after each layer (MERL C.1, Figure 5)."""

    def __init__(self, in_features: int, width: int) -> None:
        super().__init__()
        self.features = width
        self.layers = nn.Sequential(
            nn.Linear(in_features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )

    def forward(self, vector: Tensor) -> Tensor:
        """(B, n) to (B, width)."""
        encoded: Tensor = self.layers(vector)
        return encoded
