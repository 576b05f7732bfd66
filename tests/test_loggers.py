"""TensorBoard, Weights & Biases, trackio and a user's own logger get the rows of `metrics.csv`."""

from __future__ import annotations

import errno
import io
import json
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import merl
from helpers import wait_for
from merl import loggers
from merl.cli import main
from merl.core import MerlError
from merl.report.curves import read_metrics
from merl.training.outcome import Outcome
from test_api import SMALL, TASK, Recorder

Rows = dict[str, list[tuple[int, float]]]


def logged(run: Path) -> Rows:
    """Return the rows of `metrics.csv` as {metric: [(step, value)]}."""
    metrics = read_metrics(run)
    steps = metrics.pop("step").astype(int)
    return {
        name: [(int(s), v) for s, v in zip(steps, values, strict=True) if np.isfinite(v)]
        for name, values in metrics.items()
    }


def assert_same(rows: Rows, expected: Rows, tolerance: float = 0.0) -> None:
    assert rows.keys() == expected.keys()
    for name, values in expected.items():
        last = sorted(dict(rows[name]).items())  # a row and an evaluation may share a step
        np.testing.assert_allclose(last, values, rtol=tolerance, err_msg=name)


def tensorboard(run: Path) -> Rows:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    accumulator = EventAccumulator(str(run / "tensorboard"))
    accumulator.Reload()
    tags = accumulator.Tags()["scalars"]
    return {tag: [(e.step, e.value) for e in accumulator.Scalars(tag)] for tag in tags}


def records(path: Path) -> Iterator[bytes]:
    """Yield the records of a `.wandb` file, which has the format of LevelDB's log files."""
    data, position, parts = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if (left := -position % 32768) < 7:  # no header fits into the rest of the block
            position += left
            continue
        length, kind = struct.unpack_from("<HB", data, position + 4)
        parts += data[position + 7 : position + 7 + length]
        position += 7 + length
        if kind in (1, 4):  # a whole record, or its last part
            yield parts
            parts = b""


def wandb(run: Path) -> Rows:
    """Read the files of W&B's offline mode."""
    from wandb.proto.wandb_internal_pb2 import Record

    rows: dict[str, dict[int, float]] = {}
    for path in sorted(run.parent.glob("wandb/offline-run-*/*.wandb")):
        for data in records(path):
            record = Record.FromString(data)
            for item in record.history.item:
                name = item.key or "/".join(item.nested_key)
                if not name.startswith("_"):
                    step = record.history.step.num
                    rows.setdefault(name, {})[step] = json.loads(item.value_json)
    return {name: sorted(values.items()) for name, values in rows.items()}


def trackio(run: Path) -> Rows:
    """Read trackio's local database with its own reader."""
    from trackio.sqlite_storage import SQLiteStorage

    (name,) = SQLiteStorage.get_runs("merl")
    assert name.startswith(f"{run.name}-")
    rows: Rows = {}
    for row in SQLiteStorage.get_logs("merl", name):
        for key, value in row.items():
            if key not in ("step", "timestamp"):
                rows.setdefault(key, []).append((row["step"], value))
    return rows


READERS = {"tensorboard": tensorboard, "wandb": wandb, "trackio": trackio}


@pytest.fixture(autouse=True)
def _local(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Let W&B and trackio write to the test's folder and never to a network."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_DIR", str(tmp_path))
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    if "trackio" in sys.modules:  # it reads the variable when it is imported
        from trackio import sqlite_storage, utils

        for module in (sqlite_storage, utils):
            if hasattr(module, "TRACKIO_DIR"):
                monkeypatch.setattr(module, "TRACKIO_DIR", tmp_path / "trackio")
    yield
    if sys.modules.get("wandb") is not None:
        sys.modules["wandb"].teardown()  # it keeps the variables of its first use


@pytest.mark.parametrize("name", READERS)
def test_a_run_and_its_resume_are_one_log_with_the_names_of_metrics_csv(
    name: str, tmp_path: Path
) -> None:
    pytest.importorskip(name)
    run = tmp_path / "run"
    merl.train(TASK, run_dir=run, log=(name,), **SMALL)
    merl.resume(run, steps=100)
    expected = logged(run)
    assert [step for step, _ in expected["train/return"]] == [20, 40, 60, 80, 100]
    assert "eval/return" in expected
    assert_same(READERS[name](run), expected, tolerance=1e-6)  # TensorBoard stores float32


def test_tensorboard_shows_rows_that_a_killed_run_repeats_once(tmp_path: Path) -> None:
    """The run is killed at step 100, some episodes after its last checkpoint."""
    pytest.importorskip("tensorboard")
    program = (
        "import os, signal, sys, merl\n"
        "sys.path.insert(0, sys.argv[2])\n"
        "from test_api import SMALL, TASK\n"
        "class Kill(merl.Callback):\n"
        "    def on_episode(self, step, metrics):\n"
        "        if step == 100: os.kill(os.getpid(), signal.SIGKILL)\n"
        "merl.train(TASK, run_dir=sys.argv[1], callbacks=[Kill()], log=('tensorboard',),\n"
        "           **SMALL | {'steps': 110, 'eval.every': 1000, 'save_every': 1e6})\n"
    )
    run = tmp_path / "run"
    command = [sys.executable, "-c", program, str(run), str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    merl.resume(run)
    expected = logged(run)
    got = tensorboard(run)
    assert [step for step, _ in got["train/return"]] == [20, 40, 60, 80, 100]
    for each in (name for name in expected if name.startswith(("train/", "learn/"))):
        np.testing.assert_allclose(np.array(got[each]), np.array(expected[each]), rtol=1e-6)


def test_wandb_skips_steps_that_a_killed_run_repeats(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    run = SimpleNamespace(path=tmp_path / "run", public_id="0123456789abcdef")
    progress, warnings = SimpleNamespace(step=0), list[str]()
    trainer: Any = SimpleNamespace(
        run=run, progress=progress, config=merl.TrainConfig(TASK), warn=warnings.append
    )
    logger = loggers.WandB()
    logger.on_start(trainer)
    for step, value in ((10, 1.0), (5, 2.0), (10, 3.0), (20, 4.0)):
        logger.on_episode(step, {f"value{value:g}": value})
    logger.on_end(None)
    assert wandb(run.path) == {"value1": [(10, 1.0)], "value3": [(10, 3.0)], "value4": [(20, 4.0)]}
    assert warnings == []


def test_several_loggers_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in READERS:
        pytest.importorskip(name)
    run = tmp_path / "run"
    line = f"train {TASK} --preset smoke --steps 40 --random-steps 20 --seed-steps 20 --threads 1"
    flags = ["--eval.video", "none", "--eval.no-references", "--run-dir", str(run)]
    assert main([*line.split(), *flags, "--log", *READERS]) == 0
    for read in READERS.values():
        assert_same(read(run), logged(run), tolerance=1e-6)
    assert "warning" not in capsys.readouterr().out


@pytest.mark.parametrize("name", READERS)
def test_a_missing_extra_is_named_before_anything_is_written(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in [m for m in sys.modules if m.partition(".")[0] == name]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MerlError) as caught:
        merl.train(TASK, run_dir=tmp_path / "run", log=(name,), **SMALL)
    message = str(caught.value)
    assert message.startswith(f"logger {name} cannot be used (")
    assert message.endswith(f"install it with `pip install 'merl-rl[{name}]'`")
    assert "\n" not in message
    assert not (tmp_path / "run").exists()


def test_an_unknown_logger_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "reach_duplo", "--log", "tensorbord"]) == 2
    assert "tensorbord" in (message := capsys.readouterr().err)
    assert "did you mean 'tensorboard'" in message


class Unreliable(loggers.Logger):
    """A logger of a service that can be unreachable."""

    def __init__(self) -> None:
        self.fails: set[str] = set()
        self.rows: dict[int, Mapping[str, float]] = {}
        self.closed = False

    def open(self, trainer: merl.Trainer) -> None:
        if "open" in self.fails:
            raise ConnectionError("no network")

    def log(self, step: int, values: Mapping[str, float]) -> None:
        if "log" in self.fails:
            raise ConnectionError("no network")
        self.rows[step] = values

    def close(self, outcome: Outcome | None) -> None:
        self.closed = True
        if "log" in self.fails:
            raise ConnectionError("no network")


class Warnings(Recorder):
    def on_start(self, trainer: merl.Trainer) -> None:
        pass

    def on_warning(self, message: str) -> None:
        self.calls[message] += 1


def test_a_logger_that_fails_gives_one_warning_and_the_run_continues(tmp_path: Path) -> None:
    logger, warnings = Unreliable(), Warnings()
    logger.fails = {"log"}
    outcome = merl.train(TASK, run_dir=tmp_path / "run", callbacks=[logger, warnings], **SMALL)
    assert (outcome.progress.step, outcome.saved, logger.closed) == (60, True, True)
    given = {text: count for text, count in warnings.calls.items() if "Unreliable" in text}
    (message,) = given
    assert message.startswith("Unreliable does not log everything: ConnectionError: no network (")
    assert message.endswith("; training continues, and metrics.csv has all metrics")
    assert given[message] == 1
    assert len(logged(tmp_path / "run")["train/return"]) == 3


def test_a_logger_that_cannot_start_ends_a_new_run_but_not_a_resumed_one(tmp_path: Path) -> None:
    logger, warnings = Unreliable(), Warnings()
    logger.fails = {"open"}
    with pytest.raises(MerlError, match="Unreliable cannot log: ConnectionError: no network"):
        merl.train(TASK, run_dir=tmp_path / "run", callbacks=[logger], **SMALL)
    assert not (tmp_path / "run").exists()
    merl.train(TASK, run_dir=tmp_path / "run", **SMALL)
    merl.resume(tmp_path / "run", steps=80, callbacks=[logger, warnings])
    assert sum("Unreliable" in text for text in warnings.calls) == 1
    assert [*logger.rows] == [80]


def test_the_log_option_may_change_on_resume(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    run = tmp_path / "run"
    line = f"train {TASK} --preset smoke --random-steps 20 --seed-steps 20 --threads 1"
    flags = ["--eval.every", "0", "--agent.precision", "fp32", "--run-dir", str(run), "--resume"]
    assert main([*line.split(), *flags, "--steps", "40"]) == 0
    assert not (run / "tensorboard").exists()
    assert main([*line.split(), *flags, "--steps", "80", "--log", "tensorboard"]) == 0
    assert [step for step, _ in tensorboard(run)["train/return"]] == [60, 80]


class FullDisk(io.FileIO):
    """A file that accepts a few bytes and then none, while `full`."""

    full = False

    def write(self, data: Any) -> int:
        if not FullDisk.full:
            return super().write(data) or 0
        if len(data) > 3:
            return super().write(bytes(data)[:3]) or 0
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_tensorboard_continues_after_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorboard")
    monkeypatch.setattr(loggers.io, "FileIO", FullDisk)
    warnings: list[str] = []
    trainer: Any = SimpleNamespace(
        run=SimpleNamespace(path=tmp_path), progress=SimpleNamespace(step=0), warn=warnings.append
    )
    logger = loggers.TensorBoard()
    logger.on_start(trainer)
    for step in range(1, 5):
        FullDisk.full = step in (2, 3)
        logger.on_episode(step, {"a": step})
    logger.on_end(None)
    assert tensorboard(tmp_path) == {"a": [(1, 1.0), (4, 4.0)]}  # no part of the other rows
    (warning,) = warnings
    assert "No space left on device" in warning


def test_tensorboard_prints_nothing_and_does_not_import_tensorflow(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    (tmp_path / "tensorflow.py").write_text("raise SystemExit('TensorFlow was imported')")
    program = (
        "import sys\n"
        "from pathlib import Path\n"
        "from types import SimpleNamespace\n"
        "from merl.loggers import TensorBoard\n"
        "run, progress = SimpleNamespace(path=Path(sys.argv[1])), SimpleNamespace(step=0)\n"
        "logger = TensorBoard()\n"
        "logger.on_start(SimpleNamespace(run=run, progress=progress))\n"
        "logger.on_episode(1, {'a': 1.0})\n"
        "logger.on_end(None)\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "default", "-c", program, tmp_path],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert tensorboard(tmp_path) == {"a": [(1, 1.0)]}


def test_ctrl_c_ends_a_run_that_wandb_logs(tmp_path: Path) -> None:
    """A terminal sends the signal to W&B's process as well."""
    pytest.importorskip("wandb")
    run = tmp_path / "run"
    line = f"train {TASK} --preset smoke --steps 2000000 --random-steps 20 --threads 1"
    flags = ["--eval.every", "0", "--run-dir", str(run), "--log", "wandb"]
    process = subprocess.Popen(
        [sys.executable, "-m", "merl.cli", *line.split(), *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        wait_for(lambda: (run / "metrics.csv").exists() and len(logged(run)) > 1, process)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert "and saved: resume with" in out
    expected = [step for step, _ in logged(run)["train/return"]]
    assert [step for step, _ in wandb(run)["train/return"]] == expected
