"""The command line.

docs/reference/exit_codes.md explains the exit codes.
"""

from __future__ import annotations

import errno
import logging
import os
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import merl
from merl.core import MerlError, suggest
from merl.core.output import tolerant_output
from merl.core.python_path import working_folder_hidden

# A module is imported when its command runs: a misspelt command does not wait for torch.
COMMANDS = {
    "train": ("merl.cli.train", "train", "train an agent"),
    "resume": ("merl.cli.resume", "resume", "resume a run"),
    "evaluate": ("merl.cli.evaluate", "evaluate", "evaluate a trained policy, record a video"),
    "tasks": ("merl.cli.tasks", "tasks", "list the tasks"),
    "info": ("merl.cli.info", "info", "show versions, hardware and measured speed"),
    "bench": ("merl.cli.bench", "bench", "compare merl's speed with a reference"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    A command continues if its output cannot be written. A command that only prints then returns a
    nonzero exit code.
    """
    args = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with tolerant_output() as (out, _), working_folder_hidden():
            code = _run(args)
    except SystemExit:  # tyro exits after it has printed the help
        if out.error is None:
            raise
        code = 0
    if code != 0 or out.error is None or (args[:1] in _TRAINING and not _asks_help(args)):
        return code
    if out.error.errno == errno.EPIPE:
        return 128 + signal.SIGPIPE
    with tolerant_output():
        reason = out.error.strerror
        print(f"merl: error: the output could not be written: {reason}", file=sys.stderr)
    return MerlError.exit_code


_TRAINING = (["train"], ["resume"])
"""Commands that do more than print; lost output does not change their exit code."""


def _asks_help(args: Sequence[str]) -> bool:
    return "-h" in args or "--help" in args


def _run(args: list[str]) -> int:
    warnings.showwarning = _show_warning
    logging.basicConfig(format="merl: %(levelname)s: %(message)s", level=logging.WARNING)
    logging.addLevelName(logging.WARNING, "warning")
    try:
        if not args or args[0] in ("-h", "--help"):
            print(_usage())
            return 0
        if args[0] == "--version":
            print(f"merl {merl.__version__}")
            return 0
        if args[0] not in COMMANDS:
            raise MerlError(f"command {args[0]!r} is unknown: {suggest(args[0], COMMANDS)}")
        module, name, _ = COMMANDS[args[0]]
        code: int = getattr(import_module(module), name)(args[1:])
        return code
    except MerlError as error:
        if os.environ.get("MERL_TRACEBACK"):
            traceback.print_exc()
        print(f"merl: error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt as stop:
        return 128 + getattr(stop, "number", signal.SIGINT)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning in one line, without its source location; skip DeprecationWarning."""
    if issubclass(category, DeprecationWarning):
        return
    text = " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(message)).split())  # without terminal colours
    if text:
        print(f"merl: warning: {text}", file=sys.stderr)


def _usage() -> str:
    lines = [f"  {name:<10}{about}" for name, (_, _, about) in COMMANDS.items()]
    return "\n".join(
        ["usage: merl COMMAND ...", "", *lines, "", "merl COMMAND --help shows its options."]
    )
