"""Textures for the rasteriser: mipmap levels, concatenated in one array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class Textures:
    """All textures of a model.

    Attributes:
        levels: (start, width, height) of each mipmap level; `start` is the index of its first
            texel.
    """

    def __init__(self) -> None:
        self.levels: list[tuple[int, int, int]] = []
        self._texels: list[Array] = [np.zeros((1, 3))]
        self._added: dict[int, tuple[int, int]] = {}

    def add(self, model: Any, texture: int) -> tuple[int, int]:
        """Append the mipmap levels of a texture, unless they were appended before.

        Returns:
            The index of the first level, and the number of levels.
        """
        if texture not in self._added:
            image, first = pixels(model, texture), len(self.levels)
            self._append(image)
            while max(image.shape[:2]) > 1:
                image = halved(image)
                self._append(image)
            self._added[texture] = first, len(self.levels) - first
        return self._added[texture]

    def add_sky(self, model: Any, texture: int) -> int:
        """Append a cube map, whose six faces are stacked vertically; return its level."""
        image = pixels(model, texture)
        faces = 6 if image.shape[0] == image.shape[1] else 1  # one image for all faces
        self._append(np.concatenate([image] * faces))
        return len(self.levels) - 1

    def texels(self) -> Array:
        """Return the texels of all levels, float32 (X, 3), in [0, 1]."""
        return np.concatenate(self._texels).astype(np.float32)

    def _append(self, image: Array) -> None:
        start = sum(len(texels) for texels in self._texels)
        self.levels.append((start, image.shape[1], image.shape[0]))
        self._texels.append(image.reshape(-1, 3))


def pixels(model: Any, texture: int) -> Array:
    """Return a texture of the model as (height, width, 3), in [0, 1]."""
    shape = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    data = model.tex_data[start : start + shape[0] * shape[1] * channels]
    image = data.reshape(*shape, channels).astype(np.float64) / 255
    return image[:, :, :3] if channels >= 3 else np.repeat(image[:, :, :1], 3, axis=2)


def halved(image: Array) -> Array:
    """Return an image of half the size (rounded down, at least 1), averaged over areas."""
    for axis in (0, 1):
        count = image.shape[axis]
        half = max(1, count // 2)
        edges = np.linspace(0, count, half + 1)
        sums = np.concatenate([np.zeros_like(image.take([0], axis)), image.cumsum(axis)], axis)
        lower = np.floor(edges).astype(int)
        share = np.expand_dims(edges - lower, tuple({0, 1, 2} - {axis}))
        upper = np.minimum(lower + 1, count)
        at_edges = sums.take(lower, axis) * (1 - share) + sums.take(upper, axis) * share
        image = np.diff(at_edges, axis=axis) * (half / count)
    return image
