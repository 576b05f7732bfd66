"""Reading of frame stacks from the replay, with read-ahead for frames that are only on disk."""

from __future__ import annotations

import mmap
import resource
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import FrameTransform
from merl.replay.compression import CompressedFrames
from merl.replay.spec import Field


class RawFrames:
    """Uncompressed frames of one observation key, by slot.

    Args:
        field: type and shape of a frame, e.g. uint8 (H, W, C).
        data: the frames, (slots, *shape).
    """

    def __init__(self, field: Field, data: NDArray[Any]) -> None:
        self.field, self._data = field, data

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
        """Yield the frames (K, *shape) of each row of slots (B, K), valid until the next.

        Frames in contiguous slots are not copied.
        """
        contiguous = (np.diff(slots, axis=1) == 1).all(axis=1)
        for first, last, these, whole in zip(
            slots[:, 0].tolist(), slots[:, -1].tolist(), slots, contiguous.tolist(), strict=True
        ):
            yield self._data[first : last + 1] if whole else self._data[these]

    def byte_range(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first byte of the frames in slots `first`, and the byte after slots `last`.

        If the ring's end lies between two frames, the end comes before the beginning.
        """
        return first * self.field.bytes, (last + 1) * self.field.bytes


def copy_unchanged(_: int, frames: NDArray[Any], out: NDArray[Any]) -> None:
    """Copy the frames unchanged; a `FrameTransform`."""
    out[:] = frames


def copy_stacks(
    frames: RawFrames | CompressedFrames, slots: NDArray[np.int64], transform: FrameTransform
) -> NDArray[Any]:
    """Return the frames at slots (B, K), each stack copied by `transform`: (B, K, *shape)."""
    out = np.empty((*slots.shape, *frames.field.shape), frames.field.dtype)
    for sample, (stack, place) in enumerate(zip(frames.stacks(slots), out, strict=True)):
        transform(sample, stack, place)
    return out


class ReadAhead:
    """Requests to the operating system to read the next batch's pages from disk, all at once.

    Without a request, each page causes a separate wait. A request costs time even if the pages
    are in memory, so requests are made only for some batches after a batch had page faults.
    """

    FEW = 8
    """Major page faults of a batch that do not yet start requests."""
    BATCHES = 200
    """Batches with requests; the batch after these shows whether requests are still needed."""

    def __init__(self) -> None:
        self._left = 0
        self._faults = _major_page_faults()

    @property
    def is_wanted(self) -> bool:
        """Whether to request the pages of the next batch."""
        return self._left > 0

    def begin(self) -> None:
        """Mark that the reading of a batch starts."""
        self._faults = _major_page_faults()

    def end(self) -> None:
        """Mark that the reading of a batch has ended."""
        if _major_page_faults() - self._faults > self.FEW:
            self._left = self.BATCHES
        elif self._left:
            self._left -= 1

    @staticmethod
    def request(file: mmap.mmap, begin: NDArray[np.int64], end: NDArray[np.int64]) -> None:
        """Request these byte ranges of a file, without waiting for them.

        Ranges that end before they begin are skipped.
        """
        begin = begin // mmap.PAGESIZE * mmap.PAGESIZE
        for at, count in zip(begin.tolist(), (end - begin).tolist(), strict=True):
            if count > 0:
                file.madvise(mmap.MADV_WILLNEED, at, count)


def _major_page_faults() -> int:
    """Return the number of major page faults of this thread so far."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_majflt
