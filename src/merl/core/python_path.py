"""Keep the working folder out of the module search of Python processes that are started.

Libraries start processes by `python -c`, which searches the working folder before the standard
library. That folder may be the run of a stranger.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLE = "PYTHONSAFEPATH"
_users_values: list[str | None] = []
"""What the user had set, for each `working_folder_hidden` that is active."""


@contextmanager
def working_folder_hidden() -> Iterator[None]:
    """Start Python processes that do not look for modules in the working folder."""
    _users_values.append(os.environ.get(_VARIABLE))
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        set_value(_users_values.pop())


def users_value() -> str | None:
    """Return the value that the user has set."""
    return _users_values[0] if _users_values else os.environ.get(_VARIABLE)


def set_value(value: str | None) -> None:
    """Set the variable; None removes it."""
    if value is None:
        os.environ.pop(_VARIABLE, None)
    else:
        os.environ[_VARIABLE] = value
