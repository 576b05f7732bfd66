"""The console that all commands print to."""

from __future__ import annotations

from rich.console import Console

UNWRAPPED = 10_000
"""Characters of a line where there is no terminal: files and pipes get whole lines."""


def make_console() -> Console:
    """Return a console on stdout which wraps lines only on a terminal."""
    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console.width = UNWRAPPED
    return console
