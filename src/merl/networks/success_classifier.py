"""A network that sees in the camera's images whether a task is solved."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

CHANNELS = (16, 32, 32)
FEATURES = 64


class SuccessNetwork(nn.Module):
    """Three strided convolutions for each camera, and a layer over all of them.

    Args:
        shapes: {key: (H, W, C)} of the images.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        super().__init__()
        self.keys = tuple(shapes)
        self.cameras = nn.ModuleList(_camera(shape) for shape in shapes.values())
        self.head = nn.Sequential(nn.ReLU(), nn.Linear(FEATURES * len(shapes), 1))

    def forward(self, images: Mapping[str, Tensor]) -> Tensor:
        """Return the logit of success, (B,).

        Args:
            images: uint8 (B, H, W, C) by key.
        """
        features = [
            camera(images[key].permute(0, 3, 1, 2).float() / 255 - 0.5)
            for key, camera in zip(self.keys, self.cameras, strict=True)
        ]
        logits: Tensor = self.head(torch.cat(features, dim=1)).squeeze(1)
        return logits


def _camera(shape: tuple[int, ...]) -> nn.Module:
    layers: list[nn.Module] = []
    before = shape[-1]
    for channels in CHANNELS:
        layers += [nn.Conv2d(before, channels, 3, stride=2, padding=1), nn.ReLU()]
        before = channels
    return nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(FEATURES))
