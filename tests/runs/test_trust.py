"""Untrusted run folders: opening, evaluating and resuming one imports no code of it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from gymnasium import spaces

import merl
from merl.cli import main
from merl.core import MerlError
from merl.core.user_code import module_folder
from merl.envs.user_env import imports_code, load_module
from merl.runs import trust
from merl.runs.run import Run
from merl.runs.trust import Origin

TOY = """
import gymnasium
from gymnasium import spaces


class Arm(gymnasium.Env):
    observation_space = spaces.Dict({"state": spaces.Box(-1, 1, (2,))})
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.taken = 0
        return self.see(), {}

    def step(self, action):
        self.taken += 1
        return self.see(), 1.0, False, self.taken == 10, {}

    def see(self):
        return {"state": self.np_random.uniform(-1, 1, 2).astype("float32")}


def make():
    return Arm()
"""
TASK = "toy_arm:make"
_FLAGS = {
    "--agent": "ddpg",
    "--preset": "smoke",
    "--steps": 20,
    "--random-steps": 10,
    "--seed-steps": 10,
    "--replay.batch-size": 8,
    "--threads": 1,
    "--agent.precision": "fp32",
    "--agent.hidden-dim": 8,
    "--eval.episodes": 1,
    "--eval.video": "none",
}
SMALL = [str(part) for flag in _FLAGS.items() for part in flag] + ["--eval.no-references"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Train a run as this user, with an environment in the current folder."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "toy_arm.py").write_text(TOY)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        before = list(sys.path)
        assert main(["train", "toy_arm:make", *SMALL, "--run-dir", "run"]) == 0
        assert sys.path == [*before, str(folder)]  # the folder is appended
    yield folder / "run"
    sys.path.remove(str(folder))


@pytest.fixture(autouse=True)
def _fresh_modules() -> Iterator[None]:
    before = list(sys.path)
    yield
    for name in ("toy_arm", "evil", "colorsys"):
        sys.modules.pop(name, None)
    sys.path[:] = before


@pytest.fixture
def untrusted(trained: Path, tmp_path: Path) -> Path:
    """Copy the run and add hostile modules that write a file when they are imported."""
    folder = tmp_path / "untrusted"
    shutil.copytree(trained, folder)
    for name in ("evil", "toy_arm"):
        plant(folder / f"{name}.py")
    return folder


def plant(path: Path) -> None:
    """Write a module with the environment, which also writes `imported` beside itself."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mark = f"open({str(path.parent / 'imported')!r}, 'a').write({path.name!r})\n"
    path.write_text(mark + TOY)


def edit(run: Path, change: Callable[[dict[str, Any]], object]) -> None:
    record = json.loads((run / "config.json").read_text())
    record.pop("checksum", None)
    change(record)
    (run / "config.json").write_text(json.dumps(record))


def set_task(run: Path, task: str) -> None:
    edit(run, lambda record: record.update(task=task, module_folders={task: str(run)}))
    edit(run, lambda record: record["config"].update(task=task))


COMMANDS = (["evaluate", "--episodes", "1"], ["resume"])


@pytest.mark.parametrize(
    ("attack", "named"),
    [
        (lambda run: set_task(run, "evil:make"), "'make' of module 'evil', in folder '{run}'"),
        (lambda run: set_task(run, "http.server:test"), "'test' of module 'http.server'"),
        (lambda run: set_task(run, "evil:\x1b[2JFake-v0"), r"'\x1b[2JFake-v0' of module 'evil'"),
        (lambda run: edit(run, lambda record: record.pop("id")), "no record of training it here"),
        (lambda run: edit(run, lambda record: record.update(id="../runs")), "no record of"),
        (lambda run: edit(run, lambda record: record.update(id=["a"])), "no record of"),
    ],
)
def test_code_that_a_run_names_is_not_imported(
    untrusted: Path,
    attack: Callable[[Path], None],
    named: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    attack(untrusted)
    monkeypatch.chdir(untrusted)
    for command, *more in COMMANDS:
        assert main([command, ".", *more]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert named.format(run=untrusted) in error
        assert "add --trust" in error
    policy = merl.load_policy(untrusted)  # runs no code
    with pytest.raises(MerlError, match="names code as its environment"):
        policy.make_env()
    assert not (untrusted / "imported").exists()


def test_a_run_trained_here_imports_its_recorded_module(
    untrusted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder in its config and the working folder are not trusted."""
    edit(untrusted, lambda record: record.update(module_folders={TASK: str(untrusted)}))
    monkeypatch.chdir(untrusted)
    for command, *more in COMMANDS:
        assert main([command, ".", *more]) == 0
    merl.load_policy(untrusted).make_env().close()
    assert not (untrusted / "imported").exists()


def test_an_environment_registered_by_others_counts_as_code(untrusted: Path) -> None:
    gymnasium.register("Evil-v0", entry_point="evil:make")
    try:
        set_task(untrusted, "Evil-v0")
        with pytest.raises(MerlError, match="Gymnasium environment 'Evil-v0'"):
            Run.open(untrusted).load_module()
        assert imports_code("Evil-v0")
    finally:
        gymnasium.registry.pop("Evil-v0")
    for task in ("reach_duplo", "Pendulum-v1", "merl.envs.dot:whole"):
        assert not imports_code(task)
    for task in ("merl.cli:main", "os:getcwd", "gymnasium:make"):
        assert imports_code(task)


def test_the_trust_flag_is_reported_and_recorded_on_resume(
    untrusted: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another user"))
    monkeypatch.chdir(tmp_path)
    edit(untrusted, lambda record: record.update(module_folders={TASK: str(untrusted)}))
    run = str(untrusted)
    assert main(["evaluate", run, "--episodes", "1"]) == 2
    capsys.readouterr()
    assert main(["evaluate", run, "--episodes", "1", "--trust"]) == 0
    importing = f"importing 'make' of module 'toy_arm', in folder {run!r}\n"
    assert capsys.readouterr().err == f"merl: --trust: {importing}"
    assert (untrusted / "imported").read_text() == "toy_arm.py"
    merl.load_policy(untrusted).make_env(trust=True).close()
    assert main(["resume", run, "--steps", "40"]) == 2  # an evaluation is not recorded as training
    assert main(["resume", run, "--steps", "40", "--trust"]) == 0
    assert main(["evaluate", run, "--episodes", "1"]) == 0


def test_train_with_resume_trusts_the_module_of_the_command(
    untrusted: Path, trained: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`train --resume` imports the named module from the working folder of the user."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another user"))
    edit(untrusted, lambda record: record.update(module_folders={TASK: str(untrusted)}))
    monkeypatch.chdir(trained.parent)
    line = ["train", "toy_arm:make", *SMALL, "--run-dir", str(untrusted), "--resume"]
    assert main(line) == 0
    assert not (untrusted / "imported").exists()


def test_a_module_is_loaded_from_its_folder_and_replaces_no_other(tmp_path: Path) -> None:
    """Files have the names of modules of Python: one that is loaded, and one that is not."""
    sys.modules.pop("colorsys", None)
    for name in ("colorsys", "json"):
        (tmp_path / f"{name}.py").write_text(TOY)
    module = load_module("colorsys:make", tmp_path)
    assert module.__file__ == str(tmp_path / "colorsys.py")
    assert module_folder("colorsys:make") == tmp_path
    assert sys.path[-1] == str(tmp_path)
    says = r"json\.py cannot be imported, because another module is named 'json'"
    with pytest.raises(MerlError, match=says):
        load_module("json:make", tmp_path)
    assert sys.modules["json"] is json


def test_nothing_is_trusted_if_no_record_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    identity = trust.identity()
    config = {"task": "evil:make", "agent_name": "merl", "agent": {}}
    record = {"id": identity, "config": config, "module_folders": {}}
    origin = Origin({"environment": "evil:make", "agent": "merl"}, {})
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    trust.remember(record)
    assert "--trust will be needed" in caplog.text
    with pytest.raises(MerlError, match="records of runs cannot be read"):
        trust.check(tmp_path, record)
    monkeypatch.setenv("XDG_STATE_HOME", "relative")  # would be in the working folder
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    trust.remember(record)
    assert (tmp_path / ".local" / "state" / "merl" / "runs" / identity).is_file()
    assert not (tmp_path / "relative").exists()
    assert trust.check(tmp_path, record) == origin


@pytest.mark.parametrize("name", ["lock", ".config.json.part", "checkpoints/00000020", "replay"])
def test_resume_refuses_links_out_of_the_run(
    untrusted: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    outside, link = tmp_path / "outside", untrusted / name
    outside.write_text("precious")
    if link.exists() and not link.is_dir():
        link.unlink()
    elif link.exists():
        shutil.rmtree(link)
    link.symlink_to(outside)
    assert main(["resume", str(untrusted), "--steps", "40"]) == 2
    assert f"{link} is a link to {outside}, outside of the run" in capsys.readouterr().err
    assert outside.read_text() == "precious"


def test_the_working_folder_is_not_searched(tmp_path: Path) -> None:
    """`python -m` would search the working folder first."""
    for name in ("gymnasium", "numpy", "typing", "logging", "dm_control"):
        plant(tmp_path / f"{name}.py")
    command = [sys.executable, "-m", "merl.cli", "--version"]
    source = str(Path(merl.__file__).parents[1])
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": source},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.stdout.startswith("merl "), done.stderr
    assert not (tmp_path / "imported").exists()


def test_spaces_are_read_without_running_code(trained: Path) -> None:
    observation, _ = Run.open(trained).spaces()
    assert observation["state"] == spaces.Box(-1, 1, (2,))


ENCODER = """
from torch import nn


class Wrist(nn.Linear):
    features = 3

    def __init__(self, modality, stack):
        super().__init__(modality.shape[0], 3)
"""


@pytest.fixture
def encoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Train a run with an encoder of the working folder; return the command."""
    (tmp_path / "wrist.py").write_text(ENCODER)
    monkeypatch.chdir(tmp_path)
    command = ["train", "merl.envs.dot:whole", *SMALL, "--agent", "proprio", "--run-dir", "run"]
    command += ["--agent.encoders.joints", "wrist:Wrist"]
    assert main(command) == 0
    del sys.modules["wrist"]
    yield command
    sys.modules.pop("wrist", None)


def test_a_run_trained_here_imports_its_encoder(
    encoded: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert encoded
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "1"]) == 0
    del sys.modules["wrist"]
    assert main(["resume", str(tmp_path / "run"), "--steps", "40"]) == 0
    assert sys.modules["wrist"].__file__ == str(tmp_path / "wrist.py")


def test_the_encoder_of_an_untrusted_run_is_not_imported(
    encoded: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    mark = tmp_path / "imported"
    (tmp_path / "wrist.py").write_text(f"open({str(mark)!r}, 'w')\n{ENCODER}")
    run = tmp_path / "run"

    def refused(*command: str) -> str:
        assert main(list(command)) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert not mark.exists()
        return error

    edit(run, lambda record: record["config"]["agent"]["encoders"].update(joints="http.server:A"))
    assert "its config.json was changed since then" in refused("evaluate", str(run))
    edit(run, lambda record: record["config"]["agent"]["encoders"].update(joints="wrist:Wrist"))

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "of another user"))
    named = "names code as its encoder of 'joints': 'Wrist' of module 'wrist', in folder"
    for command, *more in COMMANDS:
        assert named in refused(command, str(run), *more)
    with pytest.raises(MerlError, match=r"add --trust \(in Python: trust=True\)"):
        merl.load_policy(run)
    assert "cannot resume with agent.encoders" in refused(*encoded[:-1], "identity", "--resume")
    assert main(["evaluate", str(run), "--episodes", "1", "--trust"]) == 0
    assert "--trust: importing 'Wrist' of module 'wrist'" in capsys.readouterr().err
    assert mark.exists()
    assert main([*encoded, "--resume", "--steps", "40"]) == 0  # names the encoder in its folder
