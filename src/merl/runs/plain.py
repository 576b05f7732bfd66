"""Conversion of configs and spaces to plain types for JSON, and back."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces

T = TypeVar("T")


def to_plain(config: Any) -> dict[str, Any]:
    """Convert a config to plain types for JSON."""
    plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    return plain


def from_plain(cls: type[T], plain: Mapping[str, Any], **narrower: type) -> T:
    """Restore a config from `to_plain()`; missing fields take their defaults.

    Args:
        cls: the dataclass.
        plain: the values of its fields.
        **narrower: for a field that is annotated with a base class, the subclass to restore.

    Raises:
        TypeError: a field is unknown, or not an object. Unknown fields are not ignored, since the
            run would then silently change.
        MerlError: a value is rejected by the config.
    """
    hints = typing.get_type_hints(cls) | narrower
    for name in plain:
        if name not in hints:
            raise TypeError(f"{name} is unknown to this version of merl")
    return cls(**{name: _restore(name, hints[name], value) for name, value in plain.items()})


def _restore(name: str, hint: Any, value: Any) -> Any:
    """Restore a value; the config itself checks its type (`merl.core.fields`)."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        if value is None:
            return None
        hint = typing.get_args(hint)[0]
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise TypeError(f"{name} is {value!r}, not an object with its fields")
        return from_plain(typing.cast(type[Any], hint), value)
    if typing.get_origin(hint) is tuple and isinstance(value, list):
        return tuple(_restore(name, typing.get_args(hint)[0], part) for part in value)
    return Path(value) if hint is Path else value


def told(described: Mapping[str, Any]) -> str:
    """Return type and shape of a box as text; for uint8 also the bounds, which scale an image."""
    words = f"{described['dtype']} {tuple(described['shape'])}"
    if described["dtype"] == "uint8" and described["bounds"]:
        words += " from {:g} to {:g}".format(*described["bounds"])
    return words


def describe(space: spaces.Space[Any]) -> dict[str, Any]:
    """Return shape, type and bounds of a box as plain types.

    The bounds are None if they are not finite, since JSON has no infinity.
    """
    assert isinstance(space, spaces.Box)
    bounds = (float(space.low.min()), float(space.high.max()))
    return {
        "shape": list(space.shape),
        "dtype": str(space.dtype),
        "bounds": bounds if np.isfinite(bounds).all() else None,
    }


def box(described: Mapping[str, Any]) -> spaces.Box:
    """Restore a box from `describe()`."""
    dtype: Any = np.dtype(described["dtype"]).type
    low, high = described["bounds"] or (-np.inf, np.inf)
    return spaces.Box(low, high, tuple(described["shape"]), dtype)
