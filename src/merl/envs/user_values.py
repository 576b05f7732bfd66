"""Check the values that a user's environment returns, and convert them to Python and NumPy types.

Every function that rejects a value raises `EnvironmentFailed` with one line that names the value.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import EnvironmentFailed

_LONGEST = 80
"""Maximum number of characters of a value in a message."""


def shown(value: Any) -> str:
    """Return a value as one short line, for a message."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # the user's own __repr__ may fail
        text = f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def to_array(name: str, value: Any) -> NDArray[Any]:
    """Convert a value to an array of numbers or booleans; tensors are copied to the host.

    Args:
        name: name of the value, for the message.
        value: an array, a tensor of any device, a number, or nested lists of these.

    Raises:
        EnvironmentFailed: NumPy cannot convert the value, or not all of it is real numbers.
    """
    try:
        try:
            array = np.asarray(value)
        except Exception:  # a tensor with gradients, or on another device
            array = np.asarray(_on_host(value))
    except Exception as error:  # the library that made the value may raise anything
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise EnvironmentFailed(
            f"{name} cannot be converted to an array of numbers ({reason}): it is {shown(value)}"
        ) from None
    if np.ma.is_masked(value):
        raise EnvironmentFailed(
            f"{name} has masked values: fill them, for example with value.filled(0.0)"
        )
    if array.dtype.kind == "O" and all(isinstance(part, Real) for part in array.flat):
        array = array.astype(np.float64)
    if array.dtype.kind not in "biuf":
        raise EnvironmentFailed(f"{name} contains a value that is not a number: {shown(value)}")
    return array


def to_number(name: str, value: Any) -> float:
    """Convert a number, or an array of exactly one, to a float.

    Raises:
        EnvironmentFailed: the value has another form.
    """
    try:
        array = to_array(name, value)
    except EnvironmentFailed:
        raise EnvironmentFailed(
            f"the environment's {name} is {shown(value)}: it must be a number"
        ) from None
    if array.size != 1:
        raise EnvironmentFailed(
            f"the environment's {name} is {shown(value)}, {array.size} values: it must be a "
            "number, for example their weighted sum"
        )
    return float(array.item())


def to_bool(name: str, value: Any) -> bool:
    """Convert a bool, 0, 1, or an array of exactly one of these, to a bool.

    Raises:
        EnvironmentFailed: the value has another form; Python would treat a string or NaN as true.
    """
    try:
        array = to_array(name, value)
    except EnvironmentFailed:
        array = np.empty(0)
    if array.size != 1 or array.item() not in (0, 1):
        raise EnvironmentFailed(
            f"the environment's {name} is {shown(value)}: it must be true or false (or 1 or 0)"
        )
    return bool(array.item())


def to_info(info: Any) -> dict[str, Any]:
    """Copy `info`, and convert `success` to a bool and `reward_terms` to numbers if present.

    `is_success` is another name for `success`; both may be a dict with the key `task`.

    Raises:
        EnvironmentFailed: `info` is not a dict, or one of these entries has another form.
    """
    if not isinstance(info, Mapping):
        raise EnvironmentFailed(f"the environment's info is {shown(info)}: it must be a dict")
    checked = dict(info)
    for key in ("success", "is_success"):
        if key in info:
            checked["success"] = _success(key, info[key])
            break
    if "reward_terms" in info:
        terms = info["reward_terms"]
        if not isinstance(terms, Mapping):
            raise EnvironmentFailed(
                f'the environment\'s info["reward_terms"] is {shown(terms)}: it must be a dict of '
                "numbers"
            )
        for name in terms:
            if not str(name).isprintable():  # it names a column of the metrics
                raise EnvironmentFailed(
                    f"the environment's reward term {shown(name)} has a line break or another "
                    "character that cannot be printed in its name: rename it"
                )
        checked["reward_terms"] = {
            str(name): to_number(f"reward term {name!r}", value) for name, value in terms.items()
        }
    return checked


def _success(key: str, value: Any) -> bool:
    name = f'info["{key}"]'
    if isinstance(value, Mapping):
        if "task" not in value:
            raise EnvironmentFailed(
                f"the environment's {name} is {shown(value)}: a dict needs the key 'task' with "
                "true or false"
            )
        name, value = f'{name}["task"]', value["task"]
    return to_bool(name, value)


def _on_host(value: Any) -> Any:
    """Replace torch tensors, also in lists, by arrays in host memory, without gradients."""
    if isinstance(value, list | tuple):
        return [_on_host(part) for part in value]
    if not callable(getattr(value, "detach", None)):
        return value
    tensor = value.detach().cpu()
    # NumPy has no bfloat16; float32 represents all of its values exactly.
    return (tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy()
