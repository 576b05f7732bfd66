"""Failing file operations of a run: it ends with one line or goes on, and loses nothing."""

from __future__ import annotations

import argparse
import errno
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load_file

import merl.cli.resume
import merl.cli.train
import merl.report.figures
import merl.training.setup
from faults import Ended, Faults, with_faults
from merl.cli import main
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
LESS_EXACT = (
    "the replay has overwritten",
    "resuming loses the oldest steps of the replay",
    "the run continues without it",
)
"""Lines that tell that a resumed run continues, but not bit for bit."""


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


def prepare() -> None:
    """Import what a run imports, and leave out timing and drawing."""
    torch.set_num_threads(1)
    timing = Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
    merl.training.setup.measure = lambda *_: timing  # type: ignore[assignment]
    merl.report.figures.learning_curve = lambda run, to, **_: to  # type: ignore[assignment]


class Sweep:
    """A reference run, a half of it, and the operations of both."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.base = folder, folder / "case"
        self.run = self.base / "run"
        os.environ["XDG_STATE_HOME"] = str(self.base / "state")
        self.base.mkdir()
        assert main(line(self.run)) == 0  # so that everything is imported
        self.reference = weights(self.run)
        shutil.rmtree(self.run)
        self.names = {}
        for writing in (False, True):
            faults = Faults(self.base, writing=writing)
            self.names[False, writing] = self.train(faults).names
            shutil.rmtree(self.run)
        assert with_faults(lambda: main(line(self.run, HALF))).code == 0
        self.run.rename(folder / "half")
        for writing in (False, True):
            self.restore_half()
            faults = Faults(self.base, writing=writing)
            self.names[True, writing] = self.resume(faults).names

    def restore_half(self) -> None:
        shutil.rmtree(self.run, ignore_errors=True)
        shutil.copytree(self.folder / "half", self.run)

    def train(self, faults: Faults | None = None) -> Ended:
        return with_faults(lambda: main(line(self.run)), faults)

    def resume(self, faults: Faults | None = None) -> Ended:
        return with_faults(lambda: main(["resume", str(self.run), "--steps", str(STEPS)]), faults)

    def cases(self) -> Iterator[Case]:
        """Yield the first, the middle and the last operation of each kind, with each error."""
        number = 0
        for (resumes, writing), names in self.names.items():
            kinds: dict[str, list[int]] = {}
            for at, name in enumerate(names, 1):
                kinds.setdefault(re.sub(r"\d+", "N", name), []).append(at)
            for places in kinds.values():
                for at in sorted({places[0], places[len(places) // 2], places[-1]}):
                    for lasts in (False, True):
                        code = CODES[number % len(CODES)]
                        number += 1
                        if writing and (not lasts or code in (errno.EIO, errno.ESTALE)):
                            code = (errno.EROFS, errno.ENOSPC)[number % 2]
                            if not lasts:
                                continue
                        yield Case(resumes, at, names[at - 1], code, lasts, writing)

    def problem(self, case: Case) -> str | None:
        """Run a case; return what is wrong with it."""
        shutil.rmtree(self.base)
        self.base.mkdir()
        faults = Faults(self.base, case.at, case.code, case.lasts, case.writing)
        if case.resumes:
            self.restore_half()
            ended = self.resume(faults)
        else:
            ended = self.train(faults)
        if (why := wrong(ended)) is not None:
            return f"{why}\n{ended.err}{ended.out[-400:]}"
        told = ended.out + ended.err
        then = None
        if ended.code != 0 or not case.resumes:
            then = self.resume() if (self.run / "config.json").exists() else self.train()
            if then.code != 0:
                return f"then {then.code}: {then.err}\nafter {ended.code}: {ended.err}"
            told += then.out + then.err
        told = " ".join(told.split())
        if not same(weights(self.run), self.reference):
            if not any(text in told for text in LESS_EXACT):
                return f"other weights\n{told}"
            return None
        return None


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


def sweep(part: int = 0, parts: int = 1) -> int:
    """Run the cases; print and count the problems."""
    prepare()
    with tempfile.TemporaryDirectory() as folder:
        every = Sweep(Path(folder))
        cases = list(every.cases())[part::parts]
        problems = 0
        for number, case in enumerate(cases):
            found = every.problem(case)
            if found is not None:
                problems += 1
                print(
                    f"--- {number} of {len(cases)}: {case}, {errno.errorcode[case.code]}: {found}",
                    flush=True,
                )
        print(f"{problems} problems in {len(cases)} cases")
        return problems


if __name__ == "__main__":
    sys.exit(sweep(int(sys.argv[1]), int(sys.argv[2])) > 0)
