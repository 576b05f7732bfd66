"""Training that begins with cloning: `--demos-pretrain`."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import merl
from helpers import flat, wait_for
from merl.cli import main
from merl.config import override
from merl.core import MerlError
from merl.experiments.cloning_first import starts_cloned
from merl.experiments.experiment import PlannedRun
from merl.experiments.sweep import is_done
from merl.runs.run import Run

TINY = ["--preset", "smoke", "--eval.every", "0", "--threads", "1", "--random-steps", "0"]
TINY += ["--seed-steps", "100", "--agent.precision", "fp32", "--save-every", "0"]
TINY += ["--replay.batch-size", "16", "--eval.video", "none"]


@pytest.fixture(scope="module")
def train(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Record two episodes of reach_duplo; return a command that learns from them."""
    out = tmp_path_factory.mktemp("demos") / "reach"
    record = ["demos", "record", "reach_duplo", "--preset", "smoke", "--episodes", "2"]
    assert main([*record, "--out", str(out)]) == 0
    return ["train", "reach_duplo", *TINY, "--steps", "500", "--demos", str(out)]


def weights(run: Path, step: int) -> dict[str, torch.Tensor]:
    return load_file(run / f"checkpoints/{step:08}/weights.safetensors")


def policy(run: Path, step: int) -> dict[str, torch.Tensor]:
    parts = ("networks.encoders", "networks.actor")
    return {k: v for k, v in weights(run, step).items() if k.startswith(parts)}


@pytest.fixture(scope="module")
def whole(train: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a run that begins with 500 updates of cloning."""
    run = tmp_path_factory.mktemp("runs") / "whole"
    options = ["--keep", "9", "--run-dir", str(run)]
    assert main([*train, "--demos-pretrain", "500", *options]) == 0
    return run


def test_the_run_starts_with_the_cloned_policy(whole: Path) -> None:
    cloned = policy(whole.with_name("whole-bc"), 500)
    for name, value in policy(whole, 0).items():
        torch.testing.assert_close(value, cloned[name], rtol=0, atol=0)
    config = json.loads((whole / "config.json").read_text())["config"]
    assert config["agent"]["start_from"] == str(whole.with_name("whole-bc"))
    assert config["demos_pretrain"] == 0
    first = json.loads((whole.with_name("whole-bc") / "config.json").read_text())["config"]
    assert (first["agent_name"], first["demos_ratio"], first["steps"]) == ("bc", 1.0, 500)


def test_a_sweep_knows_its_run_that_cloned_first(whole: Path) -> None:
    config, cloned = Run.open(whole).config, whole.with_name("whole-bc")
    agent = override(config.agent, {"start_from": None})
    run = PlannedRun("whole", whole, "merl", replace(config, demos_pretrain=500, agent=agent), ())
    assert not is_done(run, 1)  # it is not evaluated

    def named(start: str) -> PlannedRun:
        return replace(run, config=override(config, {"agent.start_from": start}))

    assert not is_done(named(str(cloned)), 1)
    with pytest.raises(MerlError, match=r"another experiment \(agent.start_from .*-bc, not x\)"):
        is_done(named("x"), 1)


@pytest.mark.parametrize("start", [None, Path("another-bc")])
def test_a_run_that_was_not_cloned_first_differs_in_its_start(whole: Path, start: object) -> None:
    found, cloned = Run.open(whole), whole.with_name("whole-bc")
    asked = override(found.config, {"demos_pretrain": 500, "agent.start_from": None})
    other = replace(found, config=override(found.config, {"agent.start_from": start}))
    assert starts_cloned(asked, other).agent.start_from == cloned  # type: ignore[attr-defined]


def test_the_same_command_continues_a_cloning_that_was_stopped(
    train: list[str], whole: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    command = [*train, "--demos-pretrain", "500", "--keep", "9", "--run-dir", str(run), "--resume"]
    with subprocess.Popen([sys.executable, "-m", "merl.cli", *command], text=True) as process:
        wait_for((tmp_path / "run-bc/checkpoints/00000250").exists, process)
        process.send_signal(signal.SIGTERM)
        assert process.wait() == 128 + signal.SIGTERM
    assert not run.exists()
    assert main(command) == 0
    resumed = weights(run, 500)
    for name, value in weights(whole, 500).items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=0)
    assert main(command) == 0  # nothing is left to do


def test_frozen_encoders_stay_as_cloning_left_them(train: list[str], tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [*train, "--demos-pretrain", "250", "--demos-freeze", "--run-dir", str(run)]
    assert main(command) == 0
    config = json.loads((run / "config.json").read_text())["config"]["agent"]
    assert sorted(config["frozen_encoders"]) == ["image", "proprio"]
    cloned, learnt = policy(run.with_name("run-bc"), 250), policy(run, 500)
    encoders = [name for name in cloned if ".encoders." in name]
    assert len(encoders) > 4
    assert all(learnt[name].equal(cloned[name]) for name in encoders)
    assert not all(learnt[name].equal(value) for name, value in cloned.items())
    first = policy(run.with_name("run-bc"), 0)
    assert not all(first[name].equal(cloned[name]) for name in encoders)
    assert main([*command, "--steps", "600", "--resume"]) == 0
    assert policy(run, 600)[encoders[0]].equal(cloned[encoders[0]])


def test_agent_ibrl_keeps_the_cloned_policy_and_resumes_exactly(
    train: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [*train, "--agent", "ibrl", "--demos-pretrain", "250", "--keep", "9", "--resume"]
    whole, run = tmp_path / "whole", tmp_path / "run"
    assert main([*command, "--run-dir", str(whole)]) == 0
    assert main([*command, "--steps", "250", "--run-dir", str(run)]) == 0
    assert main([*command, "--run-dir", str(run)]) == 0
    learnt, resumed = weights(whole, 500), weights(run, 500)
    assert all(value.equal(learnt[name]) for name, value in resumed.items())
    for name, value in weights(run.with_name("run-bc"), 250).items():
        if name.startswith("networks.actor."):
            own, kept = (name.replace("actor", part, 1) for part in ("actor", "imitator.actor"))
            assert learnt[kept].equal(value)
            assert not learnt[own].equal(value)
    assert main(["export", str(run), "--to", "numpy", "--out", str(tmp_path / "p.py")]) == 2
    assert "a policy of agent ibrl chooses by its critic" in flat(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--agent", "sac"], "MERL's actor, which agent sac does not have: use --demos-pretrain 0"),
        (["--agent.start-from", "elsewhere"], "both name a policy to start with"),
    ],
)
def test_what_cannot_start_cloned_is_refused(
    options: list[str], line: str, train: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*train, "--demos-pretrain", "500", *options]) == 2
    assert line in flat(capsys.readouterr().err)


def test_preset_demos_needs_demonstrations(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "move_box", "--preset", "demos"]) == 2
    error = flat(capsys.readouterr().err)
    assert "demos-pretrain 30000 clones demonstrations: name a folder of them with --demos" in error


def test_cloning_first_from_python(train: list[str], tmp_path: Path) -> None:
    demos = {"demos": Path(train[-1]), "demos_pretrain": 250, "threads": 1, "seed_steps": 100}
    evaluation = {"eval.video": "none", "eval.episodes": 1, "eval.references": False}
    run = tmp_path / "run"
    outcome = merl.train(
        "reach_duplo", preset="smoke", steps=250, run_dir=str(run), progress=False,
        **demos, **evaluation,
    )  # fmt: skip
    assert outcome.progress.step == 250
    assert merl.load_policy(tmp_path / "run-bc").step == 250
