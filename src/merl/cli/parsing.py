"""Reading the command line: tyro's parser, with its errors in one line."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import tyro

from merl.core import MerlError

T = TypeVar("T")


def parse(target: Callable[..., T], prog: str, args: list[str], **options: Any) -> T:
    """Tyro's parser, with its errors in one line."""
    try:
        return _parsed(target, prog, args, options)
    except MerlError as error:
        # Tyro takes what follows an unknown flag for the flag's, and then finds it missing.
        if str(error).startswith("missing value for argument"):
            try:
                _parsed(target, prog, ["x", *args], options)
            except MerlError as other:
                if str(other).startswith("unrecognized"):
                    raise other from None
        raise


def _parsed(target: Callable[..., T], prog: str, args: list[str], options: dict[str, Any]) -> T:
    errors = io.StringIO()
    columns = os.environ.get("COLUMNS")
    asks_help = any(arg in ("-h", "--help") for arg in args)
    try:
        if not asks_help:
            os.environ["COLUMNS"] = "1000"  # or the message would be broken into lines
        with contextlib.redirect_stderr(errors):
            parsed: T = tyro.cli(target, prog=prog, args=args, **options)
            return parsed
    except SystemExit as stop:
        if not stop.code:
            raise
        raise MerlError(_one_line(errors.getvalue())) from None
    finally:
        if columns is None:
            os.environ.pop("COLUMNS", None)
        else:
            os.environ["COLUMNS"] = columns


def _one_line(box: str) -> str:
    """The message of tyro's framed error, and the first flag that it thinks was meant.

    Rules part the frame; the title stands in the frame itself, or, where the terminal knows ASCII
    alone, in a part of its own.
    """
    lines = [line.strip().strip("│|").strip() for line in box.splitlines()]
    parts: list[list[str]] = [[]]
    for line in lines:
        if line.startswith("╭") or (line and not set(line) - set("─-")):
            parts.append([])
        elif line and not line.startswith("╰"):
            parts[-1].append(line)
    message = " ".join(parts[1]) if len(parts) > 1 else ""
    if not message:
        return " ".join(box.split())
    message = message[0].lower() + message[1:]
    message = re.sub(r"\('[^()]*'\)", _choices, message)
    if "erhaps you meant" in box:
        flags = [match for line in lines if (match := re.match(r"--\w[\w.-]*", line))]
        if flags:
            message += f": did you mean {flags[0].group()}?"
    return message


def _choices(listed: re.Match[str]) -> str:
    """The choices in order; None is no choice: a flag is left out, not set to it."""
    names = sorted(set(re.findall(r"'([^']*)'", listed.group())) - {"None"})
    return f"({', '.join(map(repr, names))})"


def check_writable(path: Path | None) -> None:
    """See to it, before long work, that a file can be written that the user asked for.

    Raises:
        MerlError: it cannot.
    """
    if path is None:
        return
    try:
        there = os.path.lexists(path)
        path.open("a").close()
        if not there:
            path.unlink()
    except OSError as error:
        raise _unwritable(path, error) from None


def write_json(path: Path, value: Any) -> None:
    """Write a file that the user asked for.

    Raises:
        MerlError: it cannot be written.
    """
    try:
        path.write_text(json.dumps(value, indent=1) + "\n")
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> MerlError:
    return MerlError(
        f"{path} cannot be written: {error.strerror}: name a file in a folder that is there"
    )
