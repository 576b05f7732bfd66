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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import merl
from merl.core import MerlError, suggest
from merl.core.files import cause
from merl.core.output import tolerant_output
from merl.core.python_path import working_folder_hidden
from merl.core.watching import end_soon

COMMANDS = {
    "train": "train an agent on a task",
    "resume": "continue a run that was stopped",
    "learner": "train with actors on other machines, e.g. a robot's computer",
    "actor": "act for a learner, in an environment of this machine",
    "evaluate": "run a trained policy, record a video",
    "run": "run a trained policy in real time, e.g. on a robot",
    "export": "write a trained policy to an ONNX or torch file",
    "robustness": "evaluate a policy while its senses are disturbed",
    "demos": "record demonstrations, from which a run can learn",
    "classifier": "train a classifier of success from demonstrations",
    "sweep": "run the experiments of the paper, or your own",
    "report": "draw and compare learning curves",
    "check": "find damaged files in a run",
    "compare": "print what differs between two runs",
    "tasks": "list the tasks, with an image of each",
    "info": "show versions, hardware and the expected speed",
    "bench": "compare merl's speed with a reference",
}
"""The commands. Each is a module here, imported when its command runs: a misspelt command does not
wait for torch. Its function has the command's name, its options are `TrainOptions` etc."""


TRAINING = ("train", "resume", "learner", "actor")
"""The commands whose environments and threads may keep the process from ending."""
WORKING = (*TRAINING, "run", "export", "robustness", "demos", "classifier", "sweep", "report")
"""The commands that do more than print."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code.

    A command continues if its output cannot be written. A command that only prints then returns a
    nonzero exit code.
    """
    if arguments is not None:
        return _main(arguments)
    code = _main(sys.argv[1:])
    if sys.argv[1:] and sys.argv[1] in TRAINING:
        end_soon(code)
    return code


def _main(arguments: Sequence[str]) -> int:
    args = list(arguments)
    only_prints = not args or args[0] not in WORKING or args[:2] == ["demos", "show"]
    try:
        with tolerant_output() as (out, _), working_folder_hidden(), _warnings_on_stderr():
            code = _run(args)
    except SystemExit:  # tyro exits after it has printed the help
        if out.error is None:
            raise
        code, only_prints = 0, True
    if code != 0 or out.error is None or not only_prints:
        return code
    if out.error.errno == errno.EPIPE:
        return 128 + signal.SIGPIPE
    with tolerant_output():
        reason = out.error.strerror
        print(f"merl: error: the output could not be written: {reason}", file=sys.stderr)
    return MerlError.exit_code


def _run(args: list[str]) -> int:
    command, *rest = args or ["--help"]
    try:
        if command in ("-h", "--help"):
            print(_usage())
            return 0
        if command == "--version":
            print(f"merl {merl.__version__}")
            return 0
        if command == "--tyro-print-completion":
            import_module("merl.cli.completion").print_completion(rest)
            return 0
        if command not in COMMANDS:
            raise MerlError(f"command {command!r} is unknown: {suggest(command, COMMANDS)}")
        code: int = getattr(import_module(f"merl.cli.{command}"), command)(rest)
        return code
    except MerlError as error:
        if os.environ.get("MERL_TRACEBACK"):
            traceback.print_exc()
        print(f"merl: error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:  # of a file that nobody expected to fail
        if os.environ.get("MERL_TRACEBACK"):
            traceback.print_exc()
        place = f"{error.filename}: " if error.filename else ""
        print(f"merl: error: {place}{cause(error)}", file=sys.stderr)
        return MerlError.exit_code
    except KeyboardInterrupt as stop:
        return 128 + getattr(stop, "number", signal.SIGINT)


@contextmanager
def _warnings_on_stderr() -> Iterator[None]:
    """Print each logged or issued warning in one line."""
    handler, root = _OneLine(logging.WARNING), logging.getLogger()
    root.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _log_warning
            yield
    finally:
        root.removeHandler(handler)


class _OneLine(logging.Handler):
    """A handler that prints each message in one line, without terminal colours."""

    def emit(self, record: logging.LogRecord) -> None:
        text = " ".join(re.sub(r"\x1b\[[\d;]*m", "", record.getMessage()).split())
        if text:
            print(f"merl: {record.levelname.lower()}: {text}", file=sys.stderr)


def _log_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    if not issubclass(category, DeprecationWarning):
        logging.getLogger(__name__).warning("%s", message)


def _usage() -> str:
    commands = [f"  {name:<12}{about}" for name, about in COMMANDS.items()]
    return "\n".join(
        [
            "usage: merl COMMAND ...",
            "",
            *commands,
            "",
            "merl COMMAND --help shows its options, merl --version the version.",
            "A trained arm: merl evaluate pretrained/reach_duplo --video arm.mp4",
            "A first run, in under a minute: merl train reach_duplo --preset smoke",
        ]
    )
