"""merl report and merl compare."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import flat, wait_for
from merl.cli import main
from runs_on_disk import write_run


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    for seed in (0, 1):
        write_run(folder / f"reach_duplo-merl-s{seed}", [9, 150], [0, 0.5], seed=seed)
    write_run(folder / "reach_duplo-fast-s0", [20, 60], [0, 0.2], tau=0.1)
    return folder


def test_a_report_of_a_folder_of_runs(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = runs.parent / "out"
    assert main(["report", str(runs), "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert f"{out}/index.html: 3 runs, 2 curves" in shown
    assert "fast has one seed" in shown
    assert (out / "index.html").read_text().count("<svg") == 5
    assert main(["report", str(runs / "reach_duplo-merl-s0"), "--out", str(out)]) == 0


def test_watch_follows_runs_that_are_training(tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    write_run(folder / "reach_duplo-merl-s0", [], [])
    out = tmp_path / "out"
    command = [sys.executable, "-m", "merl.cli", "report", str(folder), "--out", str(out)]
    command += ["--watch", "1", "--baseline", "slow"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    assert "has no evaluation yet" in process.stdout.readline()
    write_run(folder / "reach_duplo-merl-s1", [9], [0], seed=1)
    page = out / "index.html"
    wait_for(lambda: page.exists() and "is none of the curves" in page.read_text(), process)
    assert '<meta http-equiv="refresh" content="1">' in page.read_text()
    write_run(folder / "reach_duplo-slow-s0", [5], [0], tau=0.1)
    wait_for(lambda: "slow against the others" in page.read_text(), process)
    assert "is none of the curves" not in page.read_text()
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT
    assert "Traceback" not in rest


def test_compare_prints_what_differs(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [str(runs / name) for name in ("reach_duplo-merl-s1", "reach_duplo-fast-s0")]
    assert main(["compare", *names]) == 0
    shown = [flat(line) for line in capsys.readouterr().out.splitlines()]
    assert "seed 1 0" in shown
    assert "agent.tau 0.01 0.1" in shown
    assert "final return 150 60" in shown
    assert "final success 50% 20%" in shown
    assert not any(line.startswith("preset") for line in shown)
    assert main(["compare", names[0], names[0]]) == 0
    assert "config, versions and machine are the same" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["report"], "missing from merl report: RUN..."),
        (["report", "nowhere"], "nowhere does not exist"),
        (["report", "runs", "--out", "file/x"], "file/x cannot be created"),
        (["report", "runs", "--watch", "0"], "--watch must be at least 1"),
        (["compare", "runs/reach_duplo-merl-s0", "runs"], "runs"),
        (["compare", "runs/reach_duplo-merl-s0"], "missing from merl compare"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    command: list[str],
    message: str,
    runs: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(runs.parent)
    (runs.parent / "file").touch()
    assert main(command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
