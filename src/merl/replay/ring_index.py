"""Positions of entries in a ring, and how a ring that has wrapped grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", int, NDArray[np.int64])


class Move(NamedTuple):
    """Move of a number of entries from position `begin` to position `to`."""

    begin: int
    entries: int
    to: int


@dataclass(frozen=True)
class RingIndex:
    """Map from entries, numbered 0, 1, 2, ..., to positions: (number - origin) mod length.

    Attributes:
        length: number of entries for which the ring has room.
        origin: the number, possibly negative, that maps to position 0.
    """

    length: int
    origin: int = 0

    def of(self, number: Number) -> Number:
        """Return the position of an entry."""
        return (number - self.origin) % self.length

    def least_longer(self, end: int) -> int:
        """Return the smallest length that `longer` supports."""
        return self.length + (min(self._parts(end)) if self._has_wrapped(end) else 0)

    def longer(self, length: int, end: int) -> tuple[RingIndex, Move | None]:
        """Return the index of a longer ring, and the move within the ring that it requires.

        In a ring that has wrapped, the oldest entries are behind the newest: one of the two parts
        moves to the new end. The move overwrites no entry, so the ring is valid with the old index
        until the new index replaces it.

        Args:
            length: new length, at least `least_longer(end)`.
            end: number of the next entry.
        """
        if not self._has_wrapped(end):
            return RingIndex(length, self.origin), None
        newer, older = self._parts(end)
        if newer <= older:
            move = Move(0, newer, to=self.length)
            return RingIndex(length, end - self.length - newer), move if newer else None
        return RingIndex(length, end - newer - length), Move(newer, older, to=length - older)

    def _has_wrapped(self, end: int) -> bool:
        return end - self.origin > self.length

    def _parts(self, end: int) -> tuple[int, int]:
        """Return the number of positions before that of the next entry, and from there on."""
        newer = self.of(end)
        return newer, self.length - newer
