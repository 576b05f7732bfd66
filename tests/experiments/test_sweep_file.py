"""Sweeps of the user's own in TOML files."""

from __future__ import annotations

from pathlib import Path

import pytest

from merl.core import MerlError
from merl.experiments.experiment import plan
from merl.experiments.sweep_file import read_experiment

SHIPPED = sorted((Path(__file__).parents[2] / "benchmarks/sweeps").glob("*.toml"))
WHOLE = """
title = "Size of the image"
tasks = ["reach_duplo"]
preset = "smoke"
[values]
steps = 2_000
env.observations = ["image", "proprio"]
[variants.small]
env.image_size = 16
agent.encoders.proprio = "mlp"
[variants.camera]
agent_name = "drqv2"
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_a_file_of_variants(tmp_path: Path) -> None:
    experiment = read_experiment(write(tmp_path, WHOLE))
    assert (experiment.title, experiment.preset) == ("Size of the image", "smoke")
    small, camera = plan(experiment, preset="smoke", seeds=[1], out=tmp_path)
    assert small.name == "reach_duplo-small-s1"
    assert (small.config.steps, small.config.env.image_size) == (2000, 16)
    assert small.config.agent.encoders == {"proprio": "mlp"}
    assert small.config.env.observations == ("image", "proprio")
    assert camera.config.agent_name == "drqv2"


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_files_of_this_project_can_be_run(path: Path, tmp_path: Path) -> None:
    experiment = read_experiment(path)
    runs = plan(experiment, preset=experiment.preset or "laptop", seeds=[0], out=tmp_path)
    assert len(runs) == len(experiment.variants) * 2
    assert {run.config.steps for run in runs} == {1_000_000}
    assert all(run.config.evaluated.env.start == ("above",) for run in runs)


def test_a_file_with_a_grid(tmp_path: Path) -> None:
    text = 'tasks = ["move_box"]\n[grid]\nagent.latent_dim = [64, 128]\nagent.tau = [0.01, 0.02]'
    experiment = read_experiment(write(tmp_path, text))
    assert experiment.title == "mine"
    assert len(experiment.variants) == 4
    assert experiment.variants[3].values == {"agent.latent_dim": 128, "agent.tau": 0.02}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tasks = [", "is not TOML"),
        ("", "names no tasks"),
        ("tasks = [1]", "names no tasks"),
        ('tasks = "move_box"', "tasks must be a list, not 'move_box'"),
        ('task = ["move_box"]', "key 'task' is unknown: did you mean 'tasks'"),
        ('tasks = ["a"]', r"needs one of \[variants.NAME\], a table each, and \[grid\]"),
        ('tasks = ["a"]\n[grid]\ntau = 3', r"\[grid\] needs a list of values for tau, not 3"),
        ('tasks = ["a"]\n[variants]', r"needs one of \[variants.NAME\]"),
        ('tasks = ["a"]\n[variants.b]\nagent_name = 5', "agent_name must be a text, not 5"),
        ('tasks = ["a"]\n[variants]\ntau = 3', "variants.tau must be a table, not 3"),
    ],
)
def test_a_file_that_cannot_work_is_refused_in_one_line(
    text: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(MerlError, match=message) as caught:
        read_experiment(write(tmp_path, text))
    assert "mine.toml" in str(caught.value)


def test_agents_and_lists_can_be_values_of_a_grid(tmp_path: Path) -> None:
    text = """
tasks = ["reach_duplo"]
[grid]
agent_name = ["merl", "proprio"]
agent.conv_strides = [[2, 2, 1], [2, 1, 1]]
"""
    experiment = read_experiment(write(tmp_path, text))
    runs = plan(experiment, preset="laptop", seeds=[0], out=tmp_path)
    found = [(run.config.agent_name, run.config.agent.conv_strides) for run in runs]
    strides = [(2, 2, 1), (2, 1, 1)]
    assert found == [(agent, each) for agent in ("merl", "proprio") for each in strides]
    assert len({run.folder for run in runs}) == 4


def test_an_agent_for_all_variants(tmp_path: Path) -> None:
    text = """
tasks = ["reach_duplo"]
[values]
agent_name = "sac"
[variants.one]
[variants.two]
agent_name = "ddpg"
"""
    experiment = read_experiment(write(tmp_path, text))
    assert [variant.agent for variant in experiment.variants] == ["sac", "ddpg"]


def test_a_file_that_is_missing_or_not_text(tmp_path: Path) -> None:
    with pytest.raises(MerlError, match="cannot be read: No such file"):
        read_experiment(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MerlError, match="is not TOML"):
        read_experiment(tmp_path / "binary.toml")
