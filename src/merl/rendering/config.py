"""Renderers by name, and the sizes of their images."""

from __future__ import annotations

from typing import Annotated, Literal

from merl.core import MerlError
from merl.core.fields import Range

RendererName = Literal["gl", "raster"]
Samples = Annotated[int, Range(1, 4)]
LARGEST_IMAGE = 2048
"""Most pixels along an edge of an image."""


def check_samples(samples: int, size: int) -> None:
    """Reject more samples along an edge of an image of `size` pixels than `LARGEST_IMAGE`.

    Raises:
        MerlError: naming the values and the bound.
    """
    if samples * size > LARGEST_IMAGE:
        raise MerlError(
            f"samples is {samples} at {size} pixels, which is {samples * size} samples along an "
            f"edge of the image: at most {LARGEST_IMAGE} are possible, so use fewer samples or a "
            "smaller image"
        )
