"""Tab completion: the script that a shell needs to complete `merl`."""

from __future__ import annotations

import io
from contextlib import redirect_stdout, suppress
from importlib import import_module
from typing import Annotated, Any, Union

import tyro

from merl.cli import COMMANDS
from merl.core import MerlError

SHELLS = ("bash", "zsh", "fish")


def print_completion(args: list[str]) -> None:
    """Print the completion script: merl --tyro-print-completion bash.

    Raises:
        MerlError: no shell that tyro knows is named.
    """
    if args[:1] not in [[shell] for shell in SHELLS]:
        raise MerlError(f"--tyro-print-completion needs a shell: choose from {', '.join(SHELLS)}")
    options = [
        Annotated[
            getattr(import_module(f"merl.cli.{name}"), f"{name.title()}Options"),
            tyro.conf.subcommand(name, description=about),
        ]
        for name, about in COMMANDS.items()
    ]
    command: Any = Union[tuple(options)]  # noqa: UP007 (made of a list)
    script = io.StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        tyro.cli(command, prog="merl", args=["--tyro-print-completion", args[0]])
    for line in script.getvalue().splitlines():
        # The script takes each line of a description for a word of its own.
        print(line.replace(r"\n", " ") if line.startswith("COMPLETION_SPEC") else line)
