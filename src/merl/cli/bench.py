"""The command merl bench."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from merl.bench import BENCHES
from merl.cli.console import make_console
from merl.cli.parsing import check_writable, parse, write_json
from merl.core import check_choice
from merl.core.fields import Range, check_fields


@dataclass(frozen=True)
class BenchOptions:
    """Time variants of the same work in turns; print medians and ranges."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join(BENCHES))]
    """What to time."""
    repeats: Annotated[int, Range(1)] = 5
    """How often each variant is timed."""
    json: Path | None = None
    """Also write the numbers to this file."""

    def __post_init__(self) -> None:
        check_choice("bench", self.name, tuple(BENCHES))
        check_fields(self, "--")


def bench(args: list[str]) -> int:
    """Time merl and a reference, and print a table: merl bench env."""
    options = parse(BenchOptions, "merl bench", args)
    check_writable(options.json)
    run, show = BENCHES[options.name]
    result = run(repeats=options.repeats)
    make_console().print(show(result))
    if options.json is not None:
        write_json(options.json, result)
    return 0
