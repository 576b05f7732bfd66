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


def say(console: Console, line: str, style: str | None = None) -> None:
    """Print a line without line breaks of its own, so that paths and commands can be copied."""
    console.print(line, soft_wrap=True, style=style)
