"""Config of the replay, its size in bytes, and checks of free disk space and memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import gymnasium

from merl.core import MerlError, counted
from merl.core.fields import Range, check_fields
from merl.core.resources import available_memory, existing_parent, free_disk
from merl.replay.compression import SLOTS_OF_ANY_PICTURE
from merl.replay.storage import fields_of


@dataclass(frozen=True)
class ReplayConfig:
    """Contents of the replay and how it is sampled."""

    capacity: Annotated[int, Range(1)] = 1_000_000
    """Maximum number of steps in the replay; a shorter run reserves only its own length."""
    batch_size: Annotated[int, Range(1)] = 256
    """Samples per update."""
    n_step: Annotated[int, Range(1, 1000)] = 3
    """Number of rewards that are summed before the critic's estimate (n-step return)."""
    frame_stack: Annotated[int, Range(1, 100)] = 3
    """Number of consecutive images in one observation."""
    discount: Annotated[float, Range(0, 1)] = 0.99
    """Discount factor per step (gamma), from 0 to 1."""
    compress: bool = False
    """Compress images without loss to about a quarter of the space; sampling takes longer. Noisy
    images of a real camera need more space, so that the replay holds fewer steps."""

    def __post_init__(self) -> None:
        check_fields(self, "replay.")
        if self.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.batch_size} is larger than a replay of "
                f"{counted(self.capacity, 'step')}: give at most {self.capacity}, or raise "
                "replay.capacity"
            )


def replay_bytes(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    capacity: int | None = None,
    rings: int = 1,
) -> int:
    """Return the bytes that a replay takes, on disk or in memory.

    Args:
        config: contents of the replay.
        observation_space: see `EpisodeRing`.
        action_space: see `EpisodeRing`.
        capacity: maximum number of steps, instead of the config's.
        rings: number of rings that share these steps.
    """
    steps = config.capacity if capacity is None else capacity
    fields = fields_of(observation_space, action_space, config.compress)
    slot = sum(field.bytes for field in fields.values())
    return slot * rings * slots_for(config, ring_capacity(steps, rings))


def check_fits(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    *,
    directory: Path | None = None,
    capacity: int | None = None,
    rings: int = 1,
) -> None:
    """Reject a replay that does not fit on the disk or in memory, before anything is created.

    A replay on disk must fit into memory too: otherwise every sample reads from the disk.

    Args:
        config: contents of the replay.
        observation_space: see `EpisodeRing`.
        action_space: see `EpisodeRing`.
        directory: folder of the replay, new or existing; None: in memory.
        capacity: maximum number of steps, instead of the config's.
        rings: number of rings that share these steps.

    Raises:
        MerlError: it does not fit; the message names the largest capacity that fits.
    """
    steps = config.capacity if capacity is None else capacity

    def bytes_of(config: ReplayConfig, steps: int) -> int:
        return replay_bytes(config, observation_space, action_space, steps, rings)

    room = {"of memory are available": available_memory()}
    if directory is not None:
        where = existing_parent(directory)
        # An existing replay reuses the bytes of its own files.
        ours = sum(file.stat().st_size for file in directory.rglob("*.bin"))
        room[f"of disk space are free in {where}"] = free_disk(where) + ours
    what, least = min(room.items(), key=lambda item: item[1])
    if bytes_of(config, steps) > least:
        raise _too_large(config, steps, bytes_of, what, least)


def ring_capacity(steps: int, rings: int) -> int:
    """Return the steps of each ring if `rings` rings share `steps`."""
    return math.ceil(steps / rings)


def slots_for(config: ReplayConfig, capacity: int) -> int:
    """Return the number of slots that hold `capacity` steps of episodes of at least 200 steps.

    An episode has one timestep more than steps, and the oldest step needs its whole stack. Shorter
    episodes fill the slots before the capacity is reached. There is always room for one step and
    the start of the next episode, even with incompressible images.
    """
    least = config.frame_stack + 2
    if config.compress:
        least = SLOTS_OF_ANY_PICTURE * (least + 1)  # no image crosses the end of the bytes
    return max(capacity + capacity // 200 + config.frame_stack, least)


def _too_large(
    config: ReplayConfig,
    capacity: int,
    bytes_of: Callable[[ReplayConfig, int], int],
    what: str,
    room: int,
) -> MerlError:
    """Return the error, which names the largest capacity that fits."""
    need = bytes_of(config, capacity)
    low, high = 0, capacity  # low fits, high does not
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if bytes_of(config, middle) <= room else (low, middle)
    way_out = f"--replay.capacity {low} would fit" if low else "free some of it"
    small = bytes_of(replace(config, compress=True), capacity)
    if small < need and small <= room:
        way_out = f"--replay.compress reduces it to {small / 1e9:.3g} GB, or {way_out}"
    return MerlError(
        f"a replay of {counted(capacity, 'step')} needs {need / 1e9:.3g} GB, but "
        f"{room / 1e9:.3g} GB {what}: {way_out}"
    )
