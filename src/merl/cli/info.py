"""The command merl info."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from rich.table import Table

import merl
from merl.cli.console import make_console
from merl.cli.parsing import parse
from merl.core import MerlError, counted
from merl.core.resources import available_memory, free_disk
from merl.envs import make_env
from merl.experiments.presets import compose
from merl.rendering.config import RendererName
from merl.runs.provenance import machine, package_versions
from merl.training.setup import Setup

TASK = "reach_duplo"
SIZE, FRAMES = 84, 20
"""Height and width of the timed images in pixels, and their number."""


@dataclass(frozen=True)
class InfoOptions:
    """Show versions, hardware and measured speed (takes half a minute)."""


def info(args: list[str]) -> int:
    """Print versions, processor, GPU, memory, renderer speeds and the expected training speed."""
    parse(InfoOptions, "merl info", args)
    console = make_console()
    table = Table(show_header=False, box=None, padding=(0, 2))
    with console.status("measuring", spinner="line"):
        for name, value in _rows():
            table.add_row(name, value)
    console.print(table)
    return 0


def _rows() -> Iterator[tuple[str, str]]:
    yield "merl", merl.__version__
    yield from package_versions().items()
    hardware = machine()
    yield "processor", f"{hardware['processor']}, {counted(hardware['cores'], 'core')}"
    yield "instructions", hardware["instructions"]
    yield "GPU", hardware["gpu"] or "none found by torch"
    yield "memory", f"{available_memory() / 1e9:.1f} GB available to this process"
    yield "disk", f"{free_disk(Path.cwd()) / 1e9:.1f} GB free here"
    for name in get_args(RendererName):
        yield f"renderer {name}", _speed(name)
    for preset in ("laptop", "paper"):
        yield f"preset {preset}", _expected(preset)


def _speed(renderer: RendererName) -> str:
    """Return the frames per second of a renderer, or one line that says why it fails."""
    try:
        env = make_env(
            TASK,
            renderer=renderer,
            observations=("proprio",),
            render_size=SIZE,
            render_mode="rgb_array",
        )
        try:
            env.reset(seed=0)
            env.render()  # the first call builds what later calls reuse
            start = time.perf_counter()
            for _ in range(FRAMES):
                env.render()
            return f"{FRAMES / (time.perf_counter() - start):.0f} frames/s at {SIZE}x{SIZE}"
        finally:
            env.close()
    except MerlError as error:
        return str(error)
    except Exception as error:  # a driver may raise anything; report it as the result
        return f"fails with {type(error).__name__}: {error}"


def _expected(preset: str) -> str:
    """Return the expected training speed, from timing a step and an update."""
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
