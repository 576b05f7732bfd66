"""Disks that are full, or not to be written to: small ones, mounted where nobody else sees them."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from helpers import wait_for
from merl.cli import main
from merl.report.curves import read_metrics
from merl.training.checkpoint import Checkpoint
from test_recovery import EPISODE, line, saved, start

SIZE = 24 * 2**20
"""Of the disk, in bytes: a few checkpoints of the dot, its replay and its videos."""
ALONE = ["unshare", "--map-root-user", "--mount"]


def can_mount(folder: Path) -> bool:
    mount = [*ALONE, "mount", "-t", "tmpfs", "tmpfs", str(folder)]
    try:
        return subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("which", ["full", "read_only"])
def test_a_disk(which: str, tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this system lets nobody mount a disk of their own")
    alone = subprocess.run(
        [*ALONE, sys.executable, __file__, which, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert alone.returncode == 0, alone.stdout + alone.stderr


def read_only(folder: Path) -> None:
    """Refused before anything is timed or built, and by name; what is there can be evaluated."""
    mount(folder)
    assert main(line(folder / "run", "--steps", "100")) == 0
    mount(folder, "remount,ro")
    for arguments in (line(folder / "other"), ["resume", str(folder / "run"), "--steps", "200"]):
        process = start(arguments)
        _, err = process.communicate()
        assert process.returncode == 2, err
        assert err.count("\n") == 1
        assert "Read-only file system" in err
        assert str(folder) in err
    assert main(["evaluate", str(folder / "run"), "--episodes", "1"]) == 0


def fill(folder: Path) -> Path:
    """Leave no byte."""
    filler = folder / "filler"
    with filler.open("ab", buffering=0) as file:
        for size in (2**20, 4096, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
    return filler


def mount(folder: Path, options: str = f"size={SIZE}") -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def full(folder: Path) -> None:
    """The run goes on, says what was not written, and has lost nothing once there is room."""
    mount(folder)
    run = folder / "run"
    often = ["--eval.every", "60", "--eval.video", "each"]
    process = start(line(run, *often, "--steps", "1000000", "--replay.capacity", "1000"))
    assert process.stdout is not None
    wait_for(lambda: len(saved(run)) > 1, process)
    filler = fill(folder)
    before = saved(run)[-1]
    told = []
    for said in process.stdout:
        told.append(said)
        if "was not written" in said:
            break
    times = psutil.Process(process.pid).cpu_times
    worked = times().user  # it goes on, and keeps what it has to say
    wait_for(lambda: times().user > worked + 1.0, process)
    filler.unlink()
    wait_for(lambda: saved(run)[-1] > before, process)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate()
    assert process.returncode == 128 + signal.SIGTERM, err
    assert "Traceback" not in err

    last = Checkpoint.find(run / "checkpoints").step
    assert last > before
    assert main(["resume", str(run), "--steps", str(last + 2 * EPISODE)]) == 0
    steps = read_metrics(run)["step"]
    assert (np.diff(steps) < 2 * EPISODE).all(), "a row is missing"  # one episode was cut off
    assert steps[0] == EPISODE
    print("".join(told), out)


if __name__ == "__main__":
    {"full": full, "read_only": read_only}[sys.argv[1]](Path(sys.argv[2]))
