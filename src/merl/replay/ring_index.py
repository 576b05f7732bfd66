"""Where in a ring its entries lie, and how one that has come round is made longer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", int, NDArray[np.int64])


class Move(NamedTuple):
    """Entries that are to lie elsewhere: so many from a place on, to another."""

    begin: int
    entries: int
    to: int


@dataclass(frozen=True)
class RingIndex:
    """Entries are numbered as they come, 0, 1, 2, ...; number i lies at (i - origin) mod length.

    Attributes:
        length: entries that the ring has room for.
        origin: the entry that lies in the first place, or would.
    """

    length: int
    origin: int = 0

    def of(self, number: Number) -> Number:
        """Where an entry lies."""
        return (number - self.origin) % self.length

    def least_longer(self, end: int) -> int:
        """The least length that `longer` can make of it."""
        return self.length + (min(self._parts(end)) if self._has_come_round(end) else 0)

    def longer(self, length: int, end: int) -> tuple[RingIndex, Move | None]:
        """The places of a longer ring, and what has to be moved within it for that.

        Where the ring has come round, its oldest entries lie behind its newest: one of the two is
        brought to the new end. Nothing is moved to where anything lies, so that the ring is as it
        was until its places are replaced.

        Args:
            length: at least `least_longer(end)`.
            end: the number of the next entry.
        """
        if not self._has_come_round(end):
            return RingIndex(length, self.origin), None
        newer, older = self._parts(end)
        if newer <= older:
            move = Move(0, newer, to=self.length)
            return RingIndex(length, end - self.length - newer), move if newer else None
        return RingIndex(length, end - newer - length), Move(newer, older, to=length - older)

    def _has_come_round(self, end: int) -> bool:
        return end - self.origin > self.length

    def _parts(self, end: int) -> tuple[int, int]:
        """How many entries lie before the place of the next one, and how many from there on."""
        newer = self.of(end)
        return newer, self.length - newer
