"""Folders that an earlier version wrote, one for each format of its files, can still be read.

tests/data has them: 60 steps of `merl train merl.envs.dot:whole --agent ddpg`, and an episode of
demonstrations of the same environment, both from commit 9ba8355. A format that changes gets a new
folder beside the old one, made by the version that introduces it.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import merl
from merl.cli import main
from merl.demos import demonstrations
from merl.demos.demonstrations import Demonstrations
from merl.runs import checkpoint, record
from merl.runs.checking import check_run
from merl.runs.run import Run

DATA = Path(__file__).parents[1] / "data"
RUN, DEMOS = DATA / f"run_format_{record.FORMAT}", DATA / f"demos_format_{demonstrations.FORMAT}"
ACTION = 0.20809222757816315, 0.23996524512767792
"""What the policy did, in the version that trained it, for the observation in the test below."""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(RUN, tmp_path / "run"))


def test_each_format_has_its_folder() -> None:
    assert {each.name for each in DATA.iterdir()} >= {RUN.name, DEMOS.name}
    assert (checkpoint.FORMAT, record.FORMAT, demonstrations.FORMAT) == (1, 2, 1)


def test_a_run_is_sound(run: Path) -> None:
    findings = list(check_run(Run.open(run)))
    assert len(findings) == 4
    assert [each.text for each in findings if not each.sound] == []


def test_a_run_resumes(run: Path) -> None:
    assert main(["resume", str(run), "--steps", "100"]) == 0
    assert Run.open(run).path.joinpath("checkpoints/00000100").is_dir()
    lines = (run / "metrics.csv").read_text().splitlines()
    assert lines[: len(kept := (RUN / "metrics.csv").read_text().splitlines())] == kept
    assert lines[-1].startswith("100,")


def test_a_policy_acts_as_it_did_in_the_version_that_trained_it() -> None:
    action = merl.load_policy(RUN)({"joints": np.array([0.3, -0.6], np.float32)})
    np.testing.assert_allclose(action, ACTION, atol=1e-5)


def test_demonstrations_are_read() -> None:
    demos = Demonstrations.open(DEMOS)
    (episode,) = demos.episodes()
    assert len(episode) == demos.steps == 20
    assert episode.success
