"""Failed writes to the output never end a run: it continues and is saved."""

from __future__ import annotations

import errno
import io
import logging
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import pytest

from merl.cli import main
from merl.core.output import TolerantStream
from merl.report.curves import read_metrics
from runs_on_disk import write_run

LINE = "train Pendulum-v1 --agent ddpg --preset smoke --steps 400 --random-steps 10 "
LINE += "--seed-steps 390 --replay.batch-size 8 --agent.hidden-dim 8 --eval.episodes 1 --threads 1 "
LINE += "--eval.every 200 --eval.video none --eval.no-references --run-dir run"


def pipe_without_reader() -> TextIO:
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


def full_disk() -> TextIO:
    return open("/dev/full", "w")  # noqa: PTH123


def closed() -> TextIO:
    stream = open(os.devnull, "w")  # noqa: PTH123, SIM115
    stream.close()
    return stream


class Terminal(io.StringIO):
    """A terminal that is closed after a few writes, while the live view draws in another thread."""

    writes = 0

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.writes += 1
        if self.writes > 10:
            raise OSError(errno.EIO, "Input/output error")
        return super().write(text)


BROKEN = [pipe_without_reader, full_disk, closed, Terminal, lambda: None]


@pytest.mark.parametrize("name", ["stdout", "stderr"])
@pytest.mark.parametrize("broken", BROKEN)
def test_a_run_completes_with_a_broken_stream(
    broken: Callable[[], TextIO | None], name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    stream = broken()
    monkeypatch.setattr(sys, name, stream)
    monkeypatch.setattr("merl.training.trainer.Trainer._is_to_stop", _warns)
    assert main(LINE.split()) == 0
    assert getattr(sys, name) is stream or stream is None
    assert (tmp_path / "run" / "checkpoints" / "00000400").is_dir()
    assert read_metrics(tmp_path / "run")["step"].tolist() == [200, 400]


def _warns(*_: object) -> None:
    """Print and warn, as libraries do at any time."""
    warnings.warn("something", stacklevel=1)
    logging.getLogger("merl").warning("something")
    print("something", file=sys.stderr)
    print("something", flush=True)


@pytest.mark.parametrize(
    ("broken", "code"), [(pipe_without_reader, 141), (full_disk, 2), (closed, 2), (lambda: None, 0)]
)
@pytest.mark.parametrize("command", [["--version"], ["train", "--help"], ["bench", "--help"]])
def test_a_command_that_only_prints_reports_a_failed_write_by_its_exit_code(
    broken: Callable[[], TextIO | None],
    code: int,
    command: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "stdout", broken())
    try:
        ended = main(command)
    except SystemExit as stop:  # after --help
        ended = int(stop.code or 0)
    assert ended == code
    error = capsys.readouterr().err
    assert error.count("\n") == (code == 2)
    assert "Traceback" not in error


@pytest.mark.parametrize(("broken", "code"), [(pipe_without_reader, 141), (full_disk, 2)])
def test_a_command_that_writes_files_succeeds_with_a_broken_stream(
    broken: Callable[[], TextIO], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = str(write_run(tmp_path / "run", [1.0], [0.0]))
    monkeypatch.setattr(sys, "stdout", broken())
    assert main(["report", run, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/index.html").exists()
    monkeypatch.setattr(sys, "stdout", broken())
    assert main(["compare", run, run]) == code


def test_bad_input_has_its_exit_code_with_broken_streams(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for broken in BROKEN:
        monkeypatch.setattr(sys, "stdout", broken())
        monkeypatch.setattr(sys, "stderr", broken())
        assert main(["resume", "nowhere"]) == 2


def test_characters_outside_the_encoding_are_escaped() -> None:
    raw = io.BytesIO()
    stream = TolerantStream(io.TextIOWrapper(raw, encoding="ascii"))
    print("größer \udcff", file=stream, flush=True)  # type: ignore[arg-type]
    assert raw.getvalue() == rb"gr\xf6\xdfer \udcff" + b"\n"
    assert stream.error is None


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (f"{LINE} >&- 2>&-", 0),
        ("--version > /dev/full", 2),
        ("--version | true", 141),
        ("--nothing 2> /dev/full", 2),
    ],
)
def test_a_shell_gets_only_the_exit_code(tmp_path: Path, line: str, code: int) -> None:
    """Run until the process has ended: Python flushes once more at exit."""
    head = "exec 2>&1; set -o pipefail; "
    command = f"{head}{sys.executable} -m merl.cli {line}"
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stdout
    assert "Exception ignored" not in done.stdout
    assert "Traceback" not in done.stdout
    if line.startswith("train"):  # no file was opened on a closed standard descriptor
        assert (tmp_path / "run" / "lock").read_text().isdigit()
        assert (tmp_path / "run" / "checkpoints" / "00000400").is_dir()
        assert (tmp_path / "run" / "metrics.csv").read_text().startswith("step,")
