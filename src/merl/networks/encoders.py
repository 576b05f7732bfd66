"""Encoders, one per modality, trained by the critic's loss alone (MERL 4.1, C.1)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from merl.core import MerlError
from merl.networks.augmentation import to_input
from merl.networks.precision import compute_dtype


class ConvEncoder(nn.Module):
    """f_xi: four 3x3 convolutions of 32 channels, each with ReLU (SAC+AE, MERL C.1).

    Args:
        in_channels: channels of the stacked frames.
        image_size: (H, W) of a frame, in pixels.
        channels: channels of each convolution.
        strides: one stride per convolution; the paper's are 2, 1, 1, 1.
        pixels: lowest and highest pixel value, which are scaled to -0.5 and 0.5.

    Attributes:
        features: length of the flat output.
    """

    features: int

    def __init__(
        self,
        in_channels: int,
        image_size: tuple[int, int],
        channels: int = 32,
        strides: Sequence[int] = (2, 1, 1, 1),
        pixels: tuple[int, int] = (0, 255),
    ) -> None:
        super().__init__()
        self._low, self._high = pixels
        layers: list[nn.Module] = []
        height, width = image_size
        for index, stride in enumerate(strides):
            source = in_channels if index == 0 else channels
            layers += [nn.Conv2d(source, channels, kernel_size=3, stride=stride), nn.ReLU()]
            height, width = ((side - 3) // stride + 1 for side in (height, width))
        if height < 1 or width < 1:
            least = 1
            for stride in reversed(strides):
                least = (least - 1) * stride + 3
            raise MerlError(
                f"an image of {image_size[0]}x{image_size[1]} pixels is too small for strides "
                f"{tuple(strides)}, which need {least} pixels per side: use a larger image or "
                "smaller --agent.conv-strides"
            )
        self.features = channels * height * width
        self.convolutions = nn.Sequential(*layers).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, stacks: Tensor) -> Tensor:
        """Encode stacked frames, uint8 (B, K, H, W, C), to (B, F): rows, columns, channels."""
        first, *others = self.convolutions
        assert isinstance(first, nn.Conv2d)
        assert first.bias is not None
        # x / 255 - 0.5 = (x - 128) / 255 + 1 / 510. The first layer's weights and bias absorb scale
        # and offset, which is cheaper than scaling all pixels. Other bounds: about their middle.
        span = float(self._high - self._low)
        middle = (self._low + self._high + 1) // 2
        weight, bias = first.weight / span, first.bias
        if 2 * middle != self._low + self._high:  # an odd sum: the middle is half a pixel too high
            bias = bias + first.weight.sum(dim=(1, 2, 3)) / (2.0 * span)
        pixels = to_input(stacks, compute_dtype(first.weight), middle)
        maps = functional.conv2d(pixels, weight, bias, first.stride)  # (B, 32, h, w)
        for layer in others:
            maps = layer(maps)
        return maps.permute(0, 2, 3, 1).flatten(1)  # a view: the memory is channels-last


class Standardize(nn.Module):
    """Standardisation of a vector: each entry minus its mean, divided by its standard deviation.

    Without it, a velocity of 5 rad/s dominates a position of 5 cm. Mean and deviation are those of
    the vectors passed to `observe`, and stay fixed after `STEADY` samples. Results are clipped to
    `FARTHEST` deviations: the entries of an object that rests most of the time are hundreds of
    deviations off when it is touched, and would dominate the rest (docs/explanation/state.md).

    Args:
        features: length of the vector.
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
        """Update mean and deviation from (B, n), until `STEADY` samples were seen."""
        wanted = self.count < self.STEADY
        self.count += len(vector) * wanted
        share = wanted * len(vector) / self.count
        variance, mean = torch.var_mean(vector, dim=0, correction=0)
        change = mean - self.mean
        self.variance.lerp_(variance, share).add_(share * (1 - share) * change.square())
        self.mean.add_(share * change)

    def forward(self, vector: Tensor) -> Tensor:
        """Standardise (B, n) to (B, n), in [-5, 5]."""
        scale = self.variance.clamp(min=self.SMALLEST**2).rsqrt()
        return ((vector - self.mean) * scale).clamp(-self.FARTHEST, self.FARTHEST)


class VectorEncoder(nn.Module):
    """g_zeta: the identity, or a 2-layer MLP with ReLU (MERL C.1, Figure 5).

    Args:
        in_features: length of the vector.
        width: width of the MLP's layers; 0 is the identity, as in the final MERL.
        standardize: standardise the vector first.

    Attributes:
        features: length of the encoding.
    """

    features: int

    def __init__(self, in_features: int, width: int = 0, standardize: bool = False) -> None:
        super().__init__()
        self.features = width or in_features
        self.scale = Standardize(in_features) if standardize else None
        self.layers = nn.Sequential()
        if width:
            self.layers = nn.Sequential(
                nn.Linear(in_features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
            )

    def observe(self, vector: Tensor) -> None:
        """Update the standardisation, if there is one, from (B, n)."""
        if self.scale is not None:
            self.scale.observe(vector)

    def forward(self, vector: Tensor) -> Tensor:
        """Encode (B, n) to (B, features)."""
        encoded: Tensor = self.layers(vector if self.scale is None else self.scale(vector))
        return encoded
