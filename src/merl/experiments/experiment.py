"""Experiments as data: the variants of a figure, and the runs that they need."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from merl.agents import AGENTS
from merl.config import Setting, TrainConfig, override
from merl.core import MerlError
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import check_task
from merl.experiments.presets import compose

FOR_STATE = {"laptop": "state"}
"""Preset for agents that observe the simulator's state, where a preset is made for a camera."""


@dataclass(frozen=True)
class Variant:
    """One curve of a figure.

    Attributes:
        name: its label, and a part of the names of its run folders.
        agent: the agent's name; None for the preset's.
        values: values of `TrainConfig` by name, as `merl.config.override` takes them.
        preset: the preset; None for that of the experiment.
        setting: source of the agent's values (`merl train --setting`).
    """

    name: str
    agent: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    preset: str | None = None
    setting: Setting = "matched"


@dataclass(frozen=True)
class Experiment:
    """Variants that are compared on tasks.

    Attributes:
        title: what is compared.
        variants: the variants; those of equal name in other experiments share their runs.
        tasks: the tasks.
        values: values for all variants.
        preset: the preset, if none is asked for.
    """

    title: str
    variants: tuple[Variant, ...]
    tasks: tuple[str, ...] = tuple(ENV_IDS)
    values: Mapping[str, Any] = field(default_factory=dict)
    preset: str | None = None


@dataclass(frozen=True)
class PlannedRun:
    """A run of an experiment.

    Attributes:
        name: its name: TASK-VARIANT-sSEED.
        folder: its folder.
        variant: the variant's name.
        config: its config.
        arguments: the arguments of `merl train` that give this config.
    """

    name: str
    folder: Path
    variant: str
    config: TrainConfig
    arguments: tuple[str, ...]


def plan(
    experiment: Experiment,
    *,
    preset: str,
    seeds: Sequence[int],
    out: Path,
    tasks: Sequence[str] | None = None,
    values: Mapping[str, Any] | None = None,
) -> list[PlannedRun]:
    """Return the runs of an experiment: first all variants of the first seed, then of the next.

    Args:
        experiment: the experiment.
        preset: the preset of variants that name none.
        seeds: the seeds of each variant.
        out: the folder that the run folders are in.
        tasks: the tasks; None for all of the experiment.
        values: values for all runs, which override those of the experiment and its variants.

    Raises:
        MerlError: a task, a preset, an agent or a value is unknown or cannot work.
    """
    chosen = experiment.tasks if tasks is None else tuple(tasks)
    for task in chosen:
        check_task(task)
    runs = [
        _planned(experiment, variant, task, seed, preset, out, values or {})
        for seed, task, variant in product(dict.fromkeys(seeds), chosen, experiment.variants)
    ]
    if len({run.name for run in runs}) < len(runs):
        names = ", ".join(variant.name for variant in experiment.variants)
        raise MerlError(f"two variants or tasks would share a run folder: rename one of {names}")
    return runs


def _planned(
    experiment: Experiment,
    variant: Variant,
    task: str,
    seed: int,
    preset: str,
    out: Path,
    values: Mapping[str, Any],
) -> PlannedRun:
    name = re.sub(r"[^\w.=-]+", "-", f"{task}-{variant.name}-s{seed}")
    own_preset = variant.preset or _preset(preset, variant.agent)
    base = compose(own_preset, task, variant.agent, variant.setting)
    given = {
        key if "encoder" in key else key.replace("-", "_"): value  # encoders have the user's keys
        for part in (experiment.values, variant.values, values)
        for key, value in part.items()
    }
    for own in ("task", "seed", "run_dir"):
        if own in given:
            raise MerlError(f"a sweep sets {own} itself: leave it out of the values")
    config = override(base, given)
    agent: Any = config.agent
    fades = getattr(agent, "noise_std_end", None) is not None and variant.setting == "matched"
    if fades and "agent.noise_steps" not in given:
        # As in `compose`, the noise falls within the run, whose length is known only now.
        given["agent.noise_steps"] = min(type(agent)().noise_steps, config.steps // 2)
        config = override(base, given)
    if not config.has_user_env:
        from merl.tasks import check_options  # loads the simulator

        check_options(task, config.env.occluded, config.env.start, config.env.reward)
    folder = out / name
    arguments = [task, "--preset", own_preset]
    arguments += ["--agent", variant.agent] if variant.agent else []
    arguments += ["--setting", variant.setting] if variant.setting != "matched" else []
    arguments += [part for key, value in given.items() for part in flags(key, value)]
    arguments += ["--seed", str(seed), "--run-dir", str(folder)]
    config = replace(config, seed=seed, run_dir=folder)
    return PlannedRun(name, folder, variant.name, config, tuple(arguments))


def _preset(preset: str, agent: str | None) -> str:
    observes_state = agent in AGENTS and AGENTS[agent].config.keys == ("state",)
    return FOR_STATE.get(preset, preset) if observes_state else preset


def flags(name: str, value: Any) -> list[str]:
    """Return the options of `merl train` that give a value of `TrainConfig`.

    Args:
        name: the value's name, as `merl.config.override` takes it.
        value: the value.
    """
    section, _, rest = name.replace("-", "_").rpartition(".")
    if isinstance(value, Mapping):
        return [part for key, one in value.items() for part in flags(f"{name}.{key}", one)]
    if section in ("agent.encoders", "agent.encoder_weights"):  # the rest is the user's name
        return [f"--{section.replace('_', '-')}.{name.rpartition('.')[2]}", str(value)]
    section = {"env": "", "user_env": "env."}.get(section, section and f"{section}.")
    switch = "no-" if value is False else ""
    flag = f"--{section}{switch}{rest.replace('_', '-')}"
    if isinstance(value, bool):
        return [flag]
    several = value if isinstance(value, tuple | list) else (value,)
    return [flag, *map(str, several)]


def variants_of(grid: Mapping[str, Sequence[Any]]) -> Iterator[Variant]:
    """Yield a variant for each combination of values.

    Args:
        grid: {name of a value: the values that it takes}.
    """
    for chosen in product(*grid.values()):
        values = dict(zip(grid, chosen, strict=True))
        label = "-".join(f"{name.rpartition('.')[2]}={value}" for name, value in values.items())
        yield Variant(label, values=values)
