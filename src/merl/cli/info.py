"""merl info."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

import merl
from merl.bench.renderers import renderer_speeds
from merl.cli.output import make_console
from merl.cli.parsing import parse
from merl.core import MerlError, counted
from merl.core.resources import available_memory, free_disk
from merl.experiments.presets import compose
from merl.runs.provenance import machine, package_versions
from merl.training.setup import Setup

TASK = "reach_duplo"
FEATURES = ("avx2", "avx512f", "avx512_bf16", "amx_bf16")
"""Processor features that decide how fast an update is, as Linux names them."""


def info(args: list[str]) -> int:
    """Versions, processor, GPU, memory, renderers and their speed, expected steps per second."""

    def command() -> None:
        """Show what this machine offers, measured here (takes half a minute)."""

    parse(command, "merl info", args)
    console = make_console()
    table = Table(show_header=False, box=None, padding=(0, 2))
    with console.status("measuring", spinner="line"):
        for name, value in _rows():
            table.add_row(name, value)
    console.print(table, highlight=False)
    return 0


def _rows() -> Iterator[tuple[str, str]]:
    yield "merl", merl.__version__
    yield from package_versions().items()
    here = machine()
    yield "processor", f"{here['processor']}, {counted(here['cores'], 'core')}"
    yield "features", ", ".join(processor_features()) or "none of note"
    yield "GPU", here["gpu"] or "none that torch finds"
    yield "memory", f"{available_memory() / 1e9:.1f} GB available to this process"
    yield "disk", f"{free_disk(Path.cwd()) / 1e9:.1f} GB free here"
    for name, speed in renderer_speeds(TASK).items():
        text = speed if isinstance(speed, str) else f"{speed:.0f} frames/s at 84x84"
        yield f"renderer {name}", text
    for preset in ("laptop", "paper"):
        yield f"preset {preset}", _expected(preset)


def processor_features() -> list[str]:
    """Those of `FEATURES` that this processor has."""
    try:
        words = set(Path("/proc/cpuinfo").read_text().split())
    except OSError:
        return []
    return [feature for feature in FEATURES if feature in words]


def _expected(preset: str) -> str:
    """What training would bring, from timing its update and its step."""
    config = compose(preset, TASK)
    try:
        with Setup.prepare(config, new=False) as setup:
            timing = setup.timing
    except MerlError as error:
        return str(error)
    update = timing.update[timing.best]
    rate = 1.0 / (timing.step + config.updates_per_step * update)
    return (
        f"about {rate:.0f} steps/s and {rate * config.updates_per_step:.0f} updates/s "
        f"({timing.best}; {timing.seconds(config) / 3600:.1f} h for {config.steps:,} steps)"
    )
