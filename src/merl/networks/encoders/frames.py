"""Encoders of images and depth images, trained from scratch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from merl.core import MerlError
from merl.modalities import Frames
from merl.networks.precision import compute_dtype


class ConvEncoder(nn.Module):
    """f_xi: four 3x3 convolutions of 32 channels, each with ReLU (SAC+AE, MERL C.1).

    Args:
        frames: the modality.
        stack: number of frames in a stack.
        channels: channels of each convolution.
        strides: one stride per convolution; the paper's are 2, 1, 1, 1.

    Attributes:
        features: length of the flat output.

    Raises:
        MerlError: the frames are too small for the strides.
    """

    takes_stored = True
    features: int

    def __init__(
        self,
        frames: Frames,
        stack: int,
        channels: int = 32,
        strides: Sequence[int] = (2, 1, 1, 1),
    ) -> None:
        super().__init__()
        self.frames = frames
        self._span, self._offset = float(frames.span), frames.offset
        layers: list[nn.Module] = []
        height, width, source = frames.shape
        source *= stack
        for stride in strides:
            layers += [nn.Conv2d(source, channels, kernel_size=3, stride=stride), nn.ReLU()]
            height, width = ((side - 3) // stride + 1 for side in (height, width))
            source = channels
        if height < 1 or width < 1:
            least = 1
            for stride in reversed(strides):
                least = (least - 1) * stride + 3
            raise MerlError(
                f"an image of {frames.shape[0]}x{frames.shape[1]} pixels is too small for strides "
                f"{tuple(strides)}, which need {least} pixels per side: use a larger image or "
                "smaller --agent.conv-strides"
            )
        self.features = channels * height * width
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, stacks: Tensor) -> Tensor:
        """Encode stored frames (B, K, H, W, C) to (B, F): rows, columns, channels."""
        first, *others = self.convolutions
        assert isinstance(first, nn.Conv2d)
        assert first.bias is not None
        # The first layer's weights and bias absorb scale and offset, which is cheaper than scaling
        # all pixels: x / 255 - 0.5 = (x - 128) / 255 + 1 / 510.
        weight, bias = first.weight / self._span, first.bias
        if self._offset:
            bias = bias + first.weight.sum(dim=(1, 2, 3)) / (2.0 * self._span)
        pixels = self.frames.centred(stacks, compute_dtype(first.weight))
        maps = functional.conv2d(pixels, weight, bias, first.stride)  # (B, 32, h, w)
        for layer in others:
            maps = layer(maps)
        return maps.permute(0, 2, 3, 1).flatten(1)  # a view: the memory is channels-last


class ImpalaEncoder(nn.Module):
    """A residual network of three stages with 16, 32 and 32 channels (Espeholt et al. 2018).

    Args:
        frames: the modality.
        stack: number of frames in a stack.

    Attributes:
        features: length of the flat output.

    Raises:
        MerlError: the frames are smaller than 8 pixels.
    """

    CHANNELS = (16, 32, 32)

    def __init__(self, frames: Frames, stack: int) -> None:
        super().__init__()
        height, width, source = frames.shape
        if min(height, width) < 8:
            raise MerlError(
                f"an image of {height}x{width} pixels is too small for encoder impala, which needs "
                "8 pixels per side: use a larger image, or encoder conv"
            )
        layers: list[nn.Module] = []
        source *= stack
        for channels in self.CHANNELS:
            layers += [
                nn.Conv2d(source, channels, kernel_size=3, padding=1),
                nn.MaxPool2d(kernel_size=3, stride=2, padding=1),
                _Residual(channels),
                _Residual(channels),
            ]
            height, width, source = (height + 1) // 2, (width + 1) // 2, channels
        self.layers = nn.Sequential(*layers, nn.ReLU(), nn.Flatten())
        self.features = source * height * width

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode stacked frames (B, K C, H, W), in [-0.5, 0.5], to (B, F)."""
        encoded: Tensor = self.layers(pixels)
        return encoded


class _Residual(nn.Module):
    """A residual block: x + Conv(ReLU(Conv(ReLU(x))))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(channels, channels, kernel_size=3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, kernel_size=3, padding=1),
        )

    def forward(self, maps: Tensor) -> Tensor:
        """Return maps (B, C, H, W) of the same shape."""
        result: Tensor = maps + self.layers(maps)
        return result
