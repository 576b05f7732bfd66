"""Journal of the timesteps that a ring overwrote since the last checkpoint, for exact resuming.

A ring that has wrapped overwrites its oldest timesteps, although the last checkpoint refers to
them. Before that, each is appended to `overwritten.journal`: the number of the timestep that
replaces it, the fields of its slot, and its compressed images. Once a new checkpoint is on disk,
the file is emptied.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.replay.compression import CompressedPictures
from merl.replay.ring_index import RingIndex

_FILE = "overwritten.journal"
_LOG = logging.getLogger(__name__)


class Journal:
    """Overwritten timesteps, in the order in which they were overwritten.

    Args:
        directory: folder of the ring.
        data: the ring's arrays, (slots, *shape) each.
        ring_index: map from entry number timestep - 1 to its slot.
        pictures: the ring's compressed images, by field.

    Raises:
        MerlError: the file cannot be created.
    """

    def __init__(
        self,
        directory: Path,
        data: Mapping[str, NDArray[Any]],
        ring_index: RingIndex,
        pictures: Mapping[str, CompressedPictures],
    ) -> None:
        self._data, self._ring_index, self._pictures = data, ring_index, pictures
        fields = [("by", "<i8"), *((name, a.dtype, a.shape[1:]) for name, a in data.items())]
        self._row = np.zeros(1, np.dtype(fields))  # without padding, as in the file
        self._is_complete = True
        try:
            # Unbuffered: written data survives if the process is killed.
            self._file = (directory / _FILE).open("a+b", buffering=0)
        except OSError as error:
            raise MerlError(f"cannot store a replay in {directory}: {error.strerror}") from None

    def keep(self, slot: int, by: int) -> None:
        """Record the contents of a slot, before timestep number `by` overwrites it.

        If the file cannot be written (the disk is full), the journal warns once and records nothing
        until the next checkpoint: resuming from the last one loses the overwritten timesteps.
        """
        if not self._is_complete:
            return
        row = self._row[0]
        row["by"] = by
        for name, array in self._data.items():
            row[name] = array[slot]
        record = self._row.tobytes() + b"".join(p.read(slot) for p in self._pictures.values())
        end = self._file.seek(0, os.SEEK_END)
        try:
            whole = self._file.write(record) == len(record)
            reason = "the disk is full"
        except OSError as error:
            whole, reason = False, error.strerror or str(error)
        if not whole:
            self._file.truncate(end)
            self._is_complete = False
            _LOG.warning(
                "cannot write the replay's journal: %s; until the next checkpoint, resuming loses "
                "the oldest steps of the replay",
                reason,
            )

    def holds(self, timestep: int) -> bool:
        """Return whether a timestep was overwritten and can be restored."""
        return any(row["timestep"] == timestep for row, _ in self._records())

    def undo(self, timesteps: int) -> None:
        """Restore what the timesteps after number `timesteps` have overwritten, newest first."""
        for row, pictures in reversed(list(self._records())):
            if row["by"] > timesteps:
                slot = self._ring_index.of(int(row["timestep"]) - 1)
                for name, array in self._data.items():
                    array[slot] = row[name]
                for name, kept in pictures.items():
                    self._pictures[name].restore(slot, kept)
        self.empty()

    def empty(self) -> None:
        """Remove all records: the ring is in the state of the last checkpoint."""
        self._file.truncate(0)
        self._is_complete = True

    def _records(self) -> Iterator[tuple[Any, dict[str, bytes]]]:
        """Yield all records, except one that is incomplete because the process died."""
        self._file.seek(0)
        raw = self._file.read()
        at, size = 0, self._row.nbytes
        while at + size <= len(raw):
            row = np.frombuffer(raw, self._row.dtype, 1, at)[0]
            at += size
            pictures = {}
            for name in self._pictures:
                count = int(row[f"{name}.span"][1])
                pictures[name] = raw[at : at + count]
                at += count
            if at <= len(raw):
                yield row, pictures
