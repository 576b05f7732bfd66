"""Pictures kept compressed, without loss: what differs from the background, by LZ4.

A camera that stands still sees mostly what it saw before. So a picture is kept as its difference
from a *background* (`backgrounds.py`). Pictures take as many bytes as they take, one behind the
other in a ring of bytes; where they need more than was reserved, the ring holds fewer steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import lz4.block
import numpy as np
from numpy.typing import NDArray

from merl.replay.backgrounds import Backgrounds
from merl.replay.ring_index import RingIndex


def reserved_bytes(picture_bytes: int) -> int:
    """Bytes that are reserved for a picture, on the average.

    A quarter: the arm's images at 84x84 take 3.6 KB by `raster` and 3.5 KB by `gl`, of 21.2 KB.
    Smaller ones take more of their size: at 24x24 a third, so that the ring holds fewer steps.
    """
    return picture_bytes // 4 + 64


SLOTS_OF_ANY_PICTURE = 5
"""Whose bytes hold a picture that LZ4 makes no smaller, and a 255th larger."""


class CompressedPictures:
    """The pictures of one key.

    Positions in the ring keep counting up; `ring_index` says where the byte of one lies. No image
    crosses the end of the ring.

    Args:
        ring: the bytes.
        places: where they lie.
        spans: where each slot's picture begins, as such a position, and its bytes: (slots, 2).
        shape: of a picture, uint8.
        starts: the file that the backgrounds are made from; without one it is kept in memory.

    Attributes:
        backgrounds: what they are kept as a difference from.
    """

    def __init__(
        self,
        ring: NDArray[np.uint8],
        ring_index: RingIndex,
        spans: NDArray[np.int64],
        shape: tuple[int, ...],
        starts: Path | None,
    ) -> None:
        self.shape = shape
        self._ring, self._places, self._spans = ring, ring_index, spans
        self._size = int(np.prod(shape))
        self._head = 0  # where the next picture may begin
        self.backgrounds = Backgrounds(self._size, starts)

    def encode(self, picture: NDArray[np.uint8]) -> bytes:
        """A picture as it is kept: the number of its background, then the difference from it."""
        number = len(self.backgrounds) - 1
        difference = picture.reshape(-1) - self.backgrounds[number]  # wraps around, as wanted
        packed: bytes = lz4.block.compress(difference, store_size=False)
        return bytes([number]) + packed

    def end_of(self, kept: bytes) -> int:
        """The position behind a picture if it came next."""
        return self._begin(len(kept)) + len(kept)

    def overwritten(self, slot: int, end: int) -> bool:
        """Whether what a slot has is overwritten by what reaches up to position `end`."""
        return bool(self._spans[slot, 0] < end - len(self._ring))

    def write(self, slot: int, kept: bytes) -> None:
        """Put a picture behind the last one."""
        begin = self._begin(len(kept))
        self._spans[slot] = begin, len(kept)
        self._bytes(slot)[:] = np.frombuffer(kept, np.uint8)
        self._head = begin + len(kept)

    def read(self, slot: int) -> bytes:
        """A slot's picture as it is kept."""
        return self._bytes(slot).tobytes()

    def restore(self, slot: int, kept: bytes) -> None:
        """Put back what `read` gave, where the slot's span says."""
        self._bytes(slot)[:] = np.frombuffer(kept, np.uint8)

    def go_on_after(self, slot: int | None) -> None:
        """Have the next picture come behind a slot's, or first of all."""
        self._head = 0 if slot is None else int(self._spans[slot].sum())

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """See `pictures.Pictures`."""
        begin, (end, count) = self._spans[first, 0], self._spans[last].T
        return self._places.of(begin), self._places.of(end) + count

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """See `pictures.Pictures`: each is decoded into the place of the one before."""
        frames = np.empty((slots.shape[1], *self.shape), np.uint8)
        flat = list(frames.reshape(len(frames), -1))
        for spans in self._spans[slots].tolist():
            for (begin, count), frame in zip(spans, flat, strict=True):
                self._decode(begin, count, frame)
            yield frames

    def _decode(self, begin: int, count: int, out: NDArray[np.uint8]) -> None:
        at, kept = self._places.of(begin), self._ring.data
        difference = lz4.block.decompress(kept[at + 1 : at + count], uncompressed_size=self._size)
        np.add(np.frombuffer(difference, np.uint8), self.backgrounds[kept[at]], out=out)

    def _begin(self, count: int) -> int:
        """Where so many bytes in a row are next."""
        room = len(self._ring) - self._places.of(self._head)
        return self._head if count <= room else self._head + room

    def _bytes(self, slot: int) -> NDArray[np.uint8]:
        begin, count = self._spans[slot].tolist()
        at = self._places.of(begin)
        return self._ring[at : at + count]
