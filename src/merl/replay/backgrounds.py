"""What a camera that stands still sees behind everything that moves."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError

STAGES = (1, 5, 25)
"""A background is made after so many episodes' first pictures."""


class Backgrounds:
    """Medians of some episodes' first pictures: the arm, each time elsewhere, vanishes in them.

    What is on the disk is those first pictures, so that a run that goes back to a checkpoint makes
    the same backgrounds from there on as it would have made.

    Args:
        size: bytes of a picture.
        file: keeps the first pictures, one behind the other; without one they are in memory alone.

    Attributes:
        starts: how many first pictures there are.
    """

    def __init__(self, size: int, file: Path | None) -> None:
        self._size, self._file = size, file
        self._in_memory = np.empty((0, size), np.uint8)
        self.starts = min(len(self._first()), STAGES[-1])
        self._made = self._medians()
        # A run that was begun when the backgrounds themselves were kept stays with those.
        former = _whole(file and file.with_suffix(".background"), size)
        self._final = bool(len(former))
        self._made.extend(former)

    def __len__(self) -> int:
        """How many there are; number 0, of no picture at all, is black."""
        return len(self._made)

    def __getitem__(self, number: int) -> NDArray[np.uint8]:
        """One of them: (size,)."""
        return self._made[number]

    def begun(self, picture: NDArray[np.uint8]) -> None:
        """An episode begins so: after some of them the background is known better."""
        if self._final or self.starts == STAGES[-1]:
            return
        row = picture.reshape(1, -1)
        if self._file is None:
            self._in_memory = np.concatenate([self._in_memory, row])
        else:
            try:
                _append(self._file, row, self.starts * self._size)
            except OSError:  # a full disk: the next episode will do
                return
        self.starts += 1
        if self.starts in STAGES:
            self._made.append(self._median(self.starts))

    def go_back(self, starts: int) -> None:
        """Forget the first pictures after the first so many, and what was made of them.

        Raises:
            MerlError: there are not so many, so that what was kept could not be told any more.
        """
        if self._final:
            return
        if starts > self.starts:
            raise MerlError(
                f"{self._file} holds {self.starts} of the {starts} pictures that the replay's are "
                "kept as differences from: bring the whole folder back, or start a new run"
            )
        self.starts = starts
        self._made = self._medians()
        self._in_memory = self._in_memory[:starts]
        if self._file is not None and self._file.exists():
            os.truncate(self._file, starts * self._size)

    def _first(self) -> NDArray[np.uint8]:
        """The first pictures (n, size): read when they are wanted, which is seldom."""
        return self._in_memory if self._file is None else _whole(self._file, self._size)

    def _medians(self) -> list[NDArray[np.uint8]]:
        black = np.zeros(self._size, np.uint8)
        return [black, *(self._median(stage) for stage in STAGES if stage <= self.starts)]

    def _median(self, starts: int) -> NDArray[np.uint8]:
        median: NDArray[np.floating] = np.median(self._first()[:starts], axis=0)
        return median.astype(np.uint8)


def _whole(file: Path | None, size: int) -> NDArray[np.uint8]:
    """The pictures (n, size) that a file holds; one that was cut short is none."""
    if file is None or not file.exists():
        return np.empty((0, size), np.uint8)
    raw = np.fromfile(file, np.uint8)
    return raw[: len(raw) // size * size].reshape(-1, size)


def _append(path: Path, picture: NDArray[np.uint8], at: int) -> None:
    """Have it on the disk before any picture is kept as a difference from what is made of it."""
    with path.open("ab") as file:
        file.truncate(at)  # one that was cut short
        file.write(picture.tobytes())
        file.flush()
        os.fsync(file.fileno())
