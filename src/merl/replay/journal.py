"""What a ring overwrote since the last checkpoint, so that a run can go back to it exactly.

A ring that has wrapped overwrites its oldest timesteps, which the last checkpoint still refers to.
Each of these is appended to `overwritten.journal` before: the number of the timestep that takes its
place, the fields of its slot, and its compressed pictures. A checkpoint that is on the disk empties
the file.
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
    """The overwritten timesteps, in the order in which they were.

    Args:
        directory: the ring's.
        data: the ring's arrays, (slots, *shape) each.
        places: where in them entry number timestep - 1 lies.
        pictures: its compressed pictures, by the name of their field.

    Raises:
        MerlError: the file cannot be made.
    """

    def __init__(
        self,
        directory: Path,
        data: Mapping[str, NDArray[Any]],
        ring_index: RingIndex,
        pictures: Mapping[str, CompressedPictures],
    ) -> None:
        self._data, self._places, self._pictures = data, ring_index, pictures
        fields = [("by", "<i8"), *((name, a.dtype, a.shape[1:]) for name, a in data.items())]
        self._row = np.zeros(1, np.dtype(fields))  # without padding: bytes as they lie in the file
        self._kept = True
        try:
            # Unbuffered: what was written survives the process.
            self._file = (directory / _FILE).open("a+b", buffering=0)
        except OSError as error:
            raise MerlError(f"cannot keep a replay in {directory}: {error.strerror}") from None

    def keep(self, slot: int, by: int) -> None:
        """Remember what a slot has, which timestep number `by` is about to overwrite.

        Where that cannot be written (a full disk), it is told once, and what is overwritten until
        the next checkpoint would be missing if the run went back to the last one.
        """
        if not self._kept:
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
            self._kept = False
            _LOG.warning(
                "what the replay overwrites is not kept until the next checkpoint (%s)", reason
            )

    def holds(self, timestep: int) -> bool:
        """Whether a timestep of that number was overwritten, and can be put back."""
        return any(row["timestep"] == timestep for row, _ in self._records())

    def undo(self, timesteps: int) -> None:
        """Put back what timesteps after number `timesteps` have overwritten, the newest first."""
        for row, pictures in reversed(list(self._records())):
            if row["by"] > timesteps:
                slot = self._places.of(int(row["timestep"]) - 1)
                for name, array in self._data.items():
                    array[slot] = row[name]
                for name, kept in pictures.items():
                    self._pictures[name].restore(slot, kept)
        self.empty()

    def empty(self) -> None:
        """Forget all: the ring is as the last checkpoint has it."""
        self._file.truncate(0)
        self._kept = True

    def _records(self) -> Iterator[tuple[Any, dict[str, bytes]]]:
        """All that is kept; one that was cut short, by a process that died, is none."""
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
