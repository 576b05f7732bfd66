"""A disk that is really full: a small one, mounted where nobody else sees it."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

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


def test_a_full_disk_ends_nothing(tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this system lets nobody mount a disk of their own")
    alone = subprocess.run(
        [*ALONE, sys.executable, __file__, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    assert alone.returncode == 0, alone.stdout + alone.stderr


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


def check_alone(folder: Path) -> None:
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder)], check=True)
    run = folder / "run"
    often = ["--eval.every", "60", "--eval.video", "each"]
    process = start(line(run, *often, "--steps", "1000000", "--replay.capacity", "1000"))
    assert process.stdout is not None
    wait_for(lambda: len(saved(run)) > 1, process)
    filler = fill(folder)
    full = saved(run)[-1]
    told = []
    for said in process.stdout:
        told.append(said)
        if "was not written" in said:
            break
    time.sleep(3)  # it goes on, and what it has to say it keeps
    assert process.poll() is None, told
    filler.unlink()
    wait_for(lambda: saved(run)[-1] > full, process)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, err
    assert "Traceback" not in err

    last = Checkpoint.find(run / "checkpoints").step
    assert last > full
    assert main(["resume", str(run), "--steps", str(last + 2 * EPISODE)]) == 0
    steps = read_metrics(run)["step"]
    assert (np.diff(steps) < 2 * EPISODE).all(), "a row is missing"  # one episode was cut off
    assert steps[0] == EPISODE
    print("".join(told), out)


def wait_for(happens: object, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 60
    assert callable(happens)
    while not happens():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "nothing happens"
        time.sleep(0.01)


if __name__ == "__main__":
    check_alone(Path(sys.argv[1]))
