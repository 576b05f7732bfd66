"""Files of a replay that were removed, or copied with holes; a journal that cannot be written."""

from __future__ import annotations

import copy
import errno
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from test_replay import Account, Run, check, make

from faults import Faults, with_faults
from merl.core import MerlError
from merl.core.resources import reserve_holes


def restore(run: Run, state: dict[str, Any], account: Account) -> None:
    """Restore a state exactly, for which the journal needs what was overwritten."""
    run.restore(state, len(account.timesteps))
    run.account = account


@pytest.mark.parametrize("compress", [False, True])
def test_a_removed_replay_is_written_again(
    tmp_path: Path, compress: bool, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(tmp_path / "replay", compress=compress)
    run.play(5, 4, 6, 8)
    shutil.rmtree(run.directory)
    run.replay.flush()
    assert caplog.text.count("was removed: it is written again") == 1
    state = run.replay.state_dict() | run.replay.checksums()
    run.replay.confirm_checkpoint()
    check(run.replay, run.account)
    account, episode = copy.deepcopy(run.account), run.episode
    run.play(3, 7)
    restore(run, state, account)
    run.episode = episode
    run.play(6)
    check(run.replay, run.account)


def test_a_replay_copied_with_holes_gets_its_space_back(tmp_path: Path) -> None:
    def blocks(folder: Path) -> int:
        return sum(file.stat().st_blocks for file in folder.rglob("*.bin"))

    make(tmp_path / "whole", capacity=5000)
    target = tmp_path / "copy" / "5002"
    target.mkdir(parents=True)
    (folder,) = (path for path in (tmp_path / "whole").iterdir() if path.is_dir())
    target = target.rename(target.with_name(folder.name))
    for file in folder.iterdir():
        if file.suffix == ".bin":
            with (target / file.name).open("wb") as holes:
                holes.truncate(file.stat().st_size)
        else:
            shutil.copy(file, target)
    assert blocks(target) < blocks(folder)
    make(target.parent, capacity=5000)
    assert blocks(target) >= blocks(folder)


def test_filling_holes_keeps_the_content(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with path.open("wb") as file:
        file.write(b"data")
        file.truncate(1 << 20)
    with path.open("r+b") as file:
        reserve_holes(file.fileno())
    assert path.read_bytes() == b"data" + bytes((1 << 20) - 4)
    assert path.stat().st_blocks * 512 >= 1 << 20


@pytest.mark.parametrize("code", [errno.EIO, errno.EACCES, errno.EROFS])
def test_a_replay_that_cannot_be_opened_is_one_line(tmp_path: Path, code: int) -> None:
    Run(tmp_path / "replay").play(3)

    def reopen() -> int:
        try:
            make(tmp_path / "replay")
        except MerlError as error:
            print(error)
            return error.exit_code
        return 0

    ended = with_faults(reopen, Faults(tmp_path))
    assert ended.code == 0
    for at in range(1, len(ended.names) + 1, 3):
        ended = with_faults(reopen, Faults(tmp_path, at, code, lasts=True))
        assert ended.code in (0, 2), ended.err
        assert ended.out.count("\n") == (ended.code != 0)
        assert not ended.code or str(tmp_path) in ended.out


@pytest.mark.parametrize("fails", ["rename", "open"])
def test_a_journal_that_cannot_be_begun_anew_goes_on(
    tmp_path: Path, fails: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the last two checkpoints need is still there: both are restored exactly."""
    run = Run(tmp_path / "replay")
    run.play(9, 9)
    states = []
    what = "pathlib.Path.replace" if fails == "rename" else "merl.replay.journal._opened"
    for broken in (False, True, False):
        with monkeypatch.context() as patch:
            if broken:
                patch.setattr(what, _refuse)
            states.append((run.replay.state_dict(), copy.deepcopy(run.account)))
            run.replay.flush()
            run.replay.confirm_checkpoint()
        run.play(4, 3)
    for state, account in states[:0:-1]:
        restore(run, state, account)
        check(run.replay, run.account)


def test_a_journal_that_can_not_even_be_emptied_loses_only_the_oldest_steps(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(tmp_path / "replay")
    run.play(9, 9)
    run.replay.flush()
    state = run.replay.state_dict() | run.replay.checksums()
    timesteps = len(run.account.timesteps)
    run.replay.confirm_checkpoint()
    run.play(2)
    journal = run.replay._journal
    assert journal is not None

    class ReadOnly:
        def __init__(self, file: object) -> None:
            self.seek = file.seek  # type: ignore[attr-defined]

        write = truncate = lambda *_: _refuse()

    journal._file = ReadOnly(journal._file)  # type: ignore[assignment]
    run.play(5)
    assert "Read-only file system; until the next checkpoint" in caplog.text
    run.restore(state, timesteps)
    assert "has overwritten" in caplog.text
    assert 0 < len(run.replay) < 18
    check(run.replay, run.account)


def _refuse(*_: object) -> None:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))
