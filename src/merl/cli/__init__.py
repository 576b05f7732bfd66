"""The command line.

Exit codes (docs/running.md): 0 done; 2 bad input, told in one line; 3 a NaN or an infinity stopped
the run; 4 an environment failed, a run that had begun is saved; 129, 130, 138 and 143 stopped by
SIGHUP, Ctrl-C, SIGUSR1 or SIGTERM, likewise saved; 141 nobody reads what is written.
"""

from __future__ import annotations

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
from merl.core import MerlError, meant

# The modules are imported when called: a misspelt command should not wait for torch.
COMMANDS = {
    "train": ("merl.cli.train", "train", "train an agent"),
    "resume": ("merl.cli.resume", "resume", "go on with a run"),
    "evaluate": ("merl.cli.evaluate", "evaluate", "run a trained policy, film it"),
    "tasks": ("merl.cli.tasks", "tasks", "what there is to learn"),
    "info": ("merl.cli.info", "info", "what this machine offers"),
    "bench": ("merl.cli.bench", "bench", "time merl against what there was before"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    args = list(sys.argv[1:] if arguments is None else arguments)
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
            raise MerlError(f"command {args[0]!r} is unknown: {meant(args[0], COMMANDS)}")
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
    except BrokenPipeError:  # the reader has gone, e.g. `merl ... --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    """A warning is for the user: one line, without the place in the source."""
    text = " ".join(re.sub(r"\x1b\[[\d;]*m", "", str(message)).split())  # some come in colours
    if text:
        print(f"merl: warning: {text}", file=sys.stderr)


def _usage() -> str:
    lines = [f"  {name:<10}{about}" for name, (_, _, about) in COMMANDS.items()]
    return "\n".join(["usage: merl COMMAND ...", "", *lines, "", "merl COMMAND --help tells more."])
