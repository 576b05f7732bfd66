"""Measure how the cost grows with batch, image, environments and replay.

    python benchmarks/measure_scaling.py [--repeats 7] [--questions batch image]

Writes the numbers to results/scaling.csv and the figure to docs/images/scaling.png; `--questions`
without a value only draws. All sizes of one question take turns within each round; replays do not.
The times are wall-clock time, so the machine must be idle. The updates are the paper's (six layers)
in bf16, on all cores.
"""

from __future__ import annotations

import csv
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import numpy as np
import torch
import tyro
from gymnasium import spaces
from matplotlib.axes import Axes
from matplotlib.ticker import (
    EngFormatter,
    FixedLocator,
    LogLocator,
    NullLocator,
    StrMethodFormatter,
)

from merl.bench.measuring import Work, circumstances, spread, take_turns
from merl.bench.train import steps_per_second
from merl.bench.update import ACTIONS, learner_of, noise_batch, space_of
from merl.core import Transition
from merl.core.resources import free_disk
from merl.envs import make_env
from merl.networks.augmentation import RandomShift, draw_shifts
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec, buffer, stack_reader
from merl.report.drawing import BLUE, DPI, GREEN, MUTED, VERMILION, new_figure, save, style

ROOT = Path(__file__).resolve().parent.parent
CSV, FIGURE = ROOT / "results/scaling.csv", ROOT / "docs/images/scaling.png"
FIELDS = ("question", "side", "x", "median", "low", "high")
BATCHES = (16, 32, 64, 128, 256, 512)
SIDES = (32, 48, 64, 84, 100, 128)
ENVIRONMENTS = (1, 2, 3, 4)
CAPACITIES = (1000, 10_000, 100_000, 300_000, 1_000_000, 1_500_000)
PAD = 4
SAMPLES = 20
"""Batches in a turn when a replay is sampled."""
EPISODE = 250
ACTION_SPACE = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

Row = tuple[str, str, int, float, float, float]


def main(
    repeats: int = 7,
    questions: tuple[Literal["batch", "image", "environments", "replay"], ...] = (
        "batch",
        "image",
        "environments",
        "replay",
    ),
    place: Path | None = None,
) -> None:
    """Measure, then draw.

    Args:
        repeats: number of rounds.
        questions: questions to measure; the numbers of the others are kept. Empty: only draw.
        place: a folder on the disk for the replays; by default the folder for temporary files.
    """
    ask = {"batch": batches, "image": sides, "environments": environments}
    print(circumstances())
    with CSV.open() as file:
        rows: list[Any] = list(csv.reader(file))[1:]
    for question in questions:
        asked = ask[question](repeats) if question in ask else capacities(repeats, place)
        rows = [row for row in rows if row[0] != question]
        for row in asked:
            rows.append(row)
            print(*row, flush=True)
        with CSV.open("w", newline="") as file:
            csv.writer(file).writerows([FIELDS, *rows])
    draw()


def batches(repeats: int) -> Iterator[Row]:
    """Yield the milliseconds of an update, by batch size."""
    works = {("update", size): _update(size, 84) for size in BATCHES}
    yield from _rows("batch", works, repeats)


def sides(repeats: int) -> Iterator[Row]:
    """Yield the milliseconds of an update (batch 128) and of an environment step, by image size."""
    works: dict[tuple[str, int], Work] = {}
    with ExitStack() as stack:
        for side in SIDES:
            works["update of 128", side] = _update(128, side)
            env = make_env("reach_duplo", renderer="raster", image_size=side)
            stack.callback(env.close)
            env.reset(seed=0)
            works["step with its image", side] = partial(env.step, np.zeros(ACTIONS, np.float32))
        yield from _rows("image", works, repeats)


def environments(repeats: int) -> Iterator[Row]:
    """Yield the steps per second of preset laptop's training loop, by environments at once."""
    ways: dict[tuple[str, int], dict[str, Any]] = {("strict", 1): {}}
    for count in ENVIRONMENTS:
        ways["beside the learner", count] = {"synchronous": False, "num_envs": count}
    rates, _ = steps_per_second(ways, "reach_duplo", "laptop", repeats, steps=60)
    for (side, count), each in rates.items():
        yield _row("environments", side, count, each)


def capacities(repeats: int, place: Path | None) -> Iterator[Row]:
    """Yield the milliseconds to sample and shift 256 pairs, by capacity; one replay at a time.

    This includes replays that do not fit into memory, which merl refuses: the check is switched off
    here, and reading ahead in one variant, to show their effect.
    """
    seen = _episode()
    for compress, capacity in product((False, True), CAPACITIES):
        config = ReplayConfig(capacity=capacity, compress=compress)
        spec = ReplaySpec.of(config, space_of(), ACTION_SPACE)
        with tempfile.TemporaryDirectory(dir=place) as folder, patch.object(buffer, "check_fits"):
            if spec.bytes > 0.9 * free_disk(Path(folder)):
                print(f"{capacity:,} steps are skipped: the disk is too small")
                continue
            replay = ReplayBuffer(spec, Path(folder) / "replay")
            _fill(replay, seen, capacity)
            replay.flush()
            name, rng = "compressed" if compress else "raw", np.random.default_rng(0)
            sample = partial(_samples, replay, rng)
            works: dict[tuple[str, int], Work] = {(name, capacity): sample}
            if not compress:
                works["raw, not read ahead", capacity] = partial(_without_read_ahead, sample)
            for (side, x), each in take_turns(works, repeats).items():
                yield _row("replay", side, x, [1e3 * seconds / SAMPLES for seconds in each])


def _samples(replay: ReplayBuffer, rng: np.random.Generator) -> None:
    shifts = torch.Generator().manual_seed(0)
    for _ in range(SAMPLES):
        now, then = (RandomShift(draw_shifts(256, PAD, shifts), PAD) for _ in range(2))
        replay.sample(256, rng, {"image": now}, {"image": then})


def _without_read_ahead(sample: Work) -> None:
    with patch.object(stack_reader.ReadAhead, "is_wanted", False):
        sample()


def _rows(question: str, works: Mapping[tuple[str, int], Work], repeats: int) -> Iterator[Row]:
    for (side, x), each in take_turns(works, repeats).items():
        yield _row(question, side, x, [1e3 * seconds for seconds in each])


def _row(question: str, side: str, x: int, values: list[float]) -> Row:
    result = spread(values)
    return question, side, x, result["median"], result["low"], result["high"]


def _update(size: int, side: int) -> Work:
    agent = learner_of("merl", "bf16", torch.device("cpu"), side)
    return partial(agent.update, noise_batch(size, side))


def _episode() -> list[dict[str, Any]]:
    """Return the observations of an episode with random actions."""
    env = make_env("reach_duplo", renderer="raster")
    observation, _ = env.reset(seed=0)
    seen = [observation]
    for _ in range(EPISODE):
        seen.append(env.step(ACTION_SPACE.sample())[0])
    env.close()
    return seen


def _fill(replay: ReplayBuffer, seen: list[dict[str, Any]], steps: int) -> None:
    action = np.zeros(ACTIONS, np.float32)
    for step in range(steps):
        if step % EPISODE == 0:
            replay.begin(seen[0])
        now = step % EPISODE + 1
        replay.add(Transition(action, 0.0, 1.0, seen[now], last=now == EPISODE))


def draw() -> None:
    """Draw the figure, one panel per question."""
    with CSV.open() as file:
        rows = list(csv.DictReader(file))
    figure = new_figure(6.4)
    panels = figure.subplots(2, 2)
    _panel(
        panels[0, 0],
        rows,
        "batch",
        "milliseconds",
        "samples in a batch, 84x84",
        xlog=True,
        ylog=True,
    )
    _panel(panels[0, 1], rows, "image", "milliseconds", "pixels a side", xlog=True, ylog=True)
    _panel(
        panels[1, 0], rows, "environments", "steps a second", "environments", xlog=False, ylog=False
    )
    _panel(panels[1, 1], rows, "replay", "ms for 256 pairs", "steps held", xlog=True, ylog=True)
    save(figure, FIGURE)
    print(f"{FIGURE} ({DPI} dpi)")


def _panel(
    axes: Axes,
    rows: list[dict[str, str]],
    question: str,
    ylabel: str,
    xlabel: str,
    *,
    xlog: bool,
    ylog: bool,
) -> None:
    style(axes, ylabel)
    mine = [row for row in rows if row["question"] == question]
    by_side: dict[str, list[dict[str, str]]] = {}
    for row in mine:
        by_side.setdefault(row["side"], []).append(row)
    for (side, points), colour in zip(by_side.items(), (BLUE, VERMILION, GREEN), strict=False):
        x, middle, low, high = (
            np.array([float(row[key]) for row in points]) for key in ("x", "median", "low", "high")
        )
        axes.errorbar(
            x,
            middle,
            yerr=[middle - low, high - middle],
            color=colour,
            marker="o",
            ms=4,
            lw=1.5,
            elinewidth=0.8,
            capsize=2,
            label=side,
        )
    ticks = sorted({int(row["x"]) for row in mine})
    if xlog:
        axes.set_xscale("log")
        near = 0.08 * np.log(ticks[-1] / ticks[0])  # labels that are nearer overlap
        apart = np.diff(np.log(ticks), prepend=-np.inf) > near
        ticks = [tick for tick, keep in zip(ticks, apart, strict=True) if keep]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_locator(NullLocator())
    if ylog:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_locator(NullLocator())
    else:
        axes.set_ylim(bottom=0)
    axes.set_xlabel(xlabel, color=MUTED)
    axes.legend(frameon=False, fontsize=8, labelcolor=MUTED)


if __name__ == "__main__":
    tyro.cli(main)
