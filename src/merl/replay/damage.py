"""Damaged parts of a replay on disk: find them by their checksums, and leave out their episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.replay.backgrounds import Backgrounds
from merl.replay.checksums import BLOCK, Checksums, Covered, RingData
from merl.replay.journal import as_bytes, undo_into
from merl.replay.spec import ReplaySpec, field_name, span_name
from merl.replay.storage import open_copy

JOURNAL = "overwritten.journal"
"""Name of the journal in the folder of a replay."""


@dataclass(frozen=True)
class Damage:
    """A block of a file whose checksum is not that of the checkpoint.

    Attributes:
        file: the file.
        field: the name of its array.
        ring: number of the ring.
        first: first timestep of the block.
        last: last timestep of the block.
    """

    file: Path
    field: str
    ring: int
    first: int
    last: int

    def __str__(self) -> str:
        """Return the block in words."""
        block = (self.first - 1) // BLOCK
        steps = f"timesteps {self.first:,} to {self.last:,} of environment {self.ring}"
        return f"{self.file} is damaged in block {block:,} ({steps})"


def find_damage(directory: Path, spec: ReplaySpec, state: Mapping[str, Any]) -> list[Damage]:
    """Compare a replay on disk with the checksums of a checkpoint, and change nothing.

    What was overwritten since the checkpoint is first restored from the journal, in a copy.

    Args:
        directory: folder of the replay.
        spec: what it stores.
        state: from `ReplayBuffer.state_dict`; without `covered`, as of older versions, only the
            sizes of the files are compared.

    Raises:
        MerlError: the replay cannot be opened, or is damaged as a whole.
    """
    storage = open_copy(directory, spec)
    for key, frames in state["starts"].items():
        file = directory / f"{field_name(key)}.starts"
        Backgrounds(spec.keys[key], file).check(int(frames), state.get("start_sums", {}).get(key))
    rings: Sequence[Covered] = state.get("covered", ())
    if not rings:
        return []
    undo_into(as_bytes(storage.arrays), directory / JOURNAL, [ring["newest"] for ring in rings])
    damage = []
    for number, covered in enumerate(rings):
        data = RingData(spec, storage.arrays, number, storage.slots)
        lost = last_lost(data, covered)
        for name, first, last in Checksums(data).differing(covered, lost):
            file = directory / str(storage.slots) / f"{name}.bin"
            damage.append(Damage(file, name, number, first, last))
    return damage


def last_lost(data: RingData, covered: Covered) -> int:
    """Return the last timestep of a checkpoint that newer ones have overwritten; 0 if none is.

    Timesteps are overwritten in their order: first they are marked with 0. An incomplete journal
    has restored some of the oldest.
    """
    timesteps = np.arange(covered["oldest"], covered["newest"] + 1)
    stamps = data.arrays["timestep"][data.rows(timesteps)]
    kept = (stamps != 0) & ((stamps <= timesteps) | ((stamps - timesteps) % data.slots != 0))
    overwritten = ~kept & (stamps != 0)
    kept &= timesteps > timesteps[overwritten].max(initial=0)
    first = int(kept.argmax()) if kept.any() else len(kept)
    return int(timesteps[first - 1]) if first else 0


def leave_out(data: RingData, covered: Covered, damage: Sequence[Damage]) -> tuple[int, int]:
    """Make the timesteps of every episode with damage episodes of their own, without a step.

    Args:
        data: the data of a ring, in which the journal is undone.
        covered: what the checkpoint covers of the ring.
        damage: the damage in the ring.

    Returns:
        The number of episodes and of timesteps that are left out.
    """
    oldest = covered["oldest"]
    timesteps = np.arange(oldest, covered["newest"] + 1)
    rows, bad = data.rows(timesteps), np.zeros(len(timesteps), bool)
    positions = data.arrays["position"][rows]
    for each in damage:
        block = slice(each.first - oldest, each.last - oldest + 1)
        bad[block] = True
        if each.field == "position":
            positions[block] = 1  # unknown: as if the episodes before it and after it were one
        elif each.field == "timestep":
            data.arrays["timestep"][rows[block]] = timesteps[block]
    for key in data.spec.compressed:
        found = np.ones(len(timesteps), bool)
        for each in damage:
            if each.field == span_name(key):
                found[each.first - oldest : each.last - oldest + 1] = False
        data.arrays[span_name(key)][rows] = _repaired(data.arrays[span_name(key)][rows], found)
    episodes = (positions == 0).cumsum()
    out = np.isin(episodes, episodes[bad])
    data.arrays["position"][rows[out]] = 0
    return len(np.unique(episodes[out])), int(out.sum())


def _repaired(spans: NDArray[np.int64], found: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return spans in which frames that are not found have no bytes, after the frame before them.

    So the ring releases them in their order. If no frame is found, none is left to be released.
    """
    if not found.any():
        return np.zeros_like(spans)
    before = np.maximum.accumulate(np.where(found, np.arange(len(found)), -1))
    begins = np.where(before >= 0, spans.sum(axis=1)[before], spans[found][0, 0])
    return np.where(found[:, None], spans, np.stack([begins, np.zeros_like(begins)], axis=1))
