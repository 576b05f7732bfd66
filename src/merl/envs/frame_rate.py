"""Frame rate of an environment's videos, from its `metadata`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np

SLOWEST, FASTEST = 0.1, 1000.0
"""Frames per second with which a video can be written and played."""


def frame_rate(metadata: Any) -> float | None:
    """Return `render_fps` in frames a second; None if it is not a usable positive number."""
    try:
        rate = metadata.get("render_fps") if isinstance(metadata, Mapping) else None
    except Exception:  # the user's mapping may raise anything
        return None
    if isinstance(rate, np.ndarray) and rate.size == 1:
        rate = rate.item()
    if not isinstance(rate, Real) or isinstance(rate, bool):
        return None
    try:
        value = float(rate)
    except OverflowError:
        return None
    return value if math.isfinite(value) and SLOWEST <= value <= FASTEST else None
