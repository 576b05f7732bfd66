"""The start of a run in its folder: locking, leftover files, and config changes on resume."""

from __future__ import annotations

import dataclasses
import fcntl
import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from merl.cli import main
from merl.config import CUSTOM, TrainConfig
from merl.core import CONFIG_FILE, MerlError
from merl.experiments.presets import compose
from merl.runs.run import Run
from merl.runs.run_folder import LOCK_FILE, check_links, create_folder
from toy import DotEnv

CONFIG = compose("smoke", "reach_duplo")
SPACES = DotEnv().observation_space, DotEnv().action_space
PENDULUM = "train Pendulum-v1 --agent ddpg --preset smoke --steps 20 --random-steps 10 "
PENDULUM += "--seed-steps 10 --replay.batch-size 8 --agent.hidden-dim 8 --eval.episodes 1 "
PENDULUM += "--eval.video none --eval.no-references --run-dir"


@pytest.fixture
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("commit", "machine", "package_versions"):
        monkeypatch.setattr(f"merl.runs.record.{name}", dict)


def together(*actions: Any) -> list[BaseException | None]:
    """Run all actions at the same time in threads; return the exception of each, or None."""
    barrier, errors = threading.Barrier(len(actions)), [None] * len(actions)

    def do(index: int) -> None:
        barrier.wait()
        try:
            actions[index]()
        except BaseException as error:
            errors[index] = error

    threads = [threading.Thread(target=do, args=(index,)) for index in range(len(actions))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


@pytest.mark.usefixtures("_quick")
def test_runs_that_start_at_once_without_a_name_get_folders_of_their_own(tmp_path: Path) -> None:
    def begin() -> None:
        with Run.begin(CONFIG, *SPACES, home=tmp_path) as run:
            begun.append(run.path.name)

    for _ in range(10):
        begun: list[str] = []
        assert together(*[begin] * 4) == [None] * 4
        assert len(set(begun)) == 4


@pytest.mark.usefixtures("_quick")
@pytest.mark.parametrize("fails", [False, True])
def test_only_one_of_several_processes_starts_a_run(tmp_path: Path, fails: bool) -> None:
    """A start that fails while it holds the lock removes only its own folder."""
    for attempt in range(40):
        config = dataclasses.replace(CONFIG, run_dir=tmp_path / f"run-{attempt}")
        alone = threading.Lock()

        def begin(config: TrainConfig = config, alone: Any = alone) -> None:
            with Run.begin(config, *SPACES) as run:
                assert alone.acquire(blocking=False), "two threads have the lock"
                assert json.loads((run.path / CONFIG_FILE).read_text())["task"] == "reach_duplo"
                if fails:
                    run.discard()
                alone.release()

        errors = together(*[begin] * 4)
        assert all(isinstance(error, MerlError | None) for error in errors), errors
        assert None in errors
        assert fails or errors.count(None) == 1
        if fails:
            assert not config.run_dir.exists() or not any(config.run_dir.iterdir())
        else:
            assert {path.name for path in config.run_dir.iterdir()} == {CONFIG_FILE, LOCK_FILE}


@pytest.mark.usefixtures("_quick")
def test_runs_without_a_given_folder_get_different_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def begin() -> None:
        with Run.begin(CONFIG, *SPACES):
            pass

    assert together(*[begin] * 4) == [None] * 4
    assert len(list((tmp_path / "runs").glob("*/config.json"))) == 4


@pytest.mark.usefixtures("_quick")
def test_a_folder_locked_by_another_process_is_refused(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_text("42")
    config = dataclasses.replace(CONFIG, run_dir=tmp_path)
    with (tmp_path / LOCK_FILE).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with (
            pytest.raises(MerlError, match=r"process 42 is training in .*: stop it first"),
            Run.begin(config, *SPACES),
        ):
            pass
    assert (tmp_path / LOCK_FILE).read_text() == "42"


@pytest.mark.usefixtures("_quick")
def test_discard_keeps_other_files_and_an_existing_folder(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, run_dir=tmp_path / "run")
    with Run.begin(config, *SPACES) as run:
        (run.path / "notes.txt").write_text("precious")
        run.discard()
    assert [path.name for path in run.path.iterdir()] == ["notes.txt"]
    (tmp_path / "mine").mkdir()
    with Run.begin(dataclasses.replace(CONFIG, run_dir=tmp_path / "mine"), *SPACES) as run:
        run.discard()
    assert list((tmp_path / "mine").iterdir()) == []


@pytest.mark.usefixtures("_quick")
@pytest.mark.parametrize("name", ["record.commit", "trust.remember"])
def test_an_interrupted_start_leaves_no_files(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"merl.runs.{name}", interrupt)
    config = dataclasses.replace(CONFIG, run_dir=tmp_path / "run")
    with pytest.raises(KeyboardInterrupt), Run.begin(config, *SPACES):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("left", [(), (LOCK_FILE,), (LOCK_FILE, ".config.json.part")])
@pytest.mark.parametrize("resume", [["--resume"], []])
def test_a_run_killed_before_its_config_is_started_by_the_same_command(
    tmp_path: Path, left: tuple[str, ...], resume: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in left:
        (folder / name).write_text("12")
    assert main(["resume", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "is not a run: it has no config.json and no other files: start it with" in error
    assert f"train ... --run-dir {folder}\n" in error
    assert error.count("\n") == 1
    assert main([*PENDULUM.split(), str(folder), "--threads", "1", *resume]) == 0
    assert (folder / "checkpoints" / "00000020").is_dir()


@pytest.mark.parametrize("foreign", ["notes.txt", ".hidden", "checkpoints"])
def test_a_folder_with_other_files_is_refused(
    tmp_path: Path, foreign: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / foreign).write_text("precious")
    assert main([*PENDULUM.split(), str(tmp_path), "--resume"]) == 2
    assert "already exists: it is not a run" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [foreign]


@pytest.fixture(scope="module")
def trained_runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Train a run that left threads and precision open, and one with given values."""
    folder = tmp_path_factory.mktemp("runs")
    given = ["--threads", "1", "--agent.precision", "bf16"]
    for name, flags in {"open": [], "given": given}.items():
        assert main([*PENDULUM.split(), str(folder / name), *flags]) == 0
    return {name: folder / name for name in ("open", "given")}


BF16 = ("--threads", "1", "--agent.precision", "bf16")


@pytest.mark.parametrize(
    ("run", "moved", "line", "threads", "precision"),
    [
        ("open", True, ["resume"], None, "auto"),
        ("open", True, ["train"], None, "auto"),
        ("open", True, ["train", *BF16], 1, "bf16"),
        ("open", False, ["train", *BF16], 1, "bf16"),
        ("given", True, ["resume"], 1, "bf16"),
        ("given", True, ["train"], 1, "bf16"),
        ("given", True, ["train", *BF16], 1, "bf16"),
        ("given", True, ["train", "--agent.precision", "fp32"], 1, "fp32"),
        ("given", False, ["train", "--agent.precision", "auto"], 1, "auto"),
        ("given", False, ["train", "--agent.precision=auto", "--threads", "None"], None, "auto"),
    ],
)
def test_options_of_the_command_are_used_on_this_and_another_machine(
    trained_runs: dict[str, Path],
    run: str,
    moved: bool,
    line: list[str],
    threads: int | None,
    precision: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    trained: list[TrainConfig] = []
    monkeypatch.setattr("merl.cli.running._train", lambda config, *_: trained.append(config) or 0)
    monkeypatch.setattr(Run, "has_moved", lambda _: moved)
    folder, (command, *flags) = str(trained_runs[run]), line
    if command == "resume":
        arguments = ["resume", folder, "--steps", "30"]
    else:
        arguments = [*PENDULUM.replace("--steps 20", "--steps 30").split(), folder, "--resume"]
    assert main([*arguments, *flags]) == 0
    (config,) = trained
    assert (config.threads, config.agent.precision) == (threads, precision)


def test_device_auto_replaces_a_recorded_device_that_is_missing(
    trained_runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run was last trained on a GPU."""
    folder = tmp_path / "run"
    shutil.copytree(trained_runs["given"], folder)
    record = json.loads((folder / "config.json").read_text())
    del record["checksum"]
    record["config"]["device"] = "cuda"
    (folder / "config.json").write_text(json.dumps(record))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert main(["resume", str(folder), "--steps", "30"]) == 2
    assert main(["resume", str(folder), "--steps", "30", "--device", "auto"]) == 0
    record = json.loads((folder / "config.json").read_text())
    assert (record["config"]["device"], record["config"]["agent"]["precision"]) == ("cpu", "bf16")
    assert record["left_open"] == ["agent.torch_compile"]


def test_a_loop_of_links_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(MerlError, match="is a link"):
        check_links(tmp_path)


def test_a_config_with_too_deep_nesting_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("[" * 100_000)
    with pytest.raises(MerlError, match="cannot be read"):
        Run.open(tmp_path)


@pytest.mark.timeout(30)
@pytest.mark.parametrize("run_dir", [None, Path("runs/mine")])
def test_a_folder_of_runs_that_is_a_dangling_link_is_named_in_one_line(
    run_dir: Path | None, tmp_path: Path
) -> None:
    (tmp_path / "runs").symlink_to(tmp_path / "nowhere")
    config = dataclasses.replace(CONFIG, run_dir=run_dir)
    with pytest.raises(MerlError, match=r"runs is a link to a folder that does not exist: create"):
        create_folder(config, CUSTOM, tmp_path)
    (tmp_path / "nowhere").mkdir()
    assert create_folder(config, CUSTOM, tmp_path)[1]
