"""Backgrounds: estimates of the static part of a fixed camera's images."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError

STAGES = (1, 5, 25)
"""Numbers of episodes after whose first images a new background is made."""


class Backgrounds:
    """Medians, pixel by pixel, of the first images of several episodes.

    Each episode starts with the arm in another place, so the median removes the arm. The disk holds
    the first images, so that a run that is resumed from a checkpoint makes the same backgrounds as
    it would have made without the interruption.

    Args:
        size: bytes of an image.
        file: file of the first images, one after the other; None keeps them in memory only.

    Attributes:
        starts: number of first images.
    """

    def __init__(self, size: int, file: Path | None) -> None:
        self._size, self._file = size, file
        self._in_memory = np.empty((0, size), np.uint8)
        self.starts = min(len(self._first()), STAGES[-1])
        self._made = self._medians()
        # Older runs stored the backgrounds themselves, and continue to use those.
        former = _whole(file and file.with_suffix(".background"), size)
        self._final = bool(len(former))
        self._made.extend(former)

    def __len__(self) -> int:
        """Return the number of backgrounds; number 0, made from no image, is black."""
        return len(self._made)

    def __getitem__(self, number: int) -> NDArray[np.uint8]:
        """Return a background, uint8 (size,)."""
        return self._made[number]

    def begun(self, picture: NDArray[np.uint8]) -> None:
        """Add the first image of an episode; at some counts, make a better background."""
        if self._final or self.starts == STAGES[-1]:
            return
        row = picture.reshape(1, -1)
        if self._file is None:
            self._in_memory = np.concatenate([self._in_memory, row])
        else:
            try:
                _append(self._file, row, self.starts * self._size)
            except OSError:  # the disk is full: try again in the next episode
                return
        self.starts += 1
        if self.starts in STAGES:
            self._made.append(self._median(self.starts))

    def go_back(self, starts: int) -> None:
        """Keep the first `starts` images and their backgrounds, and discard all newer ones.

        Raises:
            MerlError: there are fewer images, so that images of the replay cannot be decoded.
        """
        if self._final:
            return
        if starts > self.starts:
            raise MerlError(
                f"{self._file} holds {self.starts} of the {starts} images that decode the replay's "
                "images: restore the complete run folder, or start a new run"
            )
        self.starts = starts
        self._made = self._medians()
        self._in_memory = self._in_memory[:starts]
        if self._file is not None and self._file.exists():
            os.truncate(self._file, starts * self._size)

    def _first(self) -> NDArray[np.uint8]:
        """Return the first images (n, size), read from the file at each of the few calls."""
        return self._in_memory if self._file is None else _whole(self._file, self._size)

    def _medians(self) -> list[NDArray[np.uint8]]:
        black = np.zeros(self._size, np.uint8)
        return [black, *(self._median(stage) for stage in STAGES if stage <= self.starts)]

    def _median(self, starts: int) -> NDArray[np.uint8]:
        median: NDArray[np.floating] = np.median(self._first()[:starts], axis=0)
        return median.astype(np.uint8)


def _whole(file: Path | None, size: int) -> NDArray[np.uint8]:
    """Return the images (n, size) in a file, without an incomplete last one."""
    if file is None or not file.exists():
        return np.empty((0, size), np.uint8)
    raw = np.fromfile(file, np.uint8)
    return raw[: len(raw) // size * size].reshape(-1, size)


def _append(path: Path, picture: NDArray[np.uint8], at: int) -> None:
    """Write an image to the disk, before any image depends on the background made from it."""
    with path.open("ab") as file:
        file.truncate(at)  # remove an incomplete image
        file.write(picture.tobytes())
        file.flush()
        os.fsync(file.fileno())
