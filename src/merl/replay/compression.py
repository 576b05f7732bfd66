"""Lossless compression of frames: the difference from the background, compressed by LZ4.

The images of a fixed camera are mostly static. So a frame is stored as its difference from a
*background* (`backgrounds.py`). Compressed frames differ in size and are stored one after the other
in a ring of bytes; if they need more bytes than reserved, the replay holds fewer steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lz4.block
import numpy as np
from numpy.typing import NDArray

from merl.replay.backgrounds import Backgrounds
from merl.replay.spec import Field


class CompressedFrames:
    """Compressed frames of one observation key, in all rings.

    Args:
        field: type (an unsigned integer) and shape of a frame.
        data: the bytes.
        spans: first byte and number of bytes of each slot's frame, (slots, 2).
        starts: file of the frames that the backgrounds are made from; None: in memory only.

    Attributes:
        field: type and shape of a frame.
        backgrounds: backgrounds from which the differences are taken.
    """

    def __init__(
        self, field: Field, data: NDArray[np.uint8], spans: NDArray[np.int64], starts: Path | None
    ) -> None:
        self.field, self._data, self._spans = field, data, spans
        self.backgrounds = Backgrounds(field, starts)

    def encode(self, frame: NDArray[Any]) -> bytes:
        """Encode a frame: the number of its background, then the compressed difference."""
        number = len(self.backgrounds) - 1
        # The subtraction wraps around; decoding reverses it.
        difference = frame.reshape(-1) - self.backgrounds[number]
        packed: bytes = lz4.block.compress(difference, store_size=False)
        return bytes([number]) + packed

    def span(self, slot: int) -> tuple[int, int]:
        """Return the first byte and the number of bytes of the frame in a slot."""
        begin, count = self._spans[slot].tolist()
        return begin, count

    def read(self, slot: int) -> bytes:
        """Return the encoded frame of a slot."""
        begin, count = self.span(slot)
        return self._data[begin : begin + count].tobytes()

    def write(self, slot: int, begin: int, encoded: bytes) -> None:
        """Write the encoded frame of a slot from byte `begin` on."""
        self._spans[slot] = begin, len(encoded)
        self._data[begin : begin + len(encoded)] = np.frombuffer(encoded, np.uint8)

    def byte_range(
        self, first: NDArray[np.int64], last: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return byte ranges; see `RawFrames.byte_range`."""
        return self._spans[first, 0], self._spans[last].sum(axis=1)

    def stacks(self, slots: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
        """Yield stacks, all decoded into the same array; see `RawFrames.stacks`."""
        stack = np.empty((slots.shape[1], *self.field.shape), self.field.dtype)
        flat = list(stack.reshape(len(stack), -1))
        data, dtype, size = self._data.data, self.field.dtype, self.field.bytes
        for spans in self._spans[slots].tolist():
            for (begin, count), frame in zip(spans, flat, strict=True):
                packed = data[begin + 1 : begin + count]
                difference = lz4.block.decompress(packed, uncompressed_size=size)
                background = self.backgrounds[data[begin]]
                np.add(np.frombuffer(difference, dtype), background, out=frame)
            yield stack


class ByteRing:
    """The bytes of the frames of one ring, written one after the other.

    No frame crosses the end: one that does not fit there is written at the beginning.

    Args:
        frames: the frames of all rings.
        begin: first byte of this ring.
        length: number of bytes of this ring.
    """

    def __init__(self, frames: CompressedFrames, begin: int, length: int) -> None:
        self._frames, self._begin, self._length = frames, begin, length
        self._head = begin  # the byte after the newest frame

    def overwrites(self, slot: int, encoded: bytes) -> bool:
        """Return whether writing a frame next overwrites the oldest frame, which is in `slot`."""
        free = (self._frames.span(slot)[0] - self._head) % self._length
        return free < (self._place(encoded) + len(encoded) - self._head) % self._length

    def write(self, slot: int, encoded: bytes) -> None:
        """Write an encoded frame after the newest one."""
        begin = self._place(encoded)
        self._frames.write(slot, begin, encoded)
        self._head = begin + len(encoded)

    def continue_after(self, slot: int | None) -> None:
        """Write the next frame after the frame of a slot, or at the beginning."""
        self._head = self._begin if slot is None else sum(self._frames.span(slot))

    def _place(self, encoded: bytes) -> int:
        """Return the byte where a frame is written next."""
        fits = self._head + len(encoded) <= self._begin + self._length
        return self._head if fits else self._begin
