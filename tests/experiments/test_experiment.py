"""Experiments as data: which runs they need, and the commands that give their configs."""

from __future__ import annotations

from pathlib import Path

import pytest

from merl.cli import train as train_command
from merl.config import TrainConfig
from merl.core import MerlError
from merl.experiments.experiment import Experiment, PlannedRun, Variant, flags, plan, variants_of
from merl.experiments.paper import EXPERIMENTS

OUT = Path("/somewhere/sweeps")


def planned(name: str, preset: str = "laptop", **values: object) -> dict[str, PlannedRun]:
    runs = plan(EXPERIMENTS[name], preset=preset, seeds=[0], out=OUT, values=values)
    return {run.name: run for run in runs}


@pytest.mark.parametrize("preset", ["laptop", "paper"])
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_command_of_a_run_gives_its_config(
    name: str, preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[TrainConfig] = []
    monkeypatch.setattr(train_command, "begin", lambda config, *_: given.append(config) or 0)
    tasks = EXPERIMENTS[name].tasks[-1:]
    runs = plan(EXPERIMENTS[name], preset=preset, seeds=[3], out=OUT, tasks=tasks)
    for run in runs:
        train_command.train([*run.arguments])
    assert given == [run.config for run in runs]
    assert all(config.seed == 3 for config in given)


def test_all_seeds_of_an_experiment_are_planned_seed_by_seed() -> None:
    runs = plan(EXPERIMENTS["fig3c"], preset="laptop", seeds=[0, 1], out=OUT)
    assert len(runs) == 2 * 3 * 2
    assert [run.name for run in runs[:2]] == ["reach_duplo-merl-s0", "reach_duplo-no_norm-s0"]
    assert [run.config.seed for run in runs] == [0] * 6 + [1] * 6
    assert runs[0].folder == OUT / "reach_duplo-merl-s0"


def test_variants_of_equal_name_are_the_same_run_in_every_figure() -> None:
    configs: dict[str, TrainConfig] = {}
    for name in EXPERIMENTS:
        for run in planned(name).values():
            assert configs.setdefault(run.name, run.config) == run.config
    assert "reach_duplo-merl-s0" in configs


def test_figure_2_compares_the_agents_of_the_paper() -> None:
    runs = planned("fig2")
    agents = {run.variant: run.config.agent_name for run in runs.values()}
    assert agents == {"merl": "merl", "drqv2": "drqv2", "ddpg": "ddpg", "sac": "sac"}
    assert {run.config.task for run in runs.values()} == {"reach_duplo", "move_box", "lift_box"}


def test_agents_of_the_state_have_preset_state_beside_laptop_alone() -> None:
    presets = {
        preset: [
            run.arguments[2]
            for run in planned("fig2", preset).values()
            if run.name.startswith("reach_duplo")
        ]
        for preset in ("laptop", "paper")
    }
    assert presets["laptop"] == ["laptop", "laptop", "state", "state"]
    assert presets["paper"] == ["paper"] * 4


@pytest.mark.parametrize(("steps", "expected"), [(300_000, 150_000), (2_000_000, 500_000)])
def test_scheduled_noise_falls_within_the_run(steps: int, expected: int) -> None:
    scheduled = planned("fig3d", steps=steps)["reach_duplo-scheduled-s0"].config
    assert (scheduled.agent.noise_std, scheduled.agent.noise_std_end) == (1.0, 0.1)
    assert scheduled.agent.noise_steps == expected
    drqv2 = planned("fig2", steps=steps)["reach_duplo-drqv2-s0"].config
    assert drqv2.agent.noise_steps == expected


def test_published_schedules_and_given_values_stay() -> None:
    published = Variant("published", "drqv2", setting="published")
    given = Variant("given", "drqv2", {"agent.noise-steps": 70_000})
    experiment = Experiment("", (published, given), ("reach_duplo",))
    first, second = plan(experiment, preset="laptop", seeds=[0], out=OUT, values={"steps": 300_000})
    assert first.config.agent.noise_steps == 1_000_000
    assert second.config.agent.noise_steps == 70_000
    assert second.arguments.count("--agent.noise-steps") == 1


@pytest.mark.parametrize("name", ["task", "seed", "run_dir", "run-dir"])
def test_what_a_sweep_sets_itself_is_refused(name: str) -> None:
    experiment = Experiment("", (Variant("a", values={name: "x"}),), ("reach_duplo",))
    with pytest.raises(MerlError, match="a sweep sets"):
        plan(experiment, preset="laptop", seeds=[0], out=OUT)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("steps", 5, ["--steps", "5"]),
        ("env.image_size", 32, ["--image-size", "32"]),
        ("user_env.image_layout", "hwc", ["--env.image-layout", "hwc"]),
        ("agent.fusion_norm", False, ["--agent.no-fusion-norm"]),
        ("agent.standardize", True, ["--agent.standardize"]),
        ("synchronous", False, ["--no-synchronous"]),
        ("env.start", ("above", "around"), ["--start", "above", "around"]),
        ("agent.encoders.left_wrist", "impala", ["--agent.encoders.left_wrist", "impala"]),
        ("agent.encoders", {"wrist": "conv"}, ["--agent.encoders.wrist", "conv"]),
    ],
)
def test_flags_of_a_value(name: str, value: object, expected: list[str]) -> None:
    assert flags(name, value) == expected


def test_a_grid_has_a_variant_for_each_combination() -> None:
    variants = [*variants_of({"agent.latent_dim": (64, 128), "env.image_size": (24,)})]
    assert [variant.name for variant in variants] == [
        "latent_dim=64-image_size=24",
        "latent_dim=128-image_size=24",
    ]
    assert variants[1].values == {"agent.latent_dim": 128, "env.image_size": 24}


def test_an_unknown_value_is_refused_before_anything_runs() -> None:
    experiment = Experiment("", (Variant("a", values={"agent.latent_dimm": 3}),), ("reach_duplo",))
    with pytest.raises(MerlError, match="'latent_dimm' is unknown: did you mean 'latent_dim'"):
        plan(experiment, preset="laptop", seeds=[0], out=OUT)


def test_variants_that_would_share_a_folder_are_refused() -> None:
    experiment = Experiment("", (Variant("a b"), Variant("a/b")), ("reach_duplo",))
    with pytest.raises(MerlError, match="share a run folder: rename one of a b, a/b"):
        plan(experiment, preset="laptop", seeds=[0], out=OUT)
