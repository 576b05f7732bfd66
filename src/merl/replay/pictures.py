"""Reading of image stacks from the ring, with read-ahead for images that are only on disk."""

from __future__ import annotations

import mmap
import resource
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from merl.core import FrameTransform


class Pictures(Protocol):
    """Images of one observation key, by slot.

    Attributes:
        shape: shape of an image, (H, W, C).
    """

    shape: tuple[int, ...]

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """Yield the frames (K, H, W, C) of each row of slots (B, K), valid until the next."""
        ...

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return where the bytes from one slot's image to another's begin and end, for many pairs.

        If the ring's end lies between the two images, the end comes before the beginning.
        """
        ...


class RawPictures:
    """Uncompressed images.

    Args:
        ring: the images, (slots, H, W, C).
    """

    def __init__(self, ring: NDArray[np.uint8]) -> None:
        self._ring, self.shape = ring, ring.shape[1:]
        self._bytes = ring[0].nbytes

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """Yield views of contiguous slots, else copies; see `Pictures`."""
        contiguous = (np.diff(slots, axis=1) == 1).all(axis=1)
        for first, last, these, whole in zip(
            slots[:, 0].tolist(), slots[:, -1].tolist(), slots, contiguous.tolist(), strict=True
        ):
            yield self._ring[first : last + 1] if whole else self._ring[these]

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return byte ranges; see `Pictures`."""
        return first * self._bytes, (last + 1) * self._bytes


def as_it_is(_: int, frames: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """Copy the frames unchanged; a `FrameTransform`."""
    out[:] = frames


def copied(pictures: Pictures, slots: NDArray[np.int64], copy: FrameTransform) -> NDArray[np.uint8]:
    """Return the images at slots (B, K), each stack copied by `copy`: (B, K, H, W, C)."""
    out = np.empty((*slots.shape, *pictures.shape), np.uint8)
    for sample, (frames, place) in enumerate(zip(pictures.stacks(slots), out, strict=True)):
        copy(sample, frames, place)
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
    def ask(file: mmap.mmap, begin: NDArray[np.int64], end: NDArray[np.int64]) -> None:
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
