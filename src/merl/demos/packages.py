"""Packages of the formats of other projects."""

from __future__ import annotations

from importlib.util import find_spec

from merl.core import MerlError


def require(package: str, what: str, extra: str = "demos") -> None:
    """Check that a package is installed.

    Raises:
        MerlError: it is not; the message says how to install it.
    """
    if find_spec(package) is None:
        raise MerlError(f"{what} needs package {package}: pip install 'merl-rl[{extra}]'")
