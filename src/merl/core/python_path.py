"""Stop child Python processes from importing modules from the working folder.

Libraries start processes with `python -c`, which searches the working folder before the standard
library. That folder may be an untrusted run folder.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLE = "PYTHONSAFEPATH"
_users_values: list[str | None] = []
"""Earlier values of the variable, one for each active `working_folder_hidden`."""


@contextmanager
def working_folder_hidden() -> Iterator[None]:
    """Hide the working folder from the module search of processes started in the block."""
    _users_values.append(os.environ.get(_VARIABLE))
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        set_value(_users_values.pop())


def users_value() -> str | None:
    """Return the value that the user has set; None if the variable is not set."""
    return _users_values[0] if _users_values else os.environ.get(_VARIABLE)


def set_value(value: str | None) -> None:
    """Set `PYTHONSAFEPATH`; None removes it."""
    if value is None:
        os.environ.pop(_VARIABLE, None)
    else:
        os.environ[_VARIABLE] = value
