import csv
import errno
import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import merl
from merl.core import MerlError
from merl.report.curves import read_metrics
from merl.runs import metrics
from merl.runs.metrics import MetricsFile


def rows(run):
    with (run / "metrics.csv").open(newline="") as file:
        return [*csv.reader(file)]


def test_each_step_has_a_row(tmp_path):
    with MetricsFile(tmp_path / "run") as writer:
        writer.write(250, {"train/return": 1.5})
        writer.write(500, {"train/return": np.float32(0.25)})
    assert rows(tmp_path / "run") == [["step", "train/return"], ["250", "1.5"], ["500", "0.25"]]


def test_values_are_read_back_exactly(tmp_path):
    value = 0.1 + 0.2
    with MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": value, "b": float("nan"), "c": 1e-300})
    back = read_metrics(tmp_path)
    assert back["a"][0] == value
    assert np.isnan(back["b"][0])
    assert back["c"][0] == 1e-300


def test_a_column_may_be_added_later(tmp_path):
    with MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": 1.0})
        writer.write(2, {"b, c": 2.0})
        writer.write(3, {"a": 3.0})
    assert rows(tmp_path) == [
        ["step", "a", "b, c"],
        ["1", "1.0", ""],
        ["2", "", "2.0"],
        ["3", "3.0", ""],
    ]


def test_writes_of_one_step_share_a_row(tmp_path):
    with MetricsFile(tmp_path) as writer:
        writer.write(0, {"a": 1.0, "b": 1.0})
        writer.write(1, {"a": 1.23456789, "b": 1.23456789})
        writer.write(
            1, {"a": 2.0, "b": 2.0}
        )  # shorter than the line before, which must be removed completely
        assert rows(tmp_path)[1:] == [["0", "1.0", "1.0"], ["1", "2.0", "2.0"]]
        writer.write(1, {"c": 3.0})
        writer.write(2, {"a": 4.0})
        writer.write(2, {"b": 5.0})
    assert rows(tmp_path) == [
        ["step", "a", "b", "c"],
        ["0", "1.0", "1.0", ""],
        ["1", "2.0", "2.0", "3.0"],
        ["2", "4.0", "5.0", ""],
    ]


def test_a_row_is_in_the_file_when_write_returns(tmp_path):
    with MetricsFile(tmp_path) as writer:
        for step in range(3):
            writer.write(step, {"a": 0.5})
            assert rows(tmp_path)[-1] == [str(step), "0.5"]
            assert (tmp_path / "metrics.csv").read_bytes().endswith(b"\n")


def test_write_refuses_earlier_steps_and_invalid_names(tmp_path):
    with MetricsFile(tmp_path) as writer:
        writer.write(10, {"a": 1.0})
        with pytest.raises(ValueError, match=r"trim\(9\)"):
            writer.write(9, {"a": 1.0})
        for name in ("", "step", "two\nlines"):
            with pytest.raises(ValueError, match="named"):
                writer.write(11, {name: 1.0})
    assert rows(tmp_path) == [["step", "a"], ["10", "1.0"]]
    with pytest.raises(ValueError, match="closed"):
        writer.write(12, {"a": 1.0})


def test_an_existing_file_is_continued(tmp_path):
    with MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": 1.0})
    with MetricsFile(tmp_path) as writer:
        assert writer.last_step == 1
        writer.write(1, {"b": 2.0})
        writer.write(2, {"b": 3.0})
    assert rows(tmp_path) == [["step", "a", "b"], ["1", "1.0", "2.0"], ["2", "", "3.0"]]


@pytest.mark.parametrize("torn", ["3", "3,1.0", "\0\0\0\0"])
def test_an_incomplete_last_line_is_removed(tmp_path, torn):
    (tmp_path / "metrics.csv").write_text("step,a\n1,1.0\n2,2.0\n" + torn)
    with MetricsFile(tmp_path) as writer:
        writer.write(3, {"a": 3.5})
    assert rows(tmp_path)[1:] == [["1", "1.0"], ["2", "2.0"], ["3", "3.5"]]


def test_all_rows_are_kept_after_a_kill(tmp_path):
    code = (
        "import os, signal, sys\n"
        "from merl.runs.metrics import MetricsFile\n"
        "writer = MetricsFile(sys.argv[1])\n"
        "for step in range(5): writer.write(step, {'a': step})\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path], check=False)
    assert [row[0] for row in rows(tmp_path)[1:]] == ["0", "1", "2", "3", "4"]


def test_trim_removes_later_steps(tmp_path):
    with MetricsFile(tmp_path) as writer:
        for step in (100, 200, 201, 300):
            writer.write(step, {"a": step})
    with MetricsFile(tmp_path) as writer:
        writer.trim(200)
        assert [row[0] for row in rows(tmp_path)] == ["step", "100", "200"]
        assert writer.last_step == 200
        for step in (250, 300):
            writer.write(step, {"a": -step})
    expected = [(100, 100), (200, 200), (250, -250), (300, -300)]
    back = read_metrics(tmp_path)
    assert [*zip(back["step"], back["a"], strict=True)] == expected


def test_trim_to_before_the_first_row(tmp_path):
    with MetricsFile(tmp_path) as writer:
        writer.write(100, {"a": 1.0})
        writer.trim(0)
        assert writer.last_step is None
        writer.write(50, {"a": 2.0})
    assert rows(tmp_path) == [["step", "a"], ["50", "2.0"]]


@pytest.mark.parametrize("text", ["a,b\n1,2\n", "step,a\n1\n", "step,a\n2,1\n1,1\n", "step\nx\n"])
def test_an_unreadable_file_is_not_overwritten(tmp_path, text):
    path = tmp_path / "metrics.csv"
    path.write_text(text)
    with pytest.raises(MerlError, match=r"metrics\.csv"):
        MetricsFile(tmp_path)
    assert path.read_text() == text


def interrupt(*_):
    raise KeyboardInterrupt


def test_an_interrupt_between_memory_and_file_loses_no_row(tmp_path, monkeypatch):
    with MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": 1.0})
        with monkeypatch.context() as patch:
            patch.setattr(metrics, "append_whole", interrupt)
            with pytest.raises(KeyboardInterrupt):
                writer.write(2, {"a": 2.0})
        writer.write(2, {"a": 3.0})
    assert rows(tmp_path) == [["step", "a"], ["1", "1.0"], ["2", "3.0"]]


class FullDisk(io.FileIO):
    """A file that accepts a few bytes and then none, while `full`."""

    full = False

    def write(self, data):
        if not FullDisk.full:
            return super().write(data)
        if len(data) > 3:
            return super().write(bytes(data)[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def disk(monkeypatch):
    """A disk that can be made full."""
    FullDisk.full = False
    monkeypatch.setattr(metrics.io, "FileIO", FullDisk)
    real_open = Path.open

    def open_unless_full(path, mode="r", *args, **kwargs):
        if FullDisk.full and "w" in mode:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real_open(path, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", open_unless_full)
    return FullDisk


def test_a_full_disk_does_not_end_a_run(tmp_path, disk):
    warnings = []
    with MetricsFile(tmp_path, warn=warnings.append) as writer:
        writer.write(1, {"a": 1.0})
        disk.full = True
        writer.write(2, {"a": 2.0})
        assert rows(tmp_path) == [["step", "a"], ["1", "1.0"]]  # no part of the second row
        writer.write(3, {"a": 3.0, "b": 3.0})
        writer.trim(2)
        writer.write(4, {"a": 4.0})
        assert len(warnings) == 1
        assert "No space left on device" in warnings[0]
        assert "\n" not in warnings[0]
        disk.full = False
        writer.write(5, {"a": 5.0})
    assert rows(tmp_path) == [
        ["step", "a", "b"],
        ["1", "1.0", ""],
        ["2", "2.0", ""],
        ["4", "4.0", ""],
        ["5", "5.0", ""],
    ]
    assert len(warnings) == 1


def test_close_writes_the_rows_that_a_full_disk_has_refused(tmp_path, disk, caplog):
    disk.full = True
    with caplog.at_level(logging.WARNING), MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": 1.0})
        disk.full = False
    assert len(caplog.records) == 1
    assert rows(tmp_path) == [["step", "a"], ["1", "1.0"]]  # written by `close`
    assert [path.name for path in tmp_path.glob(".*")] == []


def test_unwritten_counts_the_rows_that_are_not_in_the_file(tmp_path, disk):
    with MetricsFile(tmp_path) as writer:
        writer.write(1, {"a": 1.0})
        assert writer.unwritten == 0
        disk.full = True
        for step in (1, 2, 3):
            writer.write(step, {"a": 2.0})
            assert writer.unwritten == step
        writer.trim(2)
        assert writer.unwritten == 2
        disk.full = False
        writer.write(4, {"b": 1.0})
        assert writer.unwritten == 0
        disk.full = True
        writer.write(5, {"b": 1.0})
    assert writer.unwritten == 1


def test_resume_refuses_an_unreadable_file(tmp_path):
    run = tmp_path / "run"
    small = {"preset": "smoke", "steps": 20, "threads": 1, "eval.every": 0, "replay.batch_size": 4}
    merl.train("merl.envs.dot:whole", run_dir=run, progress=False, **small)
    (run / "metrics.csv").write_text("step,a\n1\n")
    with pytest.raises(MerlError, match="is not a metrics file that can be continued"):
        merl.resume(run, steps=40, progress=False)
    assert (run / "metrics.csv").read_text() == "step,a\n1\n"
    assert [path.name for path in (run / "checkpoints").iterdir()] == ["00000020"]
