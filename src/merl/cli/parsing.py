"""Parse the command line with tyro and report its errors in one line."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import tyro
from tyro import _errors  # no public hook for errors yet: pyproject.toml pins the version

from merl.core import MerlError, suggest
from merl.core.fields import check_fields

T = TypeVar("T")


@dataclass(frozen=True)
class OpenOptions:
    """Options of the commands that open a run."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    trust: tyro.conf.FlagCreatePairsOff[bool] = False
    """Import the environment, agent and encoders that the run names, although you have not trained
    this run here. This runs the code of the run's author."""

    def __post_init__(self) -> None:
        check_fields(self, "--")


@dataclass(frozen=True)
class PolicyOptions(OpenOptions):
    """Options of the commands that load a policy."""

    checkpoint: str = "latest"
    """latest, best (the highest evaluation return), or the step of a checkpoint."""


def parse(
    options: type[T],
    prog: str,
    args: list[str],
    default: T | None = None,
    *,
    rest: list[str] | None = None,
) -> T:
    """Parse arguments with tyro.

    Args:
        options: the dataclass that the flags are made from.
        prog: the name of the command, for help and errors.
        args: the arguments after the command's name.
        default: an instance with the default values.
        rest: gets the arguments that belong to other options; None: there must be none.

    Raises:
        MerlError: the arguments are invalid; the message is one line.
    """

    def fail(event: _errors.ParseErrorEvent) -> None:
        if isinstance(event, _errors.BadValue) and event.argument.is_positional():
            # An option that tyro does not know stands where this argument is expected: with
            # something in its place, tyro names the option.
            parse(options, prog, ["-", *args], default)
        message = _message(event, options if default is None else default)
        if message is not None:
            raise MerlError(message) from None

    with _errors.on_parse_error(fail):
        if rest is not None:
            found, others = tyro.cli(
                options, prog=prog, args=args, add_help=False, return_unknown_args=True
            )
            rest += others
            return found
        given: Any = tyro.MISSING_NONPROP if default is None else default
        parsed: T = tyro.cli(options, prog=prog, args=args, default=given)
        return parsed


def _message(event: _errors.ParseErrorEvent, options: Any) -> str | None:
    """Return one line about an error; None leaves the message to tyro."""
    match event:
        case _errors.MissingArgs(unrecognized_tokens=tokens) if tokens:
            return _unknown(tokens, event.prog, options)
        case _errors.MissingArgs(missing_arguments=missing):
            names = ", ".join(each.arg.lowered.metavar or "" for each in missing)
            return f"missing from {event.prog}: {names}"
        case _errors.UnrecognizedArgs(tokens=tokens):
            return _unknown(tokens, event.prog, options)
        case _errors.InvalidChoice(argument=argument, value=value, choices=choices):
            known = sorted({*choices} - {"None"})  # None: omit the flag
            return f"{argument.display_name()} {value!r} is unknown: {suggest(value, known)}"
        case _errors.BadValue(argument=argument):
            return f"{argument.display_name()} needs a value: {argument.lowered.metavar}"
        case _errors.InstantiationFailure(argument=argument, message=reason) if argument:
            last = reason.splitlines()[-1]
            last = last.partition(": ")[2] if last.startswith("- ") else last  # "- TYPE: REASON"
            return f"{argument.display_name()} takes {argument.lowered.metavar}: {last}"
    return None


def _unknown(tokens: list[str], prog: str, options: Any) -> str:
    named = [token for token in tokens if token.startswith("-")] or tokens
    flag = named[0].partition("=")[0]
    known = list(_flags(options))
    hint = suggest(flag, known)
    if hint.startswith("choose"):
        hint = f"{prog} --help lists all options"
    return f"unrecognized options: {', '.join(named)}: {hint}"


def _flags(options: Any, prefix: str = "") -> Iterator[str]:
    """Yield the flags that tyro makes from a dataclass or an instance of it."""
    cls = options if isinstance(options, type) else type(options)
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind, *notes = get_args(hint) or (hint,)
        inner = getattr(options, name, kind)
        given = [note.name for note in notes if getattr(note, "name", None) is not None]
        name = given[0] if given else name
        if dataclasses.is_dataclass(kind):
            yield from _flags(inner, f"{prefix}{name}." if name else prefix)
        else:
            yield f"--{prefix}{name}".replace("_", "-")


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
