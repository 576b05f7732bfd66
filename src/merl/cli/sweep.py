"""The command merl sweep."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table

from merl.cli.console import make_console, say
from merl.cli.parsing import check_writable, parse
from merl.core import MerlError, check_choice, counted, suggest
from merl.core.fields import NOT_EMPTY, Range, check_fields
from merl.core.statistics import bootstrap_interval, wilson_interval
from merl.envs.user_env import load_module
from merl.experiments.experiment import Experiment, PlannedRun, plan
from merl.experiments.on_ray import run_on_ray
from merl.experiments.paper import EXPERIMENTS
from merl.experiments.presets import PRESETS, default_preset
from merl.experiments.slurm import write_array
from merl.experiments.sweep import (
    Outcome,
    Settings,
    check_folder,
    evaluation_of,
    is_done,
    run_here,
    steps_of,
)
from merl.experiments.sweep_file import read_experiment
from merl.training.setup import Setup

REPORT_EVERY = 60.0
"""Seconds between lines about the active runs."""
FAILED = 1
"""Exit code if a run failed."""


@dataclass(frozen=True)
class SweepOptions:
    """Train and evaluate the runs of an experiment that are missing; print a table of all."""

    name: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="|".join([*EXPERIMENTS, "FILE"]))
    ]
    """The experiment: a figure of the paper, or a TOML file (docs/howto/sweep.md)."""
    seeds: Annotated[int, Range(1, 1000)] = 3
    """Number of seeds of each variant: 0, 1, 2, ..."""
    tasks: Annotated[tuple[str, ...], NOT_EMPTY] | None = None
    """Tasks; by default all of the experiment."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="|".join(PRESETS))] = None
    """Preset; by default that of the file, or else that of `merl train`. Agents that observe the
    simulator's state have preset state where this is laptop."""
    steps: Annotated[int, Range(1, 10**12)] | None = None
    """Environment steps of each run; by default the preset's."""
    out: Path | None = None
    """Folder of the run folders; by default sweeps/PRESET. Experiments share their runs there."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only list the runs with their commands and their cost on this machine, which is measured."""
    jobs: Annotated[int, Range(1, 1024)] = 1
    """Number of runs at a time."""
    episodes: Annotated[int, Range(1)] = 50
    """Evaluation episodes at the end of each run."""
    retries: Annotated[int, Range(0, 1000)] = 2
    """How often a run that crashed is resumed."""
    ray: tyro.conf.FlagCreatePairsOff[bool] = False
    """Run as tasks of Ray, on this machine or with --address; --cpus and --gpus limit how many."""
    address: str | None = None
    """Address of a Ray cluster; --out must be a folder that all its machines share."""
    slurm: Path | None = None
    """Only write an array script for Slurm to this file."""
    cpus: Annotated[float, Range(0, 1024, without=0)] = 1.0
    """Processors of each run, for Ray and Slurm."""
    gpus: Annotated[float, Range(0, 1024)] = 0.0
    """GPUs of each run, for Ray and Slurm; Ray shares one among several runs with a fraction."""

    def __post_init__(self) -> None:
        check_fields(self, "--")
        if self.address is not None and not self.ray:
            raise MerlError(f"--address {self.address} is for --ray: add it")


def sweep(args: list[str]) -> int:
    """Run an experiment: merl sweep fig2 [--seeds 5] [--jobs 2] [--dry-run] ..."""
    options = parse(SweepOptions, "merl sweep", args)
    console = make_console()
    experiment = _experiment(options.name)
    preset = options.preset or experiment.preset or default_preset()
    check_choice("preset", preset, tuple(PRESETS))
    out = (options.out or Path("sweeps", preset)).absolute()
    runs = plan(
        experiment,
        preset=preset,
        seeds=range(options.seeds),
        out=out,
        tasks=options.tasks,
        values={} if options.steps is None else {"steps": options.steps},
    )
    settings = Settings(_threads(options), options.episodes, options.retries)
    missing = [run for run in runs if not is_done(run, settings.episodes)]
    counts = f"{counted(len(runs), 'run')} in {out}, {len(runs) - len(missing)} done"
    say(console, f"{experiment.title}: {counts}")
    if options.dry_run:
        _list(console, runs, settings, options.jobs)
        return 0
    if options.slurm is not None:
        check_writable(options.slurm)
        if not missing:
            return 0
        check_folder(out)
        write_array(options.slurm, missing, settings, options.cpus, options.gpus)
        say(console, f"sbatch {options.slurm}")
        return 0
    check_folder(out)
    stopped, failed = _run(console, missing, settings, options) if missing else (None, {})
    console.print(_results(runs, settings, failed))
    if stopped is not None:
        console.print("stopped: the same command continues")
        return 128 + stopped
    return FAILED if failed else 0


def _experiment(name: str) -> Experiment:
    if name in EXPERIMENTS:
        return EXPERIMENTS[name]
    path = Path(name)
    if path.suffix == ".toml":
        return read_experiment(path)
    raise MerlError(
        f"experiment {name!r} is unknown: {suggest(name, EXPERIMENTS)}, or name a TOML file"
    )


def _threads(options: SweepOptions) -> int | None:
    """Return the threads of each run; None lets a run that is alone choose."""
    if options.ray or options.slurm:
        return max(1, int(options.cpus))
    return None if options.jobs == 1 else max(1, len(os.sched_getaffinity(0)) // options.jobs)


def _run(
    console: Console, runs: Sequence[PlannedRun], settings: Settings, options: SweepOptions
) -> tuple[int | None, dict[str, str]]:
    """Run them; return the signal that stopped the sweep, and why runs failed."""
    failed: dict[str, str] = {}
    total = len(runs)
    ended = 0
    last = time.monotonic()
    by_name = {run.name: run for run in runs}

    def tell(text: str) -> None:
        say(console, f"{time.strftime('%H:%M:%S')}  {text}")

    def on_start(run: PlannedRun) -> None:
        at = steps_of(run.folder)
        tell(f"{run.name}: {f'continues at step {at:,}' if at else 'starts'}")

    def on_end(outcome: Outcome) -> None:
        nonlocal ended
        ended += 1
        if outcome.error is not None:
            failed[outcome.name] = outcome.error
        result = outcome.error or _result(by_name[outcome.name])
        took = timedelta(seconds=round(outcome.seconds))
        how = "failed" if outcome.error else "done"
        tell(f"{outcome.name}: {how} after {took} ({ended} of {total}): {result}")

    def tick(now: Sequence[PlannedRun]) -> None:
        nonlocal last
        if time.monotonic() - last >= REPORT_EVERY:
            last = time.monotonic()
            shares = ((run, steps_of(run.folder) / run.config.steps) for run in now)
            active = [f"{run.name} {share:.0%}" for run, share in shares if share]
            if active:
                tell("  ".join(active))

    if options.ray:
        stopped = run_on_ray(
            runs,
            settings,
            on_end,
            tick,
            address=options.address,
            cpus=options.cpus,
            gpus=options.gpus,
        )
    else:
        stopped = run_here(runs, settings, options.jobs, on_start, on_end, tick)
    return stopped, failed


def _list(console: Console, runs: Sequence[PlannedRun], settings: Settings, jobs: int) -> None:
    """Print the runs with their commands and their cost."""
    hours, left = dict[str, float | str](), 0.0
    with console.status("timing each variant on this machine", spinner="line"):
        for run in runs:
            key = f"{run.config.task} {run.variant}"
            if key not in hours and not is_done(run, settings.episodes):
                hours[key] = _hours(run, settings)
    table = Table("run", "state", "hours", box=None, padding=(0, 2))
    for run in runs:
        at = steps_of(run.folder)
        cost = hours.get(f"{run.config.task} {run.variant}", "")
        state = "done" if is_done(run, settings.episodes) else f"{at:,} steps" if at else "missing"
        if not isinstance(cost, str) and state != "done":
            left += cost * (1 - min(1.0, at / run.config.steps))
        table.add_row(run.name, state, cost if isinstance(cost, str) else f"{cost:.2g}")
    console.print(table)
    for run in runs:
        say(console, f"merl train {shlex.join(run.arguments)}")
    unknown = sum(isinstance(cost, str) for cost in hours.values())
    if unknown:
        console.print(f"the cost of {counted(unknown, 'variant')} is unknown")
    console.print(
        f"{left:.3g} hours are left, {left / jobs:.3g} with {counted(jobs, 'run')} at a time "
        "(measured with one run at a time)"
    )


def _hours(run: PlannedRun, settings: Settings) -> float | str:
    """Return the time of a whole run, from timing a step and an update; or why it cannot run."""
    most = len(os.sched_getaffinity(0))
    threads = None if settings.threads is None else min(settings.threads, most)
    config = replace(run.config, threads=threads or run.config.threads)
    try:
        if config.has_user_env and ":" in config.task:
            load_module(config.task, Path.cwd())
        with Setup.prepare(config, new=False) as setup:
            return setup.timing.seconds(config) / 3600
    except MerlError as error:
        return str(error)


def _results(runs: Sequence[PlannedRun], settings: Settings, failed: dict[str, str]) -> Table:
    table = Table("run", "step", "result", box=None, padding=(0, 2))
    for run in runs:
        step = f"{steps_of(run.folder):,}"
        why = f"failed: {failed[run.name]}" if run.name in failed else "missing"
        table.add_row(run.name, step, _result(run) if is_done(run, settings.episodes) else why)
    return table


def _result(run: PlannedRun) -> str:
    """Return return and success of the evaluation at the end, with their intervals."""
    evaluated = evaluation_of(run.folder)
    if evaluated is None:
        return f"{run.folder}: no evaluation"
    episodes: list[dict[str, Any]] = evaluated["episodes"]
    returns = bootstrap_interval([episode["return"] for episode in episodes])
    text = f"return {returns.mean:.4g} [{returns.low:.4g}, {returns.high:.4g}]"
    if all("success_end" in episode for episode in episodes):
        count = sum(episode["success_end"] > 0 for episode in episodes)
        rate = wilson_interval(count, len(episodes))
        text += f", success {rate.mean:.0%} [{rate.low:.0%}, {rate.high:.0%}]"
    return text
