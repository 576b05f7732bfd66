"""Run planned runs: each in a process of its own, resumed after a crash, evaluated at its end.

A finished run has `evaluation.json` in its folder. What is missing is found from the folders alone,
so the same call continues a sweep that was stopped.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from merl.config import flat
from merl.core import (
    CONFIG_FILE,
    EVALUATION_FILE,
    HARMLESS,
    LOCK_FILE,
    METRICS_FILE,
    MerlError,
)
from merl.core.files import read_json, reporting
from merl.core.signals import Interrupt
from merl.core.watching import end_with_parent
from merl.experiments.cloning_first import starts_cloned
from merl.experiments.experiment import PlannedRun
from merl.runs.resume import left_open
from merl.runs.run import Run

TRACEBACK, ENVIRONMENT_FAILED = 1, 4
"""Exit codes after which a run is tried again, as after a crash. Others are the user's to fix."""
POLL = 0.2
"""Seconds between looks at a process."""
LOCK_PATIENCE = 120.0
"""Seconds in which a former process of a run may end; then the run is refused."""


@dataclass(frozen=True)
class Settings:
    """How each run of a sweep is run.

    Attributes:
        threads: threads of an update; None lets the run choose.
        episodes: evaluation episodes at the end of a run.
        retries: how often a run that crashed is resumed.
    """

    threads: int | None = None
    episodes: int = 50
    retries: int = 2


@dataclass(frozen=True)
class Outcome:
    """How a run of a sweep ended.

    Attributes:
        name: the run's name.
        error: why it failed, in one line; None if it is done, or stopped.
        seconds: how long it took, this time.
    """

    name: str
    error: str | None
    seconds: float


def is_done(run: PlannedRun, episodes: int) -> bool:
    """Return whether a run is trained to its end and evaluated.

    Args:
        run: the run.
        episodes: minimum number of episodes of the evaluation.

    Raises:
        MerlError: the folder holds a run with another config.
    """
    if not (run.folder / CONFIG_FILE).exists():
        return False
    found = Run.open(run.folder)
    recorded, wanted = flat(found.config), flat(starts_cloned(run.config, found))
    open_fields = left_open(run.config)
    for name, value in wanted.items():
        same = _equal(recorded.get(name), value) or name in (*HARMLESS, *open_fields, "run_dir")
        if not same and name in recorded:
            raise MerlError(
                f"{run.folder} holds a run of another experiment ({name} {recorded[name]}, not "
                f"{value}): name another folder with --out"
            )
    evaluated = evaluation_of(run.folder)
    if evaluated is None or len(evaluated["episodes"]) < episodes:
        return False
    return run.config.minutes is not None or evaluated["step"] >= run.config.steps


def _equal(recorded: Any, wanted: Any) -> bool:
    """Return whether two values are equal; a sweep's file has paths as text."""
    return bool(recorded == (Path(wanted) if isinstance(recorded, Path) and wanted else wanted))


def evaluation_of(folder: Path) -> dict[str, Any] | None:
    """Return the evaluation at the end of a run; None if there is none or it cannot be read."""
    try:
        evaluated: dict[str, Any] = read_json(folder / EVALUATION_FILE)
        return evaluated if isinstance(evaluated["step"], int) and evaluated["episodes"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def steps_of(folder: Path) -> int:
    """Return the steps that a run has logged."""
    try:
        with (folder / METRICS_FILE).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 100_000))
            last = file.read().rpartition(b"\n")[0].rpartition(b"\n")[2]
        return int(last.partition(b",")[0])
    except (OSError, ValueError):
        return 0


def commands(run: PlannedRun, settings: Settings) -> tuple[list[str], list[str]]:
    """Return the arguments of `merl` that train or resume a run, and that evaluate it."""
    train = ["train", *run.arguments, "--resume"]
    if settings.threads is not None:
        train += ["--threads", str(settings.threads)]
    folder = str(run.folder)
    evaluation = str(run.folder / EVALUATION_FILE)
    # The user has started the sweep here: its own environments and agents may be imported.
    own = ["--trust"] if ":" in run.config.task or ":" in run.config.agent_name else []
    episodes = str(settings.episodes)
    return train, ["evaluate", folder, "--episodes", episodes, "--json", evaluation, *own]


def execute(
    run: PlannedRun,
    settings: Settings,
    stopped: Callable[[], bool] = lambda: False,
    folder: Path | None = None,
) -> Outcome:
    """Train or resume a run to its end and evaluate it; its output goes to NAME.log.

    Args:
        run: the run.
        settings: how it is run.
        stopped: whether to stop; then the run saves and ends.
        folder: the working folder; None for this process's.
    """
    begin = time.monotonic()
    try:
        error = _executed(run, settings, stopped, folder)
    except OSError as failed:  # the log or the process cannot be made
        error = f"it cannot be started: {failed}"
    return Outcome(run.name, error, time.monotonic() - begin)


def _executed(
    run: PlannedRun, settings: Settings, stopped: Callable[[], bool], folder: Path | None
) -> str | None:
    """Return why a run failed, in one line; None if it is done, or stopped; see `execute`."""
    run.folder.parent.mkdir(parents=True, exist_ok=True)
    log = run.folder.with_name(f"{run.name}.log")
    for command in commands(run, settings):
        for attempt in range(settings.retries + 1):
            _wait_for_lock(run.folder, stopped)
            begin = log.stat().st_size if log.exists() else 0
            code = _call([sys.executable, "-m", "merl.cli", *command], log, stopped, folder)
            if stopped():
                return None
            if code == 0:
                break
            crashed = code < 0 or code in (TRACEBACK, ENVIRONMENT_FAILED) or code > 128
            if not crashed or attempt == settings.retries:
                return f"{_reason(code, log, begin)} (log: {log})"
    return None


def _wait_for_lock(folder: Path, stopped: Callable[[], bool]) -> None:
    """Wait while a former process of this run, e.g. one on a node that was lost, still saves."""
    end = time.monotonic() + LOCK_PATIENCE
    while time.monotonic() < end and not stopped():
        try:
            with (folder / LOCK_FILE).open("a") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
        except BlockingIOError:
            time.sleep(POLL)
        except OSError:  # there is no such run yet
            return


def _call(
    command: Sequence[str], log: Path, stopped: Callable[[], bool], folder: Path | None
) -> int:
    """Run a process, end it if `stopped`, and return its exit code."""
    with log.open("ab") as output:
        # In a session of its own, so that Ctrl-C reaches it once, from here.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            cwd=folder,
            start_new_session=True,
            preexec_fn=lambda: end_with_parent(signal.SIGTERM),  # it saves
        )
    asked = False
    try:
        while process.poll() is None:
            if stopped() and not asked:
                process.terminate()
                asked = True
            time.sleep(POLL)
    finally:  # an exception here, e.g. a cancelled task: let the run save
        if process.poll() is None:
            process.terminate()
            process.wait()
    return process.returncode


def _reason(code: int, log: Path, begin: int) -> str:
    """Return the last error in a log from byte `begin` on, or the exit code, in one line."""
    text = log.read_bytes()[begin:][-20_000:].decode(errors="replace")
    found = [line for line in text.splitlines() if line.startswith("merl: error: ")]
    if code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return found[-1].removeprefix("merl: error: ") if found else f"exit code {code}"


def run_here(
    runs: Sequence[PlannedRun],
    settings: Settings,
    jobs: int,
    started: Callable[[PlannedRun], None],
    ended: Callable[[Outcome], None],
    tick: Callable[[Sequence[PlannedRun]], None],
) -> int | None:
    """Run the runs in processes on this machine, in their order, some at a time.

    Args:
        runs: the runs.
        settings: how they are run.
        jobs: how many run at a time.
        started: called when a run starts, in another thread.
        ended: called when a run has ended, in another thread, one call at a time.
        tick: called about every second with the runs that run now.

    Returns:
        The signal that stopped the sweep, after all runs have saved; None if none did.
    """
    waiting, active = list(runs), dict[str, PlannedRun]()
    lock, stop = threading.Lock(), threading.Event()

    def work() -> None:
        while not stop.is_set():
            with lock:
                if not waiting:
                    return
                run = waiting.pop(0)
                active[run.name] = run
            started(run)
            outcome = execute(run, settings, stop.is_set)
            with lock:
                del active[run.name]
                if not stop.is_set():
                    ended(outcome)

    threads = [threading.Thread(target=work) for _ in range(min(jobs, len(runs)))]
    with Interrupt().listening() as interrupt:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            for thread in threads:
                thread.join(1.0 / len(threads))
            if interrupt.number is not None:
                stop.set()
            with lock:
                now = [*active.values()]
            tick(now)
        return interrupt.number


def check_folder(folder: Path) -> None:
    """Make the folder of a sweep.

    Raises:
        MerlError: it cannot be made.
    """
    with reporting(f"--out {folder} cannot be created"):
        folder.mkdir(parents=True, exist_ok=True)
