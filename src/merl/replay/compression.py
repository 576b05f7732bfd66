"""Lossless compression of images: the difference from the background, compressed by LZ4.

The images of a fixed camera are mostly static. So an image is stored as its difference from a
*background* (`backgrounds.py`). Compressed images differ in size and are stored one after the other
in a ring of bytes; if they need more bytes than reserved, the ring holds fewer steps.
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
    """Return the bytes that are reserved for an image, on average.

    A quarter: the arm's images at 84x84 take 3.6 KB with `raster` and 3.5 KB with `gl`, of 21.2 KB.
    Smaller images compress less: at 24x24 they take a third, so that the ring holds fewer steps.
    """
    return picture_bytes // 4 + 64


SLOTS_OF_ANY_PICTURE = 5
"""Slots whose reserved bytes can hold an incompressible image, which LZ4 enlarges by 1/255."""


class CompressedPictures:
    """Compressed images of one observation key.

    Byte positions always increase; `ring_index` maps a position to its byte in the ring. No image
    crosses the end of the ring.

    Args:
        ring: the bytes.
        ring_index: map from positions to bytes of the ring.
        spans: start position and number of bytes of each slot's image: (slots, 2).
        shape: shape of an image, uint8.
        starts: file of the images that the backgrounds are made from; None keeps them in memory.

    Attributes:
        backgrounds: backgrounds from which the differences are taken.
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
        self._ring, self._ring_index, self._spans = ring, ring_index, spans
        self._size = int(np.prod(shape))
        self._head = 0  # position of the next image
        self.backgrounds = Backgrounds(self._size, starts)

    def encode(self, picture: NDArray[np.uint8]) -> bytes:
        """Encode an image: the number of its background, then the compressed difference."""
        number = len(self.backgrounds) - 1
        # The subtraction wraps around; decoding reverses it.
        difference = picture.reshape(-1) - self.backgrounds[number]
        packed: bytes = lz4.block.compress(difference, store_size=False)
        return bytes([number]) + packed

    def end_of(self, encoded: bytes) -> int:
        """Return the position after an encoded image, if it were written next."""
        return self._begin(len(encoded)) + len(encoded)

    def overwritten(self, slot: int, end: int) -> bool:
        """Return whether writing up to position `end` overwrites the image of a slot."""
        return bool(self._spans[slot, 0] < end - len(self._ring))

    def write(self, slot: int, encoded: bytes) -> None:
        """Write an encoded image after the newest one."""
        begin = self._begin(len(encoded))
        self._spans[slot] = begin, len(encoded)
        self._bytes(slot)[:] = np.frombuffer(encoded, np.uint8)
        self._head = begin + len(encoded)

    def read(self, slot: int) -> bytes:
        """Return the encoded image of a slot."""
        return self._bytes(slot).tobytes()

    def restore(self, slot: int, encoded: bytes) -> None:
        """Restore an encoded image from `read`, at the position in the slot's span."""
        self._bytes(slot)[:] = np.frombuffer(encoded, np.uint8)

    def go_on_after(self, slot: int | None) -> None:
        """Write the next image after the image of a slot, or at position 0."""
        self._head = 0 if slot is None else int(self._spans[slot].sum())

    def stretch(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return byte ranges; see `pictures.Pictures`."""
        begin, (end, count) = self._spans[first, 0], self._spans[last].T
        return self._ring_index.of(begin), self._ring_index.of(end) + count

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[np.uint8]]:
        """Yield stacks, all decoded into the same array; see `pictures.Pictures`."""
        frames = np.empty((slots.shape[1], *self.shape), np.uint8)
        flat = list(frames.reshape(len(frames), -1))
        for spans in self._spans[slots].tolist():
            for (begin, count), frame in zip(spans, flat, strict=True):
                self._decode(begin, count, frame)
            yield frames

    def _decode(self, begin: int, count: int, out: NDArray[np.uint8]) -> None:
        at, data = self._ring_index.of(begin), self._ring.data
        difference = lz4.block.decompress(data[at + 1 : at + count], uncompressed_size=self._size)
        np.add(np.frombuffer(difference, np.uint8), self.backgrounds[data[at]], out=out)

    def _begin(self, count: int) -> int:
        """Return the next position with `count` contiguous bytes."""
        room = len(self._ring) - self._ring_index.of(self._head)
        return self._head if count <= room else self._head + room

    def _bytes(self, slot: int) -> NDArray[np.uint8]:
        begin, count = self._spans[slot].tolist()
        at = self._ring_index.of(begin)
        return self._ring[at : at + count]
