"""Journal of the bytes that were overwritten since the last two checkpoints, for exact resuming.

The time between two checkpoints is limited in seconds, not in steps, and a save can fail, so no
number of spare slots could keep everything that the last checkpoint needs. So the bytes of a
timestep are copied into the journal before they are overwritten. A new checkpoint begins a new
file and keeps the former one, from which the checkpoint before it can be restored, too.
"""

from __future__ import annotations

import io
import logging
import mmap
import os
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.core.files import append_whole, cause, open_file, remove, reporting

_HEAD = struct.Struct("<5q")  # ring, timestep, index of the array, first byte, number of bytes
_FORMER = ".former"
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
        self._path = path
        self._index = {name: index for index, name in enumerate(arrays)}
        self._arrays = as_bytes(arrays)
        self._is_complete = True
        with reporting(f"cannot store a replay in {path.parent}"):
            self._file = _opened(path)

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
        try:
            append_whole(self._file, record)
        except OSError as error:
            self._stop(error)

    def _stop(self, error: OSError) -> None:
        """Record nothing until the next checkpoint."""
        self._is_complete = False
        with suppress(OSError):  # it takes space, and is of no use without the rest
            self._file.truncate(0)
        _LOG.warning(
            "cannot write the replay's journal: %s; until the next checkpoint, resuming loses "
            "the oldest steps of the replay",
            cause(error),
        )

    def undo(self, timesteps: Sequence[int]) -> None:
        """Restore the bytes that later timesteps than `timesteps`, one per ring, overwrote.

        The records of these bytes are removed.

        Raises:
            MerlError: the journal cannot be read or shortened.
        """
        for file, end in undo_into(self._arrays, self._path, timesteps).items():
            with reporting(f"{file} cannot be written"):
                os.truncate(file, end)
        self._is_complete = True

    def begin_anew(self) -> None:
        """Begin new records after a checkpoint, and keep those since the checkpoint before it."""
        try:
            with suppress(FileNotFoundError):  # only the opening failed, after the last checkpoint
                self._path.replace(self._path.with_suffix(_FORMER))
            file = _opened(self._path)
        except OSError as error:  # then the records continue in the same file, if all are there
            if not self._is_complete:
                self._stop(error)
        else:
            self._file.close()
            self._file, self._is_complete = file, True

    def forget_former(self) -> None:
        """Remove the records for the checkpoint before the last: the arrays have moved."""
        remove(self._path.with_suffix(_FORMER))


def _opened(path: Path) -> io.FileIO:
    """Open the file of a journal, unbuffered: written data survives if the process is killed."""
    return cast(io.FileIO, open_file(path, "a+b", buffering=0))


class _Record(NamedTuple):
    """Overwritten bytes: `old` from byte `begin` of an array; `end`: where the record ends."""

    ring: int
    timestep: int
    array: int
    begin: int
    old: memoryview
    end: int


def as_bytes(arrays: Mapping[str, NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Return the bytes of each array, without a copy."""
    return [array.reshape(-1).view(np.uint8) for array in arrays.values()]


def undo_into(
    arrays: Sequence[NDArray[np.uint8]], path: Path, timesteps: Sequence[int]
) -> dict[Path, int]:
    """Restore bytes of arrays from a journal; see `Journal.undo`.

    Args:
        arrays: the bytes of each array of the replay.
        path: file of the journal; the former one is beside it.
        timesteps: the newest timestep of each ring that is not undone.

    Returns:
        For each file, the end of its records that are still needed.

    Raises:
        MerlError: a file cannot be read.
    """
    ends = {}
    for file in (path, path.with_suffix(_FORMER)):
        try:
            records = list(_records(file, arrays, len(timesteps)))
        except FileNotFoundError:
            continue
        except OSError as error:
            raise MerlError(f"{file} cannot be read: {cause(error)}") from error
        later = [each for each in records if each.timestep > timesteps[each.ring]]
        ends[file] = max((each.end for each in records[: len(records) - len(later)]), default=0)
        for each in reversed(later):
            arrays[each.array][each.begin : each.begin + len(each.old)] = np.frombuffer(
                each.old, np.uint8
            )
    return ends


def _records(path: Path, arrays: Sequence[NDArray[np.uint8]], rings: int) -> Iterator[_Record]:
    """Yield all records, except one that is incomplete because the process died."""
    with open_file(path) as file:
        if not os.fstat(file.fileno()).st_size:
            return
        raw = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    at = 0
    while at + _HEAD.size <= len(raw):
        ring, timestep, index, begin, count = _HEAD.unpack_from(raw, at)
        place = range(arrays[index].size) if 0 <= index < len(arrays) else range(0)
        if not (0 <= ring < rings and timestep > 0 and 0 <= begin <= begin + count <= len(place)):
            _LOG.warning("%s is damaged from byte %s on: the rest is not used", path, f"{at:,}")
            return
        at += _HEAD.size + count
        if at <= len(raw):
            yield _Record(ring, timestep, index, begin, raw[at - count : at], at)
