"""Check a whole run folder for damage, without changing anything."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from merl.core import LOCK_FILE, METRICS_FILE, MerlError, counted
from merl.core.files import cause, is_damage, is_gone, open_file, reporting
from merl.replay import ReplaySpec
from merl.replay.damage import find_damage
from merl.runs.checkpoint import Checkpoint, Unreadable, readable
from merl.runs.checkpoint_folders import folders
from merl.runs.metrics import read_rows
from merl.runs.run import Run


class Finding(NamedTuple):
    """One line of a check."""

    sound: bool
    text: str


def check_run(run: Run) -> Iterator[Finding]:
    """Yield what is sound and what is damaged in a run whose `config.json` has been read.

    Raises:
        MerlError: a process trains in the folder, so that its files change, or the disk does not
            let a file be read.
    """
    with _not_in_use(run.path):
        yield Finding(True, f"{run.path}/config.json is sound")
        last = None
        with reporting(f"checkpoints {run.checkpoints} cannot be read"):
            found = folders(run.checkpoints).values()
        for path in found:
            try:
                last = Checkpoint.open(path)
                yield Finding(True, f"{path} is sound")
            except MerlError as error:
                yield damage_of(error)
        yield _check_metrics(run.path / METRICS_FILE, last)
        if last is not None:
            yield from _check_replay(run, last)


def _check_metrics(file: Path, start: Checkpoint | None) -> Finding:
    """Return whether the metrics can be read; they begin before the first checkpoint."""
    try:
        rows = read_rows(file)[1]
    except MerlError as error:
        return damage_of(error)
    if start is not None and not rows and is_gone(file):
        return Finding(False, f"{file} is gone: the metrics so far are lost, and nothing else")
    return Finding(True, f"{file} can be read: {counted(len(rows), 'row')}")


def _check_replay(run: Run, start: Checkpoint) -> Iterator[Finding]:
    """Compare the replay with its checksums in a checkpoint."""
    if not run.replay.is_dir():
        yield Finding(False, f"{run.replay} is gone: the run can be evaluated, not resumed")
        return
    try:
        config = run.config
        spec = ReplaySpec.of(
            config.replay, *run.spaces(), capacity=config.capacity, rings=config.num_envs
        )
        with readable(start):
            state = start.state()["replay"]
            damage = find_damage(run.replay, spec, state)
    except MerlError as error:
        yield damage_of(error)
        return
    yield from (Finding(False, str(each)) for each in damage)
    if not damage:
        known = "is sound" if "covered" in state else "can be read; it has no checksums"
        held = (min(int(ring["steps"]), spec.ring_capacity) for ring in state["rings"])
        steps = counted(sum(held), "step")
        yield Finding(True, f"{run.replay} {known}: {steps} of checkpoint {start.path.name}")


def damage_of(error: MerlError) -> Finding:
    """Return what an error says if it is damage; else raise it: the disk may work again."""
    of_disk = error.__cause__
    if isinstance(error, Unreadable) or (isinstance(of_disk, OSError) and not is_damage(of_disk)):
        raise error
    return Finding(False, str(error))


@contextmanager
def _not_in_use(run: Path) -> Iterator[None]:
    """Hold the lock of a run, if it has one, without writing into it."""
    path = run / LOCK_FILE
    with ExitStack() as stack:
        try:
            file = stack.enter_context(open_file(path))
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except FileNotFoundError:
            pass
        except BlockingIOError:
            raise MerlError(f"a process is training in {run}: stop it first") from None
        except OSError as error:
            raise MerlError(f"{path} cannot be locked: {cause(error)}") from error
        yield
