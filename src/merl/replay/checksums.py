"""Checksums of what a checkpoint covers of the replay, in blocks of timesteps.

Timestep i is in block (i - 1) // BLOCK, and each field of a block has a CRC-32. A checkpoint
covers the timesteps from the oldest to the newest of a ring, so its first and its last block may be
incomplete. Only timesteps that are new since the last call are read, and the first block again if
the ring has overwritten a part of it.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from merl.replay.spec import ReplaySpec, field_name, span_name

BLOCK = 512
"""Timesteps of a block: 11 MB of the paper's images."""


class Covered(TypedDict):
    """What a checkpoint covers of a ring.

    Attributes:
        oldest: the oldest timestep.
        newest: the newest one.
        first: the oldest step that can be sampled.
        sums: the checksums of each field, in the order of the blocks.
    """

    oldest: int
    newest: int
    first: int
    sums: dict[str, list[int]]


@dataclass(frozen=True)
class RingData:
    """The data of the timesteps of one ring.

    Attributes:
        spec: what the replay stores.
        arrays: the arrays of all rings, by field.
        number: number of the ring.
        slots: number of slots of each ring.
    """

    spec: ReplaySpec
    arrays: Mapping[str, NDArray[Any]]
    number: int
    slots: int

    def rows(self, timesteps: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the slots of timesteps in the arrays of all rings."""
        return self.number * self.slots + (timesteps - 1) % self.slots

    def spans_fit(self, name: str, span: str, first: int, last: int) -> bool:
        """Return whether the spans of a field of compressed frames lie within its file."""
        size = self.arrays[name].size
        spans = self.arrays[span][self.rows(np.arange(first, last + 1))]
        in_file = bool(((spans >= 0) & (spans <= size)).all())
        return in_file and spans.sum(axis=1).max() <= size and spans[:, 1].sum() <= size

    def parts(self, name: str, first: int, last: int) -> Iterator[NDArray[Any]]:
        """Yield the bytes of a field from timestep `first` to `last` in contiguous parts."""
        spans = {field_name(key): span_name(key) for key in self.spec.compressed}
        if name not in spans:
            yield from _contiguous(self.arrays[name], self.rows(np.arange(first, last + 1)))
            return
        frames = self.arrays[spans[name]][self.rows(np.arange(first, last + 1))]
        begins, ends = frames[:, 0], frames.sum(axis=1)
        breaks = np.flatnonzero(begins[1:] != ends[:-1]) + 1
        data = self.arrays[name].reshape(-1)
        for begin, end in zip(
            begins[[0, *breaks]].tolist(), ends[[*(breaks - 1), -1]].tolist(), strict=True
        ):
            yield data[begin:end]


def _contiguous(array: NDArray[Any], rows: NDArray[np.int64]) -> Iterator[NDArray[Any]]:
    """Yield array[rows] without a copy; the rows are in order, except at the ring's end."""
    for part in np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1):
        yield array[part[0] : part[-1] + 1]


def ranges(oldest: int, newest: int) -> Iterator[tuple[int, int]]:
    """Yield the first and the last timestep of each block from `oldest` to `newest`."""
    while oldest <= newest:
        last = min(newest, -(-oldest // BLOCK) * BLOCK)
        yield oldest, last
        oldest = last + 1


class Checksums:
    """Checksums of one ring.

    Args:
        data: the data of the ring.
    """

    def __init__(self, data: RingData) -> None:
        self._data = data
        # By the first timestep of a block: the last timestep so far, and the fields' checksums.
        self._known: dict[int, tuple[int, dict[str, int]]] = {}

    def update(self, oldest: int, newest: int) -> dict[str, list[int]]:
        """Return the checksums of the timesteps from `oldest` to `newest`; see `Covered.sums`."""
        known, self._known = self._known, {}
        for first, last in ranges(oldest, newest):
            done, sums = known.get(first, (first - 1, dict.fromkeys(self._data.arrays, 0)))
            if done < last:
                sums = {name: self._add(name, done + 1, last, sum_) for name, sum_ in sums.items()}
            self._known[first] = last, sums
        return {
            name: [sums[name] for _, sums in self._known.values()] for name in self._data.arrays
        }

    def adopt(self, covered: Covered) -> None:
        """Continue with checksums that are known to be right."""
        self._known = {
            first: (last, {name: covered["sums"][name][index] for name in self._data.arrays})
            for index, (first, last) in enumerate(ranges(covered["oldest"], covered["newest"]))
        }

    def differing(self, covered: Covered, after: int) -> Iterator[tuple[str, int, int]]:
        """Yield field, first and last timestep of each block with other checksums.

        Args:
            covered: what a checkpoint covers.
            after: blocks that begin up to this timestep are left out.
        """
        sums = covered["sums"]
        spans = {field_name(key): span_name(key) for key in self._data.spec.compressed}
        for index, (first, last) in enumerate(ranges(covered["oldest"], covered["newest"])):
            if first <= after:
                continue
            others = self._data.arrays.keys() - {*spans, *spans.values()}
            found = self._differing(others, sums, index, first, last)
            # Right frames have right spans: where they lie changes when the replay grows.
            for name, span in spans.items():
                if not self._data.spans_fit(name, span, first, last):
                    found.add(span)
                elif self._differing([name], sums, index, first, last):
                    found |= self._differing([span], sums, index, first, last) or {name}
            yield from ((name, first, last) for name in sorted(found))

    def _differing(
        self,
        names: Iterable[str],
        sums: Mapping[str, list[int]],
        index: int,
        first: int,
        last: int,
    ) -> set[str]:
        """Return the fields whose checksum of a block is not the known one."""
        return {name for name in names if self._add(name, first, last, 0) != sums[name][index]}

    def _add(self, name: str, first: int, last: int, sum_: int) -> int:
        """Return the checksum of a field that ends with timestep `first` - 1, up to `last`."""
        for part in self._data.parts(name, first, last):
            sum_ = zlib.crc32(part.data, sum_)
        return sum_
