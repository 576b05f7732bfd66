"""Collect runs for a report: read their folders, group their seeds, and name what is skipped."""

from __future__ import annotations

import fcntl
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from merl.core import (
    CONFIG_FILE,
    EVALUATION_FILE,
    HARMLESS,
    LOCK_FILE,
    METRICS_FILE,
    MerlError,
)
from merl.core.files import open_file, read_json
from merl.envs.config import EnvConfig
from merl.envs.registration import ENV_IDS
from merl.report.curves import Array, Curve, curve_of, read_metrics
from merl.report.references import EPISODE, form, references

SUCCESS, RETURN = "success_end", "return"
UNKNOWN_TASK = "unknown task"
_SEED = re.compile(r"-s(\d+)(-\d+)?$")
_SEED_OF_START = re.compile(r"-s\d+(-\d+)?(?=-bc$|$)")
"""The seed in the name of the run that a run started with, e.g. its own RUN-bc."""


@dataclass(frozen=True)
class SeedRun:
    """A run, read from its folder or from a CSV file with the layout of `metrics.csv`.

    Attributes:
        path: the folder, or the file.
        record: the content of `config.json`; empty if there is none.
        metrics: the columns of the metrics; see `read_metrics`.
        episodes: the episodes of the evaluation at the end of a sweep's run; empty if none.
        active: whether a process trains it now.
    """

    path: Path
    record: Mapping[str, Any]
    metrics: Mapping[str, Array]
    episodes: tuple[Mapping[str, float], ...]
    active: bool

    @property
    def name(self) -> str:
        """The name of the folder, or of the file without its ending."""
        return self.path.stem if self.path.suffix == ".csv" else self.path.resolve().name

    @property
    def seed(self) -> int | None:
        """The seed, from the record or else from the name."""
        seed = self.record.get("seed")
        found = _SEED.search(self.name)
        return seed if isinstance(seed, int) else int(found[1]) if found else None

    @property
    def task(self) -> str:
        """The task, from the record or else from the name."""
        task = self.record.get("task")
        if isinstance(task, str):
            return task
        return next((name for name in ENV_IDS if self.name.startswith(name)), UNKNOWN_TASK)

    @property
    def label(self) -> str:
        """The name without task and seed."""
        plain = re.sub(r"[^\w.-]+", "-", self.task)
        return _SEED.sub("", self.name).removeprefix(plain).strip("-") or self.name

    @cached_property
    def values(self) -> dict[str, Any]:
        """The values of the config, by dotted name."""
        config = self.record.get("config")
        values = dict(_flat(config if isinstance(config, dict) else {}))
        values.pop("run_dir", None)
        return values

    @property
    def learnt(self) -> dict[str, Any]:
        """The values that decide what is learnt, without the seed."""
        found = {k: v for k, v in self.values.items() if k not in (*HARMLESS, "seed")}
        start = found.get("agent.start_from")
        if isinstance(start, str):
            found["agent.start_from"] = _SEED_OF_START.sub("", start)
        return found

    @property
    def env(self) -> EnvConfig:
        """The form of the task in which the run is evaluated."""
        values = self.values
        start = values.get("eval.start") or values.get("env.start")
        given = {name: values.get(f"env.{name}") for name in ("occluded", "reward")}
        given |= {"start": tuple(start) if start else None}
        return EnvConfig(**{name: value for name, value in given.items() if value is not None})

    @property
    def form(self) -> str:
        """The task with the options that change what is solved, e.g. "lift_box staged"."""
        return form(self.task, self.env)

    @property
    def references(self) -> dict[str, float]:
        """The known returns of the task in this form, by name."""
        limit = self.values.get("eval.max_episode_steps", EPISODE)
        return {one.name: one.returns.mean for one in references(self.task, self.env, limit)}

    @property
    def last_step(self) -> int:
        """The environment steps of the last row of the metrics that has them; 0 without one."""
        steps = self.metrics["step"]
        known = steps[~np.isnan(steps)]
        return int(known[-1]) if len(known) else 0

    @property
    def videos(self) -> dict[int, Path]:
        """The videos of evaluations, by step."""
        found = sorted((self.path / "videos").glob("*.mp4")) if self.path.is_dir() else []
        return {int(path.stem): path for path in found if path.stem.isdigit() and path.is_file()}

    def curve(self, name: str, x: str = "step") -> Curve:
        """Return a column of the evaluations, e.g. `return`, over another."""
        return curve_of(dict(self.metrics), f"eval/{name}", x)

    def final(self, name: str) -> float:
        """Return a result at the end: of the sweep's evaluation, or else of the last in training.

        NaN without one.
        """
        if self.episodes and all(name in episode for episode in self.episodes):
            return math.fsum(episode[name] for episode in self.episodes) / len(self.episodes)
        values = self.curve(name).values
        return float(values[-1]) if len(values) else math.nan


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed only.

    Attributes:
        label: its name in figures and tables.
        task: the task, with the options that change what is solved.
        runs: the runs, by seed.
    """

    label: str
    task: str
    runs: tuple[SeedRun, ...]

    @property
    def seeds(self) -> list[int | None]:
        """The seeds."""
        return [run.seed for run in self.runs]

    def final(self, name: str) -> list[float]:
        """Return a result at the end of each run, without those that have none."""
        return [value for run in self.runs if not math.isnan(value := run.final(name))]


def collect(paths: Iterable[Path]) -> tuple[list[Group], list[str]]:
    """Read runs and group them.

    Args:
        paths: run folders, CSV files, or folders that hold them.

    Returns:
        The groups, in the order of the paths, and notes: what was skipped, and what a reader must
        know (a run that is not finished, seeds that are missing).

    Raises:
        MerlError: a path does not exist, or no run can be read.
    """
    notes: list[str] = []
    runs: list[SeedRun] = []
    found = (each for given in paths for each in _expand(given, notes))
    for path in {each.resolve(): each for each in found}.values():
        try:
            run = read_run(path)
        except MerlError as error:
            notes.append(f"skipped: {error}")
            continue
        if len(run.curve(RETURN).steps) == 0 and not run.episodes:
            notes.append(f"skipped: {path} has no evaluation yet")
            continue
        if run.active:
            notes.append(f"{run.name} is still training: at step {run.last_step:,}")
        runs.append(run)
    if not runs:
        raise MerlError("no run can be read: " + ("; ".join(notes) or "no path was given"))
    groups = _grouped(runs)
    return groups, [*notes, *_about_seeds(groups)]


def read_run(path: Path) -> SeedRun:
    """Read a run.

    Raises:
        MerlError: its metrics are missing or cannot be read.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise MerlError(f"{str(path)!r} has a name that is not UTF-8: rename it") from None
    metrics = read_metrics(path)
    if any(np.isinf(column).any() for column in metrics.values()):
        raise MerlError(f"{path} contains infinite numbers")
    record, evaluation = _json(path / CONFIG_FILE), _json(path / EVALUATION_FILE)
    episodes, step = evaluation.get("episodes"), evaluation.get("step")
    rows = [row for row in episodes if _is_row(row)] if isinstance(episodes, list) else []
    run = SeedRun(path, record, metrics, tuple(rows), _locked(path / LOCK_FILE))
    if not isinstance(step, int) or step < run.last_step:  # the run was trained further
        run = replace(run, episodes=())
    try:
        _ = run.form, run.references  # a record may come from anyone
    except (MerlError, TypeError, ValueError, AttributeError) as error:
        raise MerlError(f"{path / CONFIG_FILE} cannot be used: {error}") from None
    return run


def _is_row(row: Any) -> bool:
    return isinstance(row, dict) and all(isinstance(value, int | float) for value in row.values())


def _expand(path: Path, notes: list[str]) -> Iterator[Path]:
    """Yield the runs at a path: itself, or what a folder of runs holds."""
    if not path.exists():
        raise MerlError(f"{path} does not exist: name run folders, CSV files, or a folder of them")
    if path.name == METRICS_FILE and (path.parent / CONFIG_FILE).exists():
        yield path.parent
        return
    if path.is_file() or (path / METRICS_FILE).exists() or (path / CONFIG_FILE).exists():
        yield path
        return
    inside = sorted(path.iterdir(), key=lambda each: _natural(each.name))
    found = [
        each
        for each in inside
        if each.suffix == ".csv" or (each.is_dir() and (each / CONFIG_FILE).exists())
    ]
    if not found:
        notes.append(f"skipped: {path} holds no run")
    yield from found


def _natural(name: str) -> list[str | int]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def _grouped(runs: Sequence[SeedRun]) -> list[Group]:
    found: dict[tuple[str, str], list[SeedRun]] = {}
    for run in runs:
        # Without a record the name decides.
        values = json.dumps(run.learnt, sort_keys=True) if run.learnt else run.label
        found.setdefault((run.form, values), []).append(run)
    labels = [(task, its[0].label) for (task, _), its in found.items()]
    groups = []
    for (task, _), its in found.items():
        label = its[0].label
        if labels.count((task, label)) > 1:
            twins = [
                other[0] for (t, _), other in found.items() if (t, other[0].label) == (task, label)
            ]
            label += f" ({_distinction(its[0], twins)})"
        groups.append(Group(label, task, tuple(sorted(its, key=lambda run: run.seed or 0))))
    return groups


def _distinction(run: SeedRun, twins: Sequence[SeedRun]) -> str:
    """Return values in which a run differs from all others of its label: three, or more."""
    names = [
        name
        for name, value in run.learnt.items()
        if any(other.learnt.get(name) != value for other in twins)
    ]

    def told(each: SeedRun, count: int) -> str:
        return ", ".join(f"{name} {each.learnt.get(name)}" for name in names[:count])

    counts = range(3, len(names))
    few = (n for n in counts if sum(told(each, n) == told(run, n) for each in twins) == 1)
    return told(run, next(few, len(names))) or run.name


def _about_seeds(groups: Sequence[Group]) -> Iterator[str]:
    for task in dict.fromkeys(group.task for group in groups):
        its = [group for group in groups if group.task == task]
        every = sorted({seed for group in its for seed in group.seeds if seed is not None})
        for group in its:
            missing = [str(seed) for seed in every if seed not in group.seeds]
            if len(group.runs) == 1:
                yield f"{task}: {group.label} has one seed: no interval over seeds"
            elif missing and None not in group.seeds:
                yield f"{task}: {group.label} lacks seed {', '.join(missing)}, which others have"
            twice = {seed for seed in group.seeds if group.seeds.count(seed) > 1} - {None}
            if twice:
                named = ", ".join(map(str, sorted(twice, key=str)))
                yield f"{task}: {group.label} has seed {named} more than once: each run counts"
            ends = {run.last_step for run in group.runs}
            if len(ends) > 1:
                yield (
                    f"{task}: the seeds of {group.label} are of unequal length: their mean ends at "
                    f"step {min(ends):,}, where the shortest ends"
                )


def _json(path: Path) -> dict[str, Any]:
    """Return the object in a file; an empty one if it cannot be read."""
    try:
        found = read_json(path)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _locked(path: Path) -> bool:
    """Return whether a process trains the run."""
    try:
        with open_file(path) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        if isinstance(value, dict) and value:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
