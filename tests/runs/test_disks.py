"""Full and read-only disks: small disks, mounted so that only the test process sees them."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil
import pytest
from test_recovery import EPISODE, line, saved, start

from helpers import wait_for
from merl.cli import main
from merl.report.curves import read_metrics
from merl.runs import checkpoint
from merl.runs.checkpoint import Checkpoint

SIZE = 24 * 2**20
"""Size of the disk in bytes: enough for a few checkpoints of the dot, its replay and its videos."""
UNSHARE = ["unshare", "--map-root-user", "--mount"]
OBEYS_MODES = ["setpriv", "--bounding-set", "-dac_override,-dac_read_search"]
"""Root may otherwise write to a folder whatever its mode is."""


def can_mount(folder: Path) -> bool:
    mount = [*UNSHARE, *OBEYS_MODES, "mount", "-t", "tmpfs", "tmpfs", str(folder)]
    try:
        return subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.mark.parametrize(
    "which",
    [
        "full",
        "full_to_the_end",
        "read_only",
        *(pytest.param(which, marks=pytest.mark.long) for which in ("forbidden", "shared_memory")),
    ],
)
def test_a_run_on_a_bad_disk(which: str, tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this system does not allow users to mount a disk")
    done = subprocess.run(
        [*UNSHARE, *OBEYS_MODES, sys.executable, __file__, which, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
    )
    assert done.returncode == 0, done.stdout + done.stderr


def read_only(folder: Path) -> None:
    """A read-only disk is refused at the start by name; a run on it can be evaluated."""
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
    """Fill the disk completely and return the file that fills it."""
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
    """The run continues, reports the failed save, and loses nothing once there is space."""
    mount(folder)
    fails_for_a_while(folder / "run", lambda: fill(folder), (folder / "filler").unlink)


def forbidden(folder: Path) -> None:
    """The same with folders that nothing can be written to."""

    def change(mode: int) -> None:
        for each in (folder / "run", folder / "run/replay", folder / "run/checkpoints"):
            each.chmod(mode)

    fails_for_a_while(folder / "run", lambda: change(0o500), lambda: change(0o700))


def fails_for_a_while(run: Path, spoil: Callable[[], object], mend: Callable[[], object]) -> None:
    often = ["--eval.every", "60", "--eval.video", "each"]
    process = start(line(run, *often, "--steps", "1000000", "--replay.capacity", "1000"))
    assert process.stdout is not None
    wait_for(lambda: len(saved(run)) > 1, process)
    spoil()
    before = saved(run)[-1]
    printed = []
    for output_line in process.stdout:
        printed.append(output_line)
        if "was not written" in output_line:
            break
    times = psutil.Process(process.pid).cpu_times
    worked = times().user  # the run continues and keeps its metrics in memory
    wait_for(lambda: times().user > worked + 1.0, process)
    mend()
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
    print("".join(printed), out)


def shared_memory(folder: Path) -> None:
    """Worker processes need shared memory: without it, one line, and no folder."""
    for size, options in (("1m", "remount,ro"), ("4k", "remount,nr_inodes=1")):
        mount(Path("/dev/shm"), f"size={size}")
        mount(Path("/dev/shm"), options)
        process = start(line(folder / "run", "--num-envs", "2", "--no-synchronous"))
        _, err = process.communicate()
        assert process.returncode == 2, err
        assert err.count("\n") == 1
        assert "/dev/shm" in err
        assert not (folder / "run").exists()


def full_to_the_end(folder: Path) -> None:
    """The end is not saved, so the exit code is 5; the run resumes once there is space."""
    mount(folder)
    run, output, steps = folder / "run", io.StringIO(), 240
    write = checkpoint.save

    def save_and_fill(*args: Any, **kwargs: Any) -> Any:
        saved = write(*args, **kwargs)
        if saved.step == 4 * EPISODE:
            fill(folder)
        return saved

    often = [
        "--eval.video",
        "each",
        "--steps",
        str(steps),
        "--replay.capacity",
        "70",
    ]  # small, so that old steps are overwritten
    with (
        mock.patch.object(checkpoint, "save", save_and_fill),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
    ):
        code = main(line(run, *often))
    printed = output.getvalue()
    assert code == 5, printed
    last = printed.splitlines()[-1]
    # The last page of metrics.csv may have space for some rows.
    lost = rf"ended at step {steps}, but its checkpoint( and \d+ rows of its metrics)? could not"
    assert re.search(lost, last), printed
    assert last.endswith(f"`merl resume {run}` continues from step {4 * EPISODE}")
    assert "Traceback" not in printed
    assert saved(run) == [3 * EPISODE, 4 * EPISODE]

    (folder / "filler").unlink()
    assert main(["resume", str(run)]) == 0
    assert saved(run)[-1] == steps
    assert (np.diff(read_metrics(run)["step"]) == EPISODE).all(), "a row is missing"
    assert full_from_the_start(folder) == 2


def full_from_the_start(folder: Path) -> int:
    """If no checkpoint can be written, no run starts and its folder is removed."""
    error = OSError(errno.ENOSPC, "No space left on device")
    with mock.patch.object(checkpoint, "save", side_effect=error):
        code = main(line(folder / "none"))
    assert not (folder / "none").exists()
    return code


if __name__ == "__main__":
    kinds = (full, full_to_the_end, forbidden, read_only, shared_memory)
    {kind.__name__: kind for kind in kinds}[sys.argv[1]](Path(sys.argv[2]))
