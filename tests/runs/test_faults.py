"""Failing file operations of a run: it ends with one line or goes on, and loses nothing."""

from __future__ import annotations

import errno
import itertools
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from safetensors.torch import load_file

import merl.cli.resume
import merl.cli.train
import merl.training.setup
from faults import Ended, Faults, with_faults
from merl.cli import main
from merl.runs import checkpoint
from merl.training.timing import Arithmetic, Timing

CODES = (errno.EROFS, errno.EIO, errno.ESTALE, errno.EACCES, errno.ENOSPC)
STEPS, HALF = 120, 60
_FLAGS = {
    "--agent": "ddpg",
    "--preset": "smoke",
    "--threads": 1,
    "--agent.precision": "fp32",
    "--agent.hidden-dim": 8,
    "--random-steps": 20,
    "--seed-steps": 20,
    "--updates-per-step": 0.1,
    "--replay.batch-size": 4,
    "--replay.capacity": 50,
    "--save-every": 0,
    "--eval.every": 60,
    "--eval.episodes": 1,
    "--eval.video": "none",
}
LESS_EXACT = ("not bit-exactly", "resuming loses the oldest steps of the replay")
"""What a run says that is no longer the same, bit for bit, as an uninterrupted one."""


class Case(NamedTuple):
    """Operation number `at` fails, in a new run or in a resumed one."""

    resumes: bool
    at: int
    name: str
    code: int
    lasts: bool
    writing: bool


def line(run: Path, steps: int = STEPS) -> list[str]:
    flags = {**_FLAGS, "--steps": steps, "--run-dir": run}
    words = [str(word) for flag in flags.items() for word in flag]
    return ["train", "merl.envs.dot:whole", *words, "--eval.no-references"]


def run_merl(arguments: list[str], state: Path) -> int:
    """Run merl without timing and drawing; `state` takes the place of the home folder's."""
    timing = Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(state))
        patch.setattr(merl.training.setup, "measure", lambda *_: timing)
        return main(arguments)


class Sweep:
    """A reference run, a half of it, and runs whose file operations fail.

    Args:
        folder: an empty folder for them.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.base = folder, folder / "case"
        self.run, self.state = self.base / "run", self.base / "state"
        self._operations: dict[tuple[bool, bool], list[str]] = {}
        self.base.mkdir()
        torch.set_num_threads(1)
        assert run_merl(line(self.run), self.state) == 0  # so that everything is imported
        self.reference = weights(self.run)
        self.run.rename(folder / "whole")
        assert run_merl(line(self.run, HALF), self.state) == 0
        self.run.rename(folder / "half")

    def start(self, resumes: bool, faults: Faults | None = None) -> Ended:
        """Start a new run, or the half of one that resumes."""
        shutil.rmtree(self.base)
        self.base.mkdir()
        if resumes:
            shutil.copytree(self.folder / "half", self.run)
            return self.resume(faults)
        return with_faults(lambda: run_merl(line(self.run), self.state), faults)

    def resume(self, faults: Faults | None = None) -> Ended:
        arguments = ["resume", str(self.run), "--steps", str(STEPS)]
        return with_faults(lambda: run_merl(arguments, self.state), faults)

    def operations(self, resumes: bool, writing: bool) -> list[str]:
        """Return the operations of a run without faults."""
        if (resumes, writing) not in self._operations:
            faults = Faults(self.base, writing=writing)
            self._operations[resumes, writing] = self.start(resumes, faults).names
        return self._operations[resumes, writing]

    def cases(self) -> Iterator[Case]:
        """Yield the first, the middle and the last operation of each kind, with changing errors."""
        codes = itertools.cycle(CODES)
        refusals = itertools.cycle([errno.EROFS, errno.ENOSPC])
        for resumes, writing in itertools.product((False, True), repeat=2):
            names = self.operations(resumes, writing)
            kinds: dict[str, list[int]] = {}
            for at, name in enumerate(names, 1):
                kinds.setdefault(re.sub(r"\d+", "N", name), []).append(at)
            for places in kinds.values():
                for at in sorted({places[0], places[len(places) // 2], places[-1]}):
                    if not writing:
                        yield Case(resumes, at, names[at - 1], next(codes), False, False)
                    code = next(refusals if writing else codes)
                    yield Case(resumes, at, names[at - 1], code, True, writing)

    def problem(self, case: Case) -> str | None:
        """Run a case, then resume it on a good disk; return what is wrong, if anything is."""
        faults = Faults(self.base, case.at, case.code, case.lasts, case.writing)
        ended = self.start(case.resumes, faults)
        if (why := wrong(ended)) is not None:
            return f"{why}\n{ended.err}{ended.out[-400:]}"
        told = ended.out + ended.err
        if ended.code != 0 or not case.resumes:
            then = self.resume() if (self.run / "config.json").exists() else self.start(False)
            if then.code != 0:
                return f"then {then.code}: {then.err}\nafter {ended.code}: {ended.err}"
            told += then.out + then.err
        if same(weights(self.run), self.reference) or is_told(told):
            return None
        return f"other weights\n{told}"


def is_told(printed: str) -> bool:
    """Return whether a run has told that it is not the same as an uninterrupted one."""
    return any(text in " ".join(printed.split()) for text in LESS_EXACT)


def wrong(ended: Ended) -> str | None:
    """Return what is wrong with the end of a run."""
    if ended.code not in (0, 2, 4, 5):
        return f"exit code {ended.code}"
    if "Traceback" in ended.err + ended.out:
        return "a traceback"
    errors = [each for each in ended.err.splitlines() if each.startswith("merl: error: ")]
    if len(errors) != (ended.code != 0):
        return f"{len(errors)} errors with exit code {ended.code}"
    others = [each for each in ended.err.splitlines() if not each.startswith("merl: ")]
    return f"printed {others}" if others else None


def weights(run: Path) -> dict[str, Any]:
    last = max(path for path in (run / "checkpoints").iterdir() if path.name.isdecimal())
    return load_file(last / "weights.safetensors") | {"step": torch.tensor(int(last.name))}


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(one[name].equal(other[name]) for name in one)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Sweep:
    return Sweep(tmp_path_factory.mktemp("faults"))


SAMPLE = [
    (False, "write run/checkpoints/.part-00000080/learner.pt", errno.EROFS, True),
    (False, "stat run/config.json", errno.ESTALE, True),
    (False, "write run/replay/overwritten.journal", errno.ENOSPC, False),
    (True, "mmap.__new__ run/replay/53/reward.bin", errno.EIO, True),
    (True, "read run/checkpoints/00000060/manifest.json", errno.ESTALE, False),
]


@pytest.mark.parametrize(("resumes", "name", "code", "lasts"), SAMPLE, ids=lambda value: str(value))
def test_a_run_survives_a_failing_operation(
    sweep: Sweep, resumes: bool, name: str, code: int, lasts: bool
) -> None:
    names = sweep.operations(resumes, writing=False)
    at = len(names) - names[::-1].index(name)  # the last one
    assert sweep.problem(Case(resumes, at, name, code, lasts, writing=False)) is None


def test_a_run_whose_replay_is_removed_writes_it_again(sweep: Sweep) -> None:
    write = checkpoint.save

    def save_and_remove(root: Path, step: int, *args: Any, **options: Any) -> Any:
        saved = write(root, step, *args, **options)
        if step == HALF + 20:
            shutil.rmtree(root.parent / "replay")
        return saved

    def train() -> int:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(checkpoint, "save", save_and_remove)
            return run_merl(line(sweep.run), sweep.state)

    shutil.rmtree(sweep.base)
    sweep.base.mkdir()
    ended = with_faults(train)
    assert ended.code == 0, ended.err
    assert ended.err.count("was removed: it is written again") == 1
    assert same(weights(sweep.run), sweep.reference)
    arguments = ["resume", str(sweep.run), "--steps", str(STEPS + 40)]
    assert with_faults(lambda: run_merl(arguments, sweep.state)).code == 0


@pytest.mark.long
@pytest.mark.timeout(10_000)
def test_a_run_survives_every_failing_operation(sweep: Sweep) -> None:
    problems = [(case, found) for case in sweep.cases() if (found := sweep.problem(case))]
    assert problems == []


def run_part(part: int, parts: int) -> int:
    """Run a part of all cases; print and count the problems."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = Sweep(Path(folder))
        cases = [*sweep.cases()][part::parts]
        problems = 0
        for number, case in enumerate(cases):
            if (found := sweep.problem(case)) is not None:
                problems += 1
                code = errno.errorcode[case.code]
                print(f"--- {number} of {len(cases)}: {case}, {code}: {found}", flush=True)
        print(f"{problems} problems in {len(cases)} cases")
        return problems


if __name__ == "__main__":
    sys.exit(run_part(int(sys.argv[1]), int(sys.argv[2])) > 0)
