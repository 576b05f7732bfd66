"""The console that all commands print to."""

from __future__ import annotations

from rich.console import Console

UNWRAPPED = 10_000
"""Line width where the output is not a terminal, so that files and pipes get whole lines."""


def make_console() -> Console:
    """Return a console on stdout that wraps lines only on a terminal."""
    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console.width = UNWRAPPED
    return console
