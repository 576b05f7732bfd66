"""Modalities: what an observation key is, and how it is stored, stacked, augmented and scaled.

To add a kind of observation, write a subclass of `Modality` here, add it to `MODALITIES`, and give
it an encoder (`merl.networks.encoders`); docs/howto/modality.md lists all files. Storage, sampling
and acting ask the modality alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import Kind

if TYPE_CHECKING:
    import torch
    from torch import Tensor


@dataclass(frozen=True)
class Modality(ABC):
    """One kind of observation.

    Attributes:
        space: the box of the key, in the form that agents use.
        kind: name of the kind.
        plural: its plural, for people.
        encoder: name of its default encoder.
        stacked: whether it is a camera's frame: acting and sampling stack the last frames, updates
            shift them at random, and the replay can compress them.
    """

    space: spaces.Box
    kind: ClassVar[Kind]
    plural: ClassVar[str]
    encoder: ClassVar[str]
    stacked: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def fits(cls, space: spaces.Box) -> bool:
        """Return whether a box has the form of this kind."""

    @property
    def stored(self) -> np.dtype[Any]:
        """The type in the replay and in a batch."""
        return np.dtype(np.float32)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a single observation."""
        return self.space.shape

    def to_stored(self, value: NDArray[Any]) -> NDArray[Any]:
        """Convert an observation to the type `stored`, with the same shape."""
        return value

    def zeros(self, size: int, stack: int) -> Tensor:
        """Return a batch of `size` stored observations that are all zero."""
        import torch

        dtype: torch.dtype = getattr(torch, self.stored.name)
        return torch.zeros(self._batch_shape(size, stack), dtype=dtype)

    def random(self, size: int, stack: int, generator: torch.Generator) -> Tensor:
        """Return a batch of `size` random stored observations."""
        import torch

        return torch.randn(self._batch_shape(size, stack), generator=generator)

    def _batch_shape(self, size: int, stack: int) -> tuple[int, ...]:
        return (size, stack, *self.shape) if self.stacked else (size, *self.shape)

    @abstractmethod
    def to_input(self, stored: Tensor) -> Tensor:
        """Convert a batch of stored observations to the float32 input of an encoder.

        Args:
            stored: (B, *shape); of stacked frames (B, K, *shape), the oldest first.
        """

    @abstractmethod
    def describe(self) -> str:
        """Return the size in words."""


class Frames(Modality):
    """Frames of a camera, (H, W, C), stored as integers."""

    stacked = True
    encoder = "conv"

    @property
    @abstractmethod
    def bounds(self) -> tuple[int, int]:
        """The lowest and the highest stored integer, which an encoder sees as -0.5 and 0.5."""

    def centred(self, stacks: Tensor, dtype: torch.dtype) -> Tensor:
        """Return stacks (B, K, H, W, C) as (B, K C, H, W), minus `middle`.

        The memory order is channels-last, in which convolutions are fastest.
        """
        pixels = stacks.permute(0, 2, 3, 1, 4).flatten(3).to(dtype)
        return (pixels - self.middle if self.middle else pixels).permute(0, 3, 1, 2)

    def random(self, size: int, stack: int, generator: torch.Generator) -> Tensor:
        """Return a batch of `size` stacks of random integers."""
        import torch

        low, high = self.bounds
        dtype: torch.dtype = getattr(torch, self.stored.name)
        shape = self._batch_shape(size, stack)
        return torch.randint(low, high + 1, shape, dtype=dtype, generator=generator)

    @property
    def middle(self) -> int:
        """The integer at, or half above, the middle of the bounds."""
        return (sum(self.bounds) + 1) // 2

    @property
    def offset(self) -> float:
        """The distance from the middle of the bounds to `middle`: 0 or 0.5."""
        return self.middle - sum(self.bounds) / 2

    @property
    def span(self) -> int:
        """The distance between the bounds."""
        return self.bounds[1] - self.bounds[0]

    def to_input(self, stored: Tensor) -> Tensor:
        """Return stacks (B, K, H, W, C) as (B, K C, H, W), in [-0.5, 0.5]."""
        import torch

        return (self.centred(stored, torch.float32) + self.offset) / self.span


class Image(Frames):
    """A camera image, uint8 (H, W, C): grey, RGB, or RGBA."""

    kind, plural = "image", "images"

    @classmethod
    def fits(cls, space: spaces.Box) -> bool:
        """Return whether the box is uint8 (H, W, C)."""
        return space.dtype == np.uint8 and len(space.shape) == 3

    @property
    def stored(self) -> np.dtype[Any]:
        """Bytes."""
        return np.dtype(np.uint8)

    @property
    def bounds(self) -> tuple[int, int]:
        """The lowest and the highest pixel value."""
        return int(self.space.low.min()), int(self.space.high.max())

    def centred(self, stacks: Tensor, dtype: torch.dtype) -> Tensor:
        """Return stacks (B, K, H, W, C) as (B, K C, H, W), minus `middle`.

        These integers are exact in bf16, unlike x / 255 - 0.5.
        """
        import torch

        if torch.compiler.is_exporting():  # bytes as signed integers are no operation of ONNX
            return super().centred(stacks, dtype)
        pixels = _minus_128(stacks).view(torch.int8).flatten(3).to(dtype)
        if self.middle != 128:
            pixels = pixels + (128 - self.middle)
        return pixels.permute(0, 3, 1, 2)

    def describe(self) -> str:
        """Return height, width, channels and bounds."""
        height, width, channels = self.shape
        low, high = self.bounds
        return f"{height} x {width} x {channels}, from {low} to {high}"


class Depth(Frames):
    """A depth image, float32 or uint16 (H, W, 1), in any unit.

    It is stored in two bytes a pixel: the bounds of the space are mapped to -32768 and 32767, and
    values beyond them are clipped.
    """

    kind, plural = "depth", "depth images"

    @classmethod
    def fits(cls, space: spaces.Box) -> bool:
        """Return whether the box is float32 or uint16, (H, W, 1), with finite bounds."""
        bounds = np.array([space.low.min(), space.high.max()], np.float64)
        return (
            space.dtype in (np.float32, np.uint16)
            and space.shape[2:] == (1,)
            and bool(np.isfinite(bounds).all())
        )

    @property
    def stored(self) -> np.dtype[Any]:
        """Signed integers of two bytes, for which torch has every operation."""
        return np.dtype(np.int16)

    @property
    def bounds(self) -> tuple[int, int]:
        """All integers of two bytes."""
        return -(2**15), 2**15 - 1

    def to_stored(self, value: NDArray[Any]) -> NDArray[np.int16]:
        """Quantise distances, with an error of about 1 / 131070 of the bounds' distance."""
        nearest, farthest = float(self.space.low.min()), float(self.space.high.max())
        share = (value.clip(nearest, farthest) - nearest) / (farthest - nearest)
        return (np.rint(share * self.span) + self.bounds[0]).astype(np.int16)

    def describe(self) -> str:
        """Return height, width and bounds."""
        height, width, _ = self.shape
        return f"{height} x {width}, from {self.space.low.min():g} to {self.space.high.max():g}"


class Vector(Modality):
    """A vector of numbers, float32 (n,)."""

    kind, plural = "vector", "vectors"
    encoder = "identity"

    @classmethod
    def fits(cls, space: spaces.Box) -> bool:
        """Return whether the box is a vector of floats."""
        return np.issubdtype(space.dtype, np.floating) and len(space.shape) == 1

    def to_input(self, stored: Tensor) -> Tensor:
        """Return vectors (B, n) unchanged."""
        return stored

    def describe(self) -> str:
        """Return the length."""
        return "1 number" if self.shape == (1,) else f"{self.shape[0]} numbers"


class Sequence(Modality):
    """A history of T samples of n numbers, float32 (T, n), the newest last.

    The environment provides the whole history at each step, e.g. the samples of a force-torque
    sensor, which is faster than the control of the arm.
    """

    kind, plural = "sequence", "histories"
    encoder = "conv1d"

    @classmethod
    def fits(cls, space: spaces.Box) -> bool:
        """Return whether the box is a matrix of floats."""
        return np.issubdtype(space.dtype, np.floating) and len(space.shape) == 2

    def to_input(self, stored: Tensor) -> Tensor:
        """Return histories (B, T, n) unchanged."""
        return stored

    def describe(self) -> str:
        """Return length and width."""
        return f"{self.shape[0]} samples of {self.shape[1]} numbers"


MODALITIES: tuple[type[Modality], ...] = (Image, Depth, Vector, Sequence)
"""All kinds, in the order in which a representation concatenates them."""


def modality_of(space: spaces.Space[Any]) -> Modality | None:
    """Return the modality of a space in the form that agents use; None if it has none."""
    if not isinstance(space, spaces.Box) or 0 in space.shape:
        return None
    return next((kind(space) for kind in MODALITIES if kind.fits(space)), None)


def modalities_of(space: spaces.Dict) -> dict[str, Modality]:
    """Return the modality of every key that has one, in the order of `MODALITIES`."""
    found = {key: modality_of(part) for key, part in space.items()}
    return {
        key: modality
        for kind in MODALITIES
        for key, modality in found.items()
        if isinstance(modality, kind)
    }


@dataclass(frozen=True)
class ObservationSpec:
    """What an agent observes, made once for a run.

    Attributes:
        modalities: the modality of each key that the agent uses, in the order of its networks.
        privileged: keys that only the critic observes.
        frame_stack: number of frames in a stack, K.
    """

    modalities: Mapping[str, Modality]
    privileged: tuple[str, ...]
    frame_stack: int

    @property
    def senses(self) -> tuple[str, ...]:
        """Keys that the actor observes."""
        return tuple(key for key in self.modalities if key not in self.privileged)

    @property
    def space(self) -> spaces.Dict:
        """The space of the keys that the agent uses."""
        return spaces.Dict({key: modality.space for key, modality in self.modalities.items()})


def _minus_128(images: Tensor) -> Tensor:
    """Permute (B, K, H, W, C) to (B, H, W, K, C) and subtract 128 from each byte (as int8)."""
    if images.device.type != "cpu":
        return _minus_128_at_once(images)
    batch, stack, height, width, channels = images.shape
    interleaved = images.new_empty((batch, height, width, stack, channels))
    # One copy per channel reads whole images; a single permuted copy would read 3 bytes a time.
    for frame in range(stack):
        for channel in range(channels):
            interleaved[..., frame, channel] = images[:, frame, ..., channel]
    return interleaved.bitwise_xor_(128)


def _minus_128_at_once(images: Tensor) -> Tensor:
    """Do the same in one operation; the shift on a GPU returns this memory order already."""
    return images.permute(0, 2, 3, 1, 4).contiguous().bitwise_xor(128)
