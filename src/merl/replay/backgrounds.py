"""Backgrounds: estimates of the static part of a fixed camera's images."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.core.files import cause, is_gone, open_file, read_file, replace_file, reporting
from merl.replay.spec import Field

STAGES = (1, 5, 25)
"""Numbers of episodes after whose first frames a new background is made."""


class Backgrounds:
    """Medians, pixel by pixel, of the first frames of several episodes.

    Each episode starts with the arm in another place, so the median removes the arm. The disk holds
    the first frames, so that a run that is resumed from a checkpoint makes the same backgrounds as
    it would have made without the interruption.

    Args:
        field: type and shape of a frame.
        file: file of the first frames, one after the other; None: in memory only.
    """

    def __init__(self, field: Field, file: Path | None) -> None:
        self._field, self._file = field, file
        self._first: list[NDArray[Any]] = []
        if file is not None:
            raw = _content(file, field)
            for end in range(field.bytes, len(raw) + 1, field.bytes):
                self._first.append(np.frombuffer(raw[end - field.bytes : end], field.dtype))
        self._made = self._medians()

    @property
    def frames(self) -> int:
        """Return the number of first frames."""
        return len(self._first)

    def __len__(self) -> int:
        """Return the number of backgrounds; number 0, made from no frame, is black."""
        return len(self._made)

    def __getitem__(self, number: int) -> NDArray[Any]:
        """Return a background, one-dimensional."""
        return self._made[number]

    def add(self, frame: NDArray[Any]) -> None:
        """Add the first frame of an episode; at some counts, make a better background."""
        if self.frames == STAGES[-1]:
            return
        frame = np.array(frame, self._field.dtype).reshape(-1)
        if self._file is not None:
            try:
                _append(self._file, frame, self.frames * self._field.bytes)
            except OSError:  # the disk is full: try again in the next episode
                return
        self._first.append(frame)
        if self.frames in STAGES:
            self._made.append(self._median(self.frames))

    def check(self, frames: int, sum_: int | None = None) -> None:
        """Raise MerlError if first frames are missing or damaged: decoding needs them.

        Args:
            frames: number of first frames.
            sum_: their `checksum`; None if it is not known.
        """
        if frames > self.frames:
            problem = f"holds {self.frames} of the {frames} images that decode"
        elif sum_ is not None and sum_ != self.checksum(frames):
            problem = "is damaged, and its images decode"
        else:
            return
        raise MerlError(
            f"{self._file} {problem} the replay's images: restore the complete run folder, or "
            "start a new run"
        )

    def checksum(self, frames: int) -> int:
        """Return the CRC-32 of the first `frames` first frames."""
        return zlib.crc32(b"".join(frame.tobytes() for frame in self._first[:frames]))

    def truncate(self, frames: int) -> None:
        """Keep the backgrounds of the first `frames` frames, and discard all newer ones."""
        self._first = self._first[:frames]
        self._made = self._medians()
        if self._file is not None and not is_gone(self._file):
            with reporting(f"{self._file} cannot be written"):
                os.truncate(self._file, frames * self._field.bytes)

    def write_again(self) -> None:
        """Write the file of the first frames, which was removed.

        Raises:
            OSError: it cannot be written.
        """
        assert self._file is not None
        replace_file(self._file, *(frame.tobytes() for frame in self._first))

    def _medians(self) -> list[NDArray[Any]]:
        black = np.zeros(self._field.shape, self._field.dtype).reshape(-1)
        return [black, *(self._median(stage) for stage in STAGES if stage <= self.frames)]

    def _median(self, frames: int) -> NDArray[Any]:
        median: NDArray[np.floating] = np.median(self._first[:frames], axis=0)
        return median.astype(self._field.dtype)


def _content(path: Path, field: Field) -> bytes:
    """Return the content of the file of the first frames; nothing if there is none.

    Raises:
        MerlError: it cannot be read.
    """
    try:
        return read_file(path, most=(STAGES[-1] + 1) * field.bytes)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {cause(error)}") from error


def _append(path: Path, frame: NDArray[Any], at: int) -> None:
    """Write a frame to the disk, before any frame depends on the background made from it."""
    with open_file(path, "ab") as file:
        file.truncate(at)  # remove an incomplete frame
        file.write(frame.tobytes())
        file.flush()
        os.fsync(file.fileno())
