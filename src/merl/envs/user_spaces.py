"""Spaces of a user's environment: which ones agents can use, how, and how to fix the others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import EnvironmentFailed, MerlError
from merl.envs.config import ImageLayout
from merl.envs.user_values import to_array
from merl.modalities import Depth, Image, Modality, Sequence, Vector

WIDEST_ACTION = 1e6
"""Maximum distance between an action's bounds; wider bounds are treated as placeholders."""
FRAMES = 12
"""Maximum number of stacked RGB frames in the channels of an image."""
IMAGE_SIDE = 16
"""Pixels: messages treat a box with two sides of at least this size as an image."""


@dataclass(frozen=True)
class UserKey:
    """One observation key of an environment, and the form in which agents use it.

    Attributes:
        key: name of the key.
        given: the environment's box.
        modality: the form for agents.
        channels_first: whether the environment's image is (C, H, W).
    """

    key: str
    given: spaces.Box
    modality: Modality
    channels_first: bool = False

    @classmethod
    def as_trained(cls, key: str, modality: Modality, shape: tuple[int, ...]) -> UserKey:
        """Return the check of a key of shape `shape`; images may be (C, H, W), too."""
        space = modality.space
        first = (*space.shape[-1:], *space.shape[:-1])
        if not isinstance(modality, Image) or shape != first or shape == space.shape:
            return cls(key, space, modality)
        low, high = (np.moveaxis(bound, -1, 0) for bound in (space.low, space.high))
        return cls(key, spaces.Box(low, high, dtype=np.uint8), modality, channels_first=True)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value of the key."""
        return self.modality.space.low.min().item(), self.modality.space.high.max().item()

    def convert(self, value: Any) -> NDArray[Any]:
        """Convert an observation to the form for agents.

        Raises:
            EnvironmentFailed: the observation does not match `given`; the message is one line.
        """
        name = f"observation {self.key!r}"
        array = to_array(name, value)
        if self._is_same_but_for_axes_of_one(array):
            array = array.reshape(self.given.shape)
        if array.shape != self.given.shape:
            raise EnvironmentFailed(
                f"{name} has shape {array.shape}, but its space has {self.given.shape}"
            )
        space = self.modality.space
        if np.issubdtype(space.dtype, np.integer):
            return self._as_pixels(name, array)
        if isinstance(self.modality, Depth):  # no return may be infinity
            array = array.clip(*self.bounds)
        if array.dtype == np.float32:
            return array.reshape(space.shape)
        with np.errstate(over="ignore"):
            floats = array.astype(np.float32).reshape(space.shape)
        lost = np.flatnonzero(np.isinf(floats) & ~np.isinf(array.reshape(floats.shape)))
        if len(lost):
            raise EnvironmentFailed(
                f"{name} is {array.flat[lost[0]]} at index {lost[0]}, which is beyond float32: use "
                "other units, or clip it"
            )
        return floats

    def _is_same_but_for_axes_of_one(self, array: NDArray[Any]) -> bool:
        """Return whether the shape differs only by axes of length one: (H, W) and (H, W, 1)."""
        one, other = (
            [side for side in shape if side != 1] for shape in (array.shape, self.given.shape)
        )
        return one == other

    def _as_pixels(self, name: str, array: NDArray[Any]) -> NDArray[Any]:
        space, (low, high) = self.modality.space, self.bounds
        if array.dtype != space.dtype:
            raise EnvironmentFailed(
                f"{name} has dtype {array.dtype}, but its space has {space.dtype}: return pixels "
                f"from {low} to {high} as np.{space.dtype}"
            )
        whole = np.iinfo(array.dtype)
        if isinstance(self.modality, Depth):  # no return may be the highest number
            array = array.clip(low, high)
        elif (low, high) != (whole.min, whole.max) and (array.min() < low or array.max() > high):
            raise EnvironmentFailed(
                f"{name} has pixels from {array.min()} to {array.max()}, but its space has {low} "
                f"to {high}: set the bounds of its box to the bounds of its pixels"
            )
        moved = np.moveaxis(array, 0, -1) if self.channels_first else array
        return moved.reshape(space.shape)


def user_key(key: str, space: spaces.Space[Any], layout: ImageLayout) -> UserKey | None:
    """Return how agents use an observation key; None if they cannot (see `advice`).

    Args:
        key: name of the key.
        space: the environment's space of the key.
        layout: order of the axes of images.

    Raises:
        MerlError: an image's layout is ambiguous, or its bounds are unusable.
    """
    if not isinstance(space, spaces.Box) or 0 in space.shape:
        return None
    shape, long_axes = space.shape, len(space.shape) - space.shape.count(1)
    if space.dtype == np.uint8 and len(shape) in (2, 3) and (long_axes > 1 or len(shape) == 3):
        return _image(key, space, layout)
    if long_axes <= 1:
        return UserKey(key, space, Vector(_floats(space, (space.low.size,))))
    if is_depth(space):
        return _depth(key, space)
    if len(shape) == 2 and not _is_image_like(space):
        return UserKey(key, space, Sequence(_floats(space, shape)))
    return None


def is_depth(space: spaces.Box) -> bool:
    """Return whether a box is taken for a depth image.

    It is one of distances: float or uint16, from at least 0 to a finite bound, (H, W, 1), (1, H, W)
    or, with sides of at least 16 pixels, (H, W).
    """
    sides = [side for side in space.shape if side != 1]
    distances = np.issubdtype(space.dtype, np.floating) or space.dtype == np.uint16
    axes = len(space.shape)
    return (
        distances
        and ((axes == 3 and len(sides) == 2) or (axes == 2 and min(space.shape) >= IMAGE_SIDE))
        and bool(space.low.min() >= 0 and np.isfinite(space.high).all())
    )


def _image(key: str, space: spaces.Box, layout: ImageLayout) -> UserKey:
    channels_first = len(space.shape) == 3 and _channels_first(key, space.shape, layout)
    shape = (*space.shape[1:], space.shape[0]) if channels_first else space.shape
    if len(shape) == 2:
        shape = (*shape, 1)
    low, high = _pixel_bounds(key, space, channels_first)
    return UserKey(key, space, Image(spaces.Box(low, high, shape, np.uint8)), channels_first)


def _depth(key: str, space: spaces.Box) -> UserKey:
    low, high = space.low.min().item(), space.high.max().item()
    if not low < high:
        raise MerlError(
            f"observation {key!r} has distances from {low} to {high}: set the bounds of its box to "
            "the nearest and the farthest distance"
        )
    height, width = (side for side in space.shape if side != 1)
    dtype: Any = np.uint16 if space.dtype == np.uint16 else np.float32
    return UserKey(key, space, Depth(spaces.Box(low, high, (height, width, 1), dtype)))


def _floats(space: spaces.Box, shape: tuple[int, ...]) -> spaces.Box:
    """Return a float32 box with the bounds of `space`."""
    with np.errstate(over="ignore"):  # float64 bounds beyond float32 become infinite
        lows, highs = (b.astype(np.float32).reshape(shape) for b in (space.low, space.high))
    return spaces.Box(lows, highs, dtype=np.float32)


def _is_image_like(space: spaces.Box) -> bool:
    return sorted(space.shape)[-2] >= 2 * IMAGE_SIDE


def advice(space: spaces.Space[Any]) -> str:
    """Return advice on how to replace a space that agents cannot use."""
    if isinstance(space, spaces.Discrete):
        return f"encode it as one-hot, a float32 box of {space.n} numbers"
    if isinstance(space, spaces.MultiDiscrete):
        return "encode each of its numbers as one-hot, all in one float32 box"
    if isinstance(space, spaces.MultiBinary):
        return "use a box from 0 to 1, with dtype float32 for flags or np.uint8 for an image"
    if isinstance(space, spaces.Dict):
        return "it is nested: move each of its entries to the outer Dict, with a separate key"
    if isinstance(space, spaces.Tuple):
        return "put its parts in a spaces.Dict, each with a key"
    if not isinstance(space, spaces.Box):
        return "encode its content in numbers, as a box"
    if 0 in space.shape:
        return "it contains no numbers"
    image_like = sorted(space.shape)[-2] >= IMAGE_SIDE
    if len(space.shape) > 3 and image_like:
        return (
            "merl stacks the frames of an image itself: remove the wrapper that stacks them, and "
            "set --replay.frame-stack"
        )
    if image_like:
        return _image_advice(space)
    size = int(np.prod(space.shape))
    return (
        "merl stacks the frames of images itself, so remove a wrapper that stacks; a history of "
        f"numbers is a box (samples, numbers), other numbers can be flattened to a box ({size},)"
    )


def brief(space: spaces.Space[Any]) -> str:
    """Return a space as one short line."""
    if isinstance(space, spaces.Box) and space.shape and 0 not in space.shape:
        low, high = float(space.low.min()), float(space.high.max())
        return f"a {space.dtype} box {space.shape} from {low:.6g} to {high:.6g}"
    text = " ".join(str(space).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def action_bounds(
    space: spaces.Space[Any], allow_wide: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and the upper bound of each action, (A,).

    Args:
        space: the action space of the environment.
        allow_wide: accept bounds that are more than `WIDEST_ACTION` apart.

    Raises:
        MerlError: agents cannot use the action space.
    """
    actions = f"the environment's actions are {brief(space)}"
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise MerlError(f"{actions}: agents need a box of real numbers (n,), as np.float32")
    if len(space.shape) != 1 or space.shape[0] == 0:
        size = max(1, int(np.prod(space.shape)))
        raise MerlError(
            f"{actions}: agents need a box of real numbers (n,): make it ({size},), and reshape "
            "the action in `step`"
        )
    with np.errstate(over="ignore"):
        # In the dtype of the action space, because the environment receives that dtype.
        low, high = (b.astype(space.dtype).astype(np.float64) for b in (space.low, space.high))
        widths = high - low
    for index, (lowest, highest, width) in enumerate(zip(low, high, widths, strict=True)):
        one = f"the environment's action {index} has the bounds {lowest:.6g} and {highest:.6g}"
        if not np.isfinite([lowest, highest, width]).all():
            raise MerlError(f"{one}: set finite bounds, which merl scales to [-1, 1]")
        if width < 0:
            raise MerlError(f"{one}: the lower bound is above the upper bound")
        if width > WIDEST_ACTION and not allow_wide:
            raise MerlError(
                f"{one}, more than {WIDEST_ACTION:,.0f} apart: set the real bounds of the robot, "
                "or use --env.allow-wide-actions if these bounds are correct"
            )
    if not widths.any():
        raise MerlError(
            f"{actions}: each lower bound equals its upper bound, so there is nothing to learn"
        )
    return low, high


def _channels_first(key: str, shape: tuple[int, ...], layout: ImageLayout) -> bool:
    """Return whether an image with three axes is (C, H, W).

    The channel axis is the smaller one of the first and the last axis, if its size fits.

    Raises:
        MerlError: neither axis has a usual number of channels, or both have.
    """
    if layout != "auto":
        return layout == "chw"
    smaller, larger = sorted((shape[0], shape[2]))
    # A small side may look like many channels; then the other axis must be too large for channels.
    clear = smaller <= FRAMES or larger > 3 * FRAMES
    if smaller == larger or not _is_channels(smaller) or not clear:
        raise MerlError(
            f"observation {key!r} is an image of shape {shape}, and its channel axis is ambiguous: "
            "set --env.image-layout hwc (height, width, channels) or chw (channels, height, width)"
        )
    return shape[0] == smaller


def _is_channels(count: int) -> bool:
    """Return whether images have this many channels: grey, RGB, RGBA, or stacked RGB frames."""
    return count in (1, 4) or (count % 3 == 0 and count <= 3 * FRAMES)


def _pixel_bounds(key: str, space: spaces.Box, channels_first: bool) -> tuple[int, int]:
    """Return the lowest and the highest pixel value, which the encoder maps to -0.5 and 0.5.

    Raises:
        MerlError: the bounds differ between channels, or the lowest is not below the highest.
    """
    axes = (1, 2) if channels_first else (0, 1)
    lows = np.unique(space.low.min(axis=axes))
    highs = np.unique(space.high.max(axis=axes))
    if len(lows) > 1 or len(highs) > 1:
        raise MerlError(
            f"observation {key!r} has channels with the lower bounds {lows.tolist()} and upper "
            f"bounds {highs.tolist()}: use a separate key for channels with other bounds, because "
            "an image is scaled by its bounds"
        )
    low, high = int(lows[0]), int(highs[0])
    if low >= high:
        raise MerlError(
            f"observation {key!r} has pixels from {low} to {high}: set the bounds of its box to "
            "the bounds of its pixels, for example spaces.Box(0, 255, shape, np.uint8)"
        )
    return low, high


def _image_advice(box: spaces.Box) -> str:
    """Return advice on how to convert an image that is not uint8, by the range of its values."""
    low, high = float(box.low.min()), float(box.high.max())
    target = f"in spaces.Box(0, 255, {box.shape}, np.uint8)"
    is_float = np.issubdtype(box.dtype, np.floating)
    if low >= 0 and high <= 1 and is_float:
        return f"an image must be uint8: return (255 * x).astype(np.uint8) {target}"
    if low >= 0 and (high == 255 if is_float else high <= 255):
        return (
            "an image must be uint8: use a box with dtype=np.uint8, and return x.astype(np.uint8)"
        )
    if low >= -1 and high <= 1:
        return f"an image must be uint8: return (127.5 * (x + 1)).astype(np.uint8) {target}"
    if len(box.shape) - box.shape.count(1) == 2:
        return (
            "a depth image needs finite bounds, the nearest distance (at least 0) and the farthest "
            f"one; other numbers can be flattened to a box ({int(np.prod(box.shape))},)"
        )
    return (
        "an image must be uint8: scale by the largest relevant value, "
        f"(255 * np.clip(x / largest, 0, 1)).astype(np.uint8) {target}"
    )
