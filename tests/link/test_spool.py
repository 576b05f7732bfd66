"""An actor's spool: what is in it survives, and what cannot fit is refused in one line."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from faults import Faults, with_faults
from merl.acting.rollout import Episode
from merl.core import MerlError, Transition
from merl.link.spool import Spool
from merl.link.timesteps import Layout, Timestep

SPACE = spaces.Dict(
    {
        "a/b": spaces.Box(0, 255, (2, 3, 3), np.uint8),
        "joint": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    }
)
LAYOUT = Layout(SPACE, spaces.Box(-1.0, 1.0, (4,), np.float32))


def timestep(number: int) -> Timestep:
    rng = np.random.default_rng(number)
    image = rng.integers(0, 256, (2, 3, 3), np.uint8)
    observation = {"a/b": image, "joint": rng.normal(size=2).astype(np.float32)}
    action = rng.uniform(-1, 1, 4).astype(np.float32)
    step = Transition(action, 0.5, 0.0, observation, True) if number % 2 else None
    return Timestep(number, observation, step, Episode(1.5, 3, None if number % 3 else True, 2, 1))


def fill(spool: Spool, count: int) -> None:
    for number in range(spool.last + 1, spool.last + 1 + count):
        spool.append(LAYOUT.pack(timestep(number)))


def numbers(data: bytes) -> list[int | None]:
    return [LAYOUT.number(data[at : at + LAYOUT.size]) for at in range(0, len(data), LAYOUT.size)]


@pytest.mark.parametrize("number", [1, 2, 3])
def test_a_timestep_is_restored_from_its_bytes(number: int) -> None:
    given, data = timestep(number), LAYOUT.pack(timestep(number))
    assert LAYOUT.number(data) == number
    found = LAYOUT.unpack(data)
    assert (found.number, found.episode) == (number, given.episode)
    for key, value in given.observation.items():
        assert found.observation[key].dtype == value.dtype
        assert (found.observation[key] == value).all()
    if given.transition is None:
        assert found.transition is None
    else:
        assert found.transition is not None
        assert (found.transition.action == given.transition.action).all()
        assert found.transition.reward == 0.5
        assert found.transition.last
        assert found.transition.discount == 0.0


def test_any_changed_byte_is_noticed() -> None:
    data = bytearray(LAYOUT.pack(timestep(3)))
    for index in range(len(data)):
        data[index] ^= 1
        assert LAYOUT.number(data) is None
        data[index] ^= 1
    assert LAYOUT.number(data) == 3


def test_what_is_not_saved_is_kept(tmp_path: Path) -> None:
    with Spool.open(tmp_path) as spool:
        spool.belong_to("run")
        spool.start(0, LAYOUT.size, LAYOUT.number)
        fill(spool, 5)
        spool.discard(3)  # the file has later timesteps too
        fill(spool, 4)
        assert numbers(spool.read(2, 100)) == [2, 3, 4, 5]
        assert numbers(spool.read(6, 2)) == [6, 7]
        spool.discard(7)
        assert (spool.first, spool.last) == (6, 9)
    with Spool.open(tmp_path) as again:
        again.belong_to("run")
        again.start(7, LAYOUT.size, LAYOUT.number)
        assert (again.first, again.last) == (6, 9)
        again.discard(9)
        again.discard(9)
        assert len(again) == 0
    with Spool.open(tmp_path) as empty:
        empty.belong_to("run")
        with pytest.raises(MerlError, match="older checkpoint, and timesteps 6 to 9"):
            empty.start(5, LAYOUT.size, LAYOUT.number)
        empty.start(9, LAYOUT.size, LAYOUT.number)


@pytest.mark.parametrize("lost", [1, 40, LAYOUT.size, LAYOUT.size + 3])
def test_a_timestep_that_was_not_completely_written_is_dropped(tmp_path: Path, lost: int) -> None:
    with Spool.open(tmp_path) as spool:
        spool.start(0, LAYOUT.size, LAYOUT.number)
        fill(spool, 4)
        spool.sync()
    (file,) = tmp_path.glob("*.steps")
    data = file.read_bytes()
    file.write_bytes(data[:-lost] + b"\0" * (lost // 2))  # as after a loss of power
    with Spool.open(tmp_path) as again:
        again.start(0, LAYOUT.size, LAYOUT.number)
        assert again.last == 4 - (lost + LAYOUT.size - 1) // LAYOUT.size
        fill(again, 3)
        whole = b"".join(again.read(number, 1) for number in range(again.first, again.last + 1))
        assert numbers(whole) == list(range(1, again.last + 1))


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with Spool.open(tmp_path / "s") as spool:
        spool.belong_to("run")
        spool.start(0, LAYOUT.size, LAYOUT.number)
        fill(spool, 3)
        with (
            pytest.raises(MerlError, match=r"another actor uses .*--spool"),
            Spool.open(tmp_path / "s"),
        ):
            pass
    with Spool.open(tmp_path / "s") as again:
        with pytest.raises(MerlError, match="holds timesteps of another run"):
            again.belong_to("other")
        again.belong_to("run")
        with pytest.raises(MerlError, match="ends at timestep 3, but the learner has 8"):
            again.start(8, LAYOUT.size, LAYOUT.number)
        again.finish()
    with Spool.open(tmp_path / "s") as reused:
        former = reused.id
        reused.belong_to("other")
        assert reused.id != former
        reused.start(0, LAYOUT.size, LAYOUT.number)
        assert len(reused) == 0
    (tmp_path / "s/spool.json").write_text("{")
    with pytest.raises(MerlError, match="cannot be read"), Spool.open(tmp_path / "s"):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(MerlError, match="cannot be used"), Spool.open(tmp_path / "file"):
        pass


@pytest.mark.parametrize("lasts", [False, True])
def test_a_failing_disk_is_one_line_and_loses_no_timestep(tmp_path: Path, lasts: bool) -> None:
    kept = tmp_path / "kept"  # the number of timesteps that were written

    def act() -> int:
        try:
            with Spool.open(tmp_path / "spool") as spool:
                spool.belong_to("run")
                spool.start(0, LAYOUT.size, LAYOUT.number)
                for _ in range(3):
                    fill(spool, 1)
                    kept.write_text(str(spool.last))
                    spool.sync()
                    spool.read(1, 3)
                spool.discard(0)
                fill(spool, 1)
                kept.write_text(str(spool.last))
                spool.finish()
        except MerlError as error:
            print(error)
            return error.exit_code
        return 0

    count = len(with_faults(act, Faults(tmp_path / "spool")).names)
    for at in range(1 + lasts, count + 1, 2):
        shutil.rmtree(tmp_path / "spool", ignore_errors=True)
        kept.write_text("0")
        done = with_faults(act, Faults(tmp_path / "spool", at, errno.EIO, lasts))
        assert done.code in (0, 2), done.err
        assert done.out.count("\n") == (done.code != 0)
        with Spool.open(tmp_path / "spool") as spool:
            spool.belong_to("run")
            spool.start(0, LAYOUT.size, LAYOUT.number)
            assert spool.last >= int(kept.read_text())
            if spool.last:
                assert numbers(spool.read(1, 9)) == [*range(1, min(spool.last, 3) + 1)]
