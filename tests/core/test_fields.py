"""The check of a config's fields against their annotations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest

from merl.core import MerlError
from merl.core.fields import NOT_EMPTY, Range, check_fields


@dataclass(frozen=True)
class Config:
    colour: Literal["red", "green"] = "red"
    other: Literal["red", "green"] | None = None
    big_count: Annotated[int, Range(1, 1024)] = 1
    share: Annotated[float, Range(0, 1, without=0)] = 1
    below: Annotated[float, Range(0, 1, without=1)] = 0
    limit: Annotated[float, Range(0, without=0)] | None = None
    any_number: float = -1e9
    flag: bool = False
    strides: Annotated[tuple[Annotated[int, Range(1)], ...], NOT_EMPTY] = (1,)
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self, "part.")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("colour", "gren", "part.colour 'gren' is unknown: did you mean 'green'?"),
        ("other", "blue", "part.other 'blue' is unknown: choose from red, green"),
        ("big_count", 1025, "part.big-count must be at least 1 and at most 1,024, not 1025"),
        ("big_count", 2.0, "part.big-count must be a whole number, not 2.0"),
        ("big_count", True, "part.big-count must be a whole number, not True"),
        ("big_count", None, "part.big-count must be a whole number, not None"),
        ("share", 0, "part.share must be above 0 and at most 1, not 0"),
        ("share", "1", "part.share must be a number, not '1'"),
        ("below", 1.0, "part.below must be at least 0 and below 1, not 1.0"),
        ("limit", float("inf"), "part.limit must be finite and above 0, not inf"),
        ("any_number", float("nan"), "part.any-number must be finite, not nan"),
        ("flag", 1, "part.flag must be True or False, not 1"),
        ("strides", (), "part.strides is (): give a tuple of at least one value"),
        ("strides", (2, 0), "part.strides must be at least 1, not 0"),
        ("names", "image", "part.names is 'image': give a tuple of values"),
    ],
)
def test_a_bad_value_is_named_with_its_range(field: str, value: Any, message: str) -> None:
    with pytest.raises(MerlError) as error:
        Config(**{field: value})
    assert str(error.value) == message


def test_values_at_the_bounds_are_accepted() -> None:
    Config(other="green", big_count=1024, share=1e-9, below=0.999, limit=1, strides=(1, 2, 3))
