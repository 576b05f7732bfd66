"""Spaces of a user's environment: which ones agents can use, how, and what to change otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import EnvironmentFailed, MerlError, is_image
from merl.envs.config import ImageLayout
from merl.envs.user_values import to_array

WIDEST_ACTION = 1e6
"""Distance between an action's bounds from which on they are taken for placeholders."""
FRAMES = 12
"""Stacked RGB frames that an image may have as channels."""
IMAGE_SIDE = 16
"""Pixels: a box of real numbers with two such sides is taken for an image in messages."""
BYTES = (0, 255)


@dataclass(frozen=True)
class Modality:
    """One observation key of an environment, and the form in which agents take it.

    Attributes:
        key: its name.
        given: the environment's box.
        space: what agents take: an image, uint8 (H, W, C), or a vector, float32 (n,).
        channels_first: the environment's image is (C, H, W).
    """

    key: str
    given: spaces.Box
    space: spaces.Box
    channels_first: bool = False

    @cached_property
    def bounds(self) -> tuple[int, int]:
        """The lowest and the highest pixel of an image."""
        return int(self.space.low.min()), int(self.space.high.max())

    def convert(self, value: Any) -> NDArray[Any]:
        """Bring an observation into the form of `space`.

        Raises:
            EnvironmentFailed: it is not what `given` says, in one line.
        """
        name = f"observation {self.key!r}"
        array = to_array(name, value)
        if (*array.shape, 1) == self.given.shape:
            array = array[..., None]
        if array.shape != self.given.shape:
            raise EnvironmentFailed(
                f"{name} has shape {array.shape}, but its space says {self.given.shape}"
            )
        if is_image(self.space):
            return self._as_image(name, array)
        if array.dtype == np.float32:
            return array.reshape(self.space.shape)
        with np.errstate(over="ignore"):
            vector = array.astype(np.float32).reshape(self.space.shape)
        lost = np.flatnonzero(np.isinf(vector) & ~np.isinf(array.reshape(vector.shape)))
        if len(lost):
            raise EnvironmentFailed(
                f"{name} is {array.flat[lost[0]]} in place {lost[0]}, which is beyond float32: use "
                "other units, or clip it"
            )
        return vector

    def _as_image(self, name: str, array: NDArray[Any]) -> NDArray[np.uint8]:
        low, high = self.bounds
        if array.dtype != np.uint8:
            raise EnvironmentFailed(
                f"{name} is of {array.dtype}, but its space says uint8: give pixels from {low} to "
                f"{high} as np.uint8"
            )
        if (low, high) != BYTES and (array.min() < low or array.max() > high):
            raise EnvironmentFailed(
                f"{name} has pixels from {array.min()} to {array.max()}, but its space says {low} "
                f"to {high}: give its box the bounds of its pixels"
            )
        moved = np.moveaxis(array, 0, -1) if self.channels_first else array
        return moved.reshape(self.space.shape)


def modality(key: str, space: spaces.Space[Any], layout: ImageLayout) -> Modality | None:
    """How agents take an observation key; None if they cannot, see `advice`.

    Args:
        key: its name.
        space: what the environment gives.
        layout: order of the axes of images.

    Raises:
        MerlError: an image's layout is ambiguous, or its bounds are unusable.
    """
    if not isinstance(space, spaces.Box) or 0 in space.shape:
        return None
    pixels = space.dtype == np.uint8
    if len(space.shape) - space.shape.count(1) <= 1 and not (pixels and len(space.shape) == 3):
        with np.errstate(over="ignore"):  # float64 bounds beyond float32 are none
            lows, highs = (b.astype(np.float32).reshape(-1) for b in (space.low, space.high))
        return Modality(key, space, spaces.Box(lows, highs, dtype=np.float32))
    if not pixels or len(space.shape) not in (2, 3):
        return None
    channels_first = len(space.shape) == 3 and _channels_first(key, space.shape, layout)
    shape = (*space.shape[1:], space.shape[0]) if channels_first else space.shape
    if len(shape) == 2:
        shape = (*shape, 1)
    low, high = _pixel_bounds(key, space, channels_first)
    return Modality(key, space, spaces.Box(low, high, shape, np.uint8), channels_first)


def advice(space: spaces.Space[Any]) -> str:
    """What to give in place of a space that agents cannot use."""
    if isinstance(space, spaces.Discrete):
        return f"give it as one-hot, a float32 box of {space.n} numbers"
    if isinstance(space, spaces.MultiDiscrete):
        return "give each of its numbers as one-hot, all in one float32 box"
    if isinstance(space, spaces.MultiBinary):
        return "give it as a box from 0 to 1, of dtype float32 for flags or np.uint8 for an image"
    if isinstance(space, spaces.Dict):
        return "it is nested: give each of its entries a key of its own in the outer Dict"
    if isinstance(space, spaces.Tuple):
        return "give its parts in a spaces.Dict, each with a key"
    if not isinstance(space, spaces.Box):
        return "give what it says in numbers, as a box"
    if 0 in space.shape:
        return "it holds no numbers"
    image_like = sorted(space.shape)[-2] >= IMAGE_SIDE
    if len(space.shape) > 3 and image_like:
        return (
            "merl stacks the frames of an image by itself: leave out the wrapper that stacks them, "
            "and set --replay.frame-stack"
        )
    if image_like:
        return _image_advice(space)
    size = int(np.prod(space.shape))
    return (
        "merl stacks the frames of images by itself, so leave out a wrapper that stacks; to keep a "
        f"history or a table of numbers, flatten it to a box ({size},)"
    )


def brief(space: spaces.Space[Any]) -> str:
    """A space in one short line."""
    if isinstance(space, spaces.Box) and space.shape and 0 not in space.shape:
        low, high = float(space.low.min()), float(space.high.max())
        return f"a {space.dtype} box {space.shape} from {low:.6g} to {high:.6g}"
    text = " ".join(str(space).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def action_bounds(
    space: spaces.Space[Any], allow_wide: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The lower and the upper bound of each action, (A,).

    Args:
        space: the environment's actions.
        allow_wide: accept a range above `WIDEST_ACTION`.

    Raises:
        MerlError: agents cannot act in it.
    """
    actions = f"the environment's actions are {brief(space)}"
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.floating):
        raise MerlError(f"{actions}: an agent here gives a box of real numbers (n,), as np.float32")
    if len(space.shape) != 1 or space.shape[0] == 0:
        size = max(1, int(np.prod(space.shape)))
        raise MerlError(
            f"{actions}: an agent here gives a box of real numbers (n,): make it ({size},), and "
            "reshape the action in `step`"
        )
    with np.errstate(over="ignore"):
        # In the actions' own type, which is what the environment is given.
        low, high = (b.astype(space.dtype).astype(np.float64) for b in (space.low, space.high))
        widths = high - low
    for index, (lowest, highest, width) in enumerate(zip(low, high, widths, strict=True)):
        one = f"the environment's action {index} has the bounds {lowest:.6g} and {highest:.6g}"
        if not np.isfinite([lowest, highest, width]).all():
            raise MerlError(f"{one}: give them finite bounds, which are scaled to [-1, 1]")
        if width < 0:
            raise MerlError(f"{one}: the lower one is above the upper one")
        if width > WIDEST_ACTION and not allow_wide:
            raise MerlError(
                f"{one}, more than {WIDEST_ACTION:,.0f} apart: give the bounds that the robot has; "
                "if these are meant, say --env.allow-wide-actions"
            )
    if not widths.any():
        raise MerlError(f"{actions}: every lower bound is the upper one, there is nothing to learn")
    return low, high


def _channels_first(key: str, shape: tuple[int, ...], layout: ImageLayout) -> bool:
    """Whether an image of three axes is (C, H, W): the smaller end is the channels, if it can be.

    Raises:
        MerlError: neither end is a usual number of channels, or both are.
    """
    if layout != "auto":
        return layout == "chw"
    smaller, larger = sorted((shape[0], shape[2]))
    # An image may be as small as many channels: then the other end must be too large for channels.
    clear = smaller <= FRAMES or larger > 3 * FRAMES
    if smaller == larger or not _is_channels(smaller) or not clear:
        raise MerlError(
            f"observation {key!r} is an image of shape {shape}, and which axis has the channels is "
            "not clear: say --env.image-layout hwc (height, width, channels) or chw (channels, "
            "height, width)"
        )
    return shape[0] == smaller


def _is_channels(count: int) -> bool:
    """Whether images have so many: grey, RGB, RGBA, or stacked RGB frames."""
    return count in (1, 4) or (count % 3 == 0 and count <= 3 * FRAMES)


def _pixel_bounds(key: str, space: spaces.Box, channels_first: bool) -> tuple[int, int]:
    """The lowest and the highest pixel, which the encoder brings to -0.5 and 0.5.

    Raises:
        MerlError: they differ between channels, or are the same.
    """
    axes = (1, 2) if channels_first else (0, 1)
    lows = np.unique(space.low.min(axis=axes))
    highs = np.unique(space.high.max(axis=axes))
    if len(lows) > 1 or len(highs) > 1:
        raise MerlError(
            f"observation {key!r} has channels with the lower bounds {lows.tolist()} and upper "
            f"bounds {highs.tolist()}: give channels of other bounds a key of their own, since an "
            "image is scaled by its bounds"
        )
    low, high = int(lows[0]), int(highs[0])
    if low >= high:
        raise MerlError(
            f"observation {key!r} has pixels from {low} to {high}: give its box the bounds of its "
            "pixels, for example spaces.Box(0, 255, shape, np.uint8)"
        )
    return low, high


def _image_advice(box: spaces.Box) -> str:
    """How to give an image that is not uint8, by the range of its values."""
    low, high = float(box.low.min()), float(box.high.max())
    target = f"in spaces.Box(0, 255, {box.shape}, np.uint8)"
    is_float = np.issubdtype(box.dtype, np.floating)
    if low >= 0 and high <= 1 and is_float:
        return f"an image is uint8: give (255 * x).astype(np.uint8) {target}"
    if low >= 0 and (high == 255 if is_float else high <= 255):
        return "an image is uint8: give its box dtype=np.uint8, and x.astype(np.uint8)"
    if low >= -1 and high <= 1:
        return f"an image is uint8: give (127.5 * (x + 1)).astype(np.uint8) {target}"
    return (
        "an image is uint8: scale by the largest value that matters, for a depth image the largest "
        f"distance, (255 * np.clip(x / largest, 0, 1)).astype(np.uint8) {target}; other numbers "
        f"can be flattened to a box ({int(np.prod(box.shape))},)"
    )
