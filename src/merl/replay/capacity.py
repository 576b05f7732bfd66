"""Check that a replay fits on the disk and in memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from merl.core import MerlError, counted
from merl.core.files import reporting
from merl.core.resources import available_memory, existing_parent, free_disk
from merl.replay.spec import ReplaySpec


def check_fits(spec: ReplaySpec, directory: Path | None = None) -> None:
    """Reject a replay that does not fit on the disk or in memory, before anything is created.

    A replay on disk must fit into memory too: otherwise every sample reads from the disk.

    Args:
        spec: what the replay stores.
        directory: folder of the replay, new or existing; None: in memory.

    Raises:
        MerlError: it does not fit, and the message names the largest capacity that fits; or the
            disk cannot be asked.
    """
    room = {"of memory are available": available_memory()}
    if directory is not None:
        with reporting(f"{directory} cannot be used"):
            if _bytes_in(directory) < spec.bytes:  # needs new files
                where = existing_parent(directory)
                room[f"of disk space are free in {where}"] = free_disk(where)
    what, least = min(room.items(), key=lambda item: item[1])
    if spec.bytes > least:
        raise MerlError(
            f"a replay of {counted(spec.capacity, 'step')} needs {spec.bytes / 1e9:.3g} GB, but "
            f"{least / 1e9:.3g} GB {what}: {_way_out(spec, least)}"
        )


def _bytes_in(directory: Path) -> int:
    """Return the size of the existing replay in a directory."""
    return sum(file.stat().st_size for file in directory.rglob("*.bin"))


def _way_out(spec: ReplaySpec, room: int) -> str:
    """Return what to do: the largest capacity that fits, and compression, if it helps."""
    low, high = 0, spec.capacity  # low fits, high does not
    while high - low > 1:
        middle = (low + high) // 2
        fits = replace(spec, capacity=middle).bytes <= room
        low, high = (middle, high) if fits else (low, middle)
    way_out = f"--replay.capacity {low} would fit" if low else "free some of it"
    small = replace(spec, config=replace(spec.config, compress=True)).bytes
    if small < spec.bytes and small <= room:
        return f"--replay.compress reduces it to {small / 1e9:.3g} GB, or {way_out}"
    return way_out
