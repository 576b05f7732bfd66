"""Pictures on their way out of the ring: stack by stack, and read ahead where the disk has them."""

from __future__ import annotations

import mmap
import resource
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from merl.core import FrameTransform


class Pictures(Protocol):
    """The pictures of one key, by slot.

    Attributes:
        shape: of a picture, (H, W, C).
    """

    shape: tuple[int, ...]

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """Frames (K, H, W, C) at slots (B, K), stack after stack; each is gone with the next."""
        ...

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Where the bytes from one slot's picture to another's begin and end, of many such pairs.

        Where the ring's end lies between the two, the end comes before the beginning.
        """
        ...


class RawPictures:
    """Pictures as they are.

    Args:
        ring: (slots, H, W, C).
    """

    def __init__(self, ring: NDArray[np.uint8]) -> None:
        self._ring, self.shape = ring, ring.shape[1:]
        self._bytes = ring[0].nbytes

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """See `Pictures`: where they lie, if they lie in one piece."""
        in_one_piece = (np.diff(slots, axis=1) == 1).all(axis=1)
        for first, last, these, whole in zip(
            slots[:, 0].tolist(), slots[:, -1].tolist(), slots, in_one_piece.tolist(), strict=True
        ):
            yield self._ring[first : last + 1] if whole else self._ring[these]

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `Pictures`."""
        return first * self._bytes, (last + 1) * self._bytes


def as_it_is(_: int, frames: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """The copy that changes nothing."""
    out[:] = frames


def copied(pictures: Pictures, slots: NDArray[np.int64], copy: FrameTransform) -> NDArray[np.uint8]:
    """Pictures at slots (B, K), each stack copied as it is told: (B, K, H, W, C)."""
    out = np.empty((*slots.shape, *pictures.shape), np.uint8)
    for sample, (frames, place) in enumerate(zip(pictures.stacks(slots), out, strict=True)):
        copy(sample, frames, place)
    return out


class ReadAhead:
    """Has the system read from the disk what is needed next, all at once, where it is there alone.

    Touched one after the other, pages are waited for one by one. To ask for what is in memory costs
    time, too: so it is asked only for some time after pages had to be waited for.
    """

    FEW = 8
    """Pages of a batch that may have to be waited for."""
    BATCHES = 200
    """For which it is asked; the next one shows whether that is still wanted."""

    def __init__(self) -> None:
        self._left = 0
        self._waited = _pages_waited_for()

    @property
    def is_wanted(self) -> bool:
        """Whether to ask before the next batch."""
        return self._left > 0

    def begin(self) -> None:
        """A batch is about to be taken."""
        self._waited = _pages_waited_for()

    def end(self) -> None:
        """It was taken."""
        if _pages_waited_for() - self._waited > self.FEW:
            self._left = self.BATCHES
        elif self._left:
            self._left -= 1

    @staticmethod
    def ask(file: mmap.mmap, begin: NDArray[np.int64], end: NDArray[np.int64]) -> None:
        """Have these bytes of a file read; returns at once.

        Stretches that end before they begin are passed over.
        """
        begin = begin // mmap.PAGESIZE * mmap.PAGESIZE
        for at, count in zip(begin.tolist(), (end - begin).tolist(), strict=True):
            if count > 0:
                file.madvise(mmap.MADV_WILLNEED, at, count)


def _pages_waited_for() -> int:
    """By this thread, ever."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_majflt
