"""Check the fields of a config against their annotations, which declare choices and ranges.

    @dataclass(frozen=True)
    class ReplayConfig:
        n_step: Annotated[int, Range(1, 1000)] = 3

        def __post_init__(self) -> None:
            check_fields(self, "replay.")

The command line checks types and choices itself. This check also serves Python and `config.json`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from merl.core.errors import MerlError, check_choice

NOT_EMPTY = "not empty"
"""Annotation of a tuple that needs at least one element."""
_KINDS: dict[Any, tuple[Any, str]] = {
    int: (int, "a whole number"),
    float: (int | float, "a number"),
    bool: (bool, "True or False"),
}


@dataclass(frozen=True)
class Range:
    """Annotation of a number that lies between two bounds. NaN and infinity lie in no range.

    Attributes:
        least: the lower bound.
        most: the upper bound.
        without: a bound that does not belong to the range.
    """

    least: float = -math.inf
    most: float = math.inf
    without: float | None = None

    def __contains__(self, value: float) -> bool:
        """Return whether a number lies in the range."""
        return self.least <= value <= self.most and abs(value) < math.inf and value != self.without

    def describe(self, value: float) -> str:
        """Return what a number must be that is not `value`, which lies outside of the range."""
        low = "above" if self.least == self.without else "at least"
        high = "below" if self.most == self.without else "at most"
        words = [] if abs(value) < math.inf else ["finite"]
        words += [f"{low} {self.least:,}"] if self.least > -math.inf else []
        words += [f"{high} {self.most:,}"] if self.most < math.inf else []
        return " and ".join(words)


def check_fields(config: Any, prefix: str = "") -> None:
    """Check the numbers, choices and tuples of a dataclass; `prefix` precedes names in messages.

    Raises:
        MerlError: a value has another type, is unknown, or lies outside of its range.
    """
    cls: type = type(config)
    for name, hint in _hints(cls).items():
        check_value(prefix + name.replace("_", "-"), getattr(config, name), hint)


@cache
def _hints(cls: type) -> Mapping[str, Any]:
    return get_type_hints(cls, include_extras=True)


def check_value(name: str, value: Any, hint: Any, notes: Sequence[Any] = ()) -> None:
    """Check one value against its type and the annotations beside it; see `check_fields`."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        check_value(name, value, parts[0], parts[1:])
    elif origin in (Union, UnionType):
        if value is not None or NoneType not in parts:
            check_value(name, value, parts[0], notes)
    elif origin is Literal:
        check_choice(name, value, parts)
    elif origin is tuple:
        if not isinstance(value, tuple) or (NOT_EMPTY in notes and not value):
            some = "at least one value" if NOT_EMPTY in notes else "values"
            raise MerlError(f"{name} is {value!r}: give a tuple of {some}")
        for item in value:
            check_value(name, item, parts[0])
    elif hint in _KINDS:
        kind, words = _KINDS[hint]
        if not isinstance(value, kind) or (isinstance(value, bool) and hint is not bool):
            raise MerlError(f"{name} must be {words}, not {value!r}")
        bounds = next((note for note in notes if isinstance(note, Range)), Range())
        if value not in bounds:
            raise MerlError(f"{name} must be {bounds.describe(value)}, not {value}")
