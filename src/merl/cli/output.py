"""What all commands print with: no line is broken in a log, no character ends a run."""

from __future__ import annotations

import codecs
import io
import sys
from typing import cast

from rich.console import Console

UNWRAPPED = 10_000
"""Characters of a line where there is no terminal: files and pipes get lines that are whole."""


def make_console() -> Console:
    """Return a console on stdout which wraps lines only on a terminal."""
    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console.width = UNWRAPPED
    return console


def allow_any_character() -> None:
    """Print a question mark for a character that the terminal's encoding lacks.

    The bytes of a file name that could not be decoded are printed as they are.
    """
    codecs.register_error("merl", _encode)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="merl")


def _encode(error: UnicodeError) -> tuple[str | bytes, int]:
    failed = cast(UnicodeEncodeError, error)
    text = failed.object[failed.start : failed.end]
    try:
        return text.encode("ascii", "surrogateescape"), failed.end
    except UnicodeEncodeError:
        return "?" * len(text), failed.end
