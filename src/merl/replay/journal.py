"""Journal of the bytes that were overwritten since the last checkpoint, for exact resuming.

The time between two checkpoints is limited in seconds, not in steps, and a save can fail, so no
number of spare slots could keep everything that the last checkpoint needs. So the bytes of a
timestep are copied into the journal before they are overwritten.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError

_HEAD = struct.Struct("<5q")  # ring, timestep, index of the array, first byte, number of bytes
_LOG = logging.getLogger(__name__)


class Journal:
    """Overwritten bytes, in the order in which they were overwritten.

    Args:
        path: file of the journal.
        arrays: the arrays of the replay, by field.

    Raises:
        MerlError: the file cannot be created.
    """

    def __init__(self, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._index = {name: index for index, name in enumerate(arrays)}
        self._arrays = [array.reshape(-1).view(np.uint8) for array in arrays.values()]
        self._is_complete = True
        try:
            # Unbuffered: written data survives if the process is killed.
            self._file = path.open("a+b", buffering=0)
        except OSError as error:
            raise MerlError(f"cannot store a replay in {path.parent}: {error.strerror}") from None

    def keep(self, ring: int, timestep: int, ranges: Iterable[tuple[str, int, int]]) -> None:
        """Record bytes before a timestep overwrites them.

        If the file cannot be written (the disk is full), the journal warns, removes all records,
        and records nothing until the next checkpoint: resuming from the last one loses the
        overwritten timesteps.

        Args:
            ring: number of the ring.
            timestep: number of the timestep that overwrites the bytes.
            ranges: field, first byte and number of bytes of each range.
        """
        if not self._is_complete:
            return
        record = bytearray()
        for name, begin, count in ranges:
            index = self._index[name]
            record += _HEAD.pack(ring, timestep, index, begin, count)
            record += self._arrays[index][begin : begin + count].data
        reason = "the disk is full"
        try:
            whole = self._file.write(record) == len(record)
        except OSError as error:
            whole, reason = False, error.strerror or str(error)
        if not whole:
            self.empty()
            self._is_complete = False
            _LOG.warning(
                "cannot write the replay's journal: %s; until the next checkpoint, resuming loses "
                "the oldest steps of the replay",
                reason,
            )

    def undo(self, timesteps: Sequence[int]) -> None:
        """Restore the bytes that later timesteps than `timesteps`, one per ring, overwrote."""
        for ring, timestep, index, begin, old in reversed(list(self._records())):
            if timestep > timesteps[ring]:
                self._arrays[index][begin : begin + len(old)] = np.frombuffer(old, np.uint8)
        self.empty()

    def empty(self) -> None:
        """Remove all records: the replay is in the state of the last checkpoint."""
        self._file.truncate(0)
        self._is_complete = True

    def _records(self) -> Iterator[tuple[int, int, int, int, memoryview]]:
        """Yield all records, except one that is incomplete because the process died."""
        self._file.seek(0)
        raw, at = memoryview(self._file.read()), 0
        while at + _HEAD.size <= len(raw):
            ring, timestep, index, begin, count = _HEAD.unpack_from(raw, at)
            at += _HEAD.size + count
            if at <= len(raw):
                yield ring, timestep, index, begin, raw[at - count : at]
