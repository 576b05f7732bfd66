"""Parse the command line with tyro and report its errors in one line."""

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
    """Parse arguments with tyro.

    Args:
        target: the class or function that the flags are made from.
        prog: the name of the command, for help and errors.
        args: the arguments after the command's name.
        options: further arguments of `tyro.cli`.

    Raises:
        MerlError: the arguments are invalid; the message is one line.
    """
    try:
        return _parsed(target, prog, args, options)
    except MerlError as error:
        # Tyro takes the argument after an unknown flag as its value and then misses that argument.
        # With one argument more, tyro names the unknown flag.
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
            os.environ["COLUMNS"] = "1000"  # tyro must not wrap the message
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
    """Return the message of tyro's framed error and the first flag that tyro suggests.

    Horizontal rules divide the frame into parts. The title is in the frame's top line, or, on a
    terminal with ASCII only, in its own part.
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
    """Return the choices in order, without None: None means that the flag is omitted."""
    names = sorted(set(re.findall(r"'([^']*)'", listed.group())) - {"None"})
    return f"({', '.join(map(repr, names))})"


def check_writable(path: Path | None) -> None:
    """Check before a long computation that its output file can be written.

    Raises:
        MerlError: the file cannot be written.
    """
    if path is None:
        return
    try:
        existed = os.path.lexists(path)
        path.open("a").close()
        if not existed:
            path.unlink()
    except OSError as error:
        raise _unwritable(path, error) from None


def write_json(path: Path, value: Any) -> None:
    """Write a value to a JSON file.

    Raises:
        MerlError: the file cannot be written.
    """
    try:
        path.write_text(json.dumps(value, indent=1) + "\n")
    except OSError as error:
        raise _unwritable(path, error) from None


def _unwritable(path: Path, error: OSError) -> MerlError:
    return MerlError(
        f"{path} cannot be written: {error.strerror}: name a file in an existing folder"
    )
