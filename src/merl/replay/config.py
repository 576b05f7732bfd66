"""What the replay keeps, and whether there is room for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium

from merl.core import MerlError, counted
from merl.core.resources import available_memory, existing_parent, free_disk
from merl.replay.compression import SLOTS_OF_ANY_PICTURE
from merl.replay.storage import fields_of

MOST_N_STEP, MOST_FRAME_STACK = 1000, 100
"""What is still sampled in reasonable time and memory."""


@dataclass(frozen=True)
class ReplayConfig:
    """What the replay keeps and how it is sampled."""

    capacity: int = 1_000_000
    """Steps that are kept; a run that is shorter reserves only its own length."""
    batch_size: int = 256
    """Samples in one update."""
    n_step: int = 3
    """Rewards that are summed before the critic's estimate takes over."""
    frame_stack: int = 3
    """Pictures in a row that make one observation."""
    discount: float = 0.99
    """What a reward is worth one step later (gamma), from 0 to 1."""
    compress: bool = False
    """Keep pictures compressed, without loss, in a quarter of the space; sampling takes longer.
    Pictures of a real camera, which have noise, need more: then fewer steps are kept."""

    def __post_init__(self) -> None:
        for name in ("capacity", "batch_size", "n_step", "frame_stack"):
            value = getattr(self, name)
            if value < 1:
                raise MerlError(
                    f"replay.{name.replace('_', '-')} is {value}: give a whole number of at least 1"
                )
        for name, most in (("n_step", MOST_N_STEP), ("frame_stack", MOST_FRAME_STACK)):
            if getattr(self, name) > most:
                flag = name.replace("_", "-")
                raise MerlError(f"replay.{flag} is {getattr(self, name)}: give at most {most}")
        if not 0 <= self.discount <= 1:
            raise MerlError(f"replay.discount is {self.discount}: give a number from 0 to 1")
        if self.batch_size > self.capacity:
            raise MerlError(
                f"replay.batch-size {self.batch_size} is larger than the replay of "
                f"{counted(self.capacity, 'step')}: give at most {self.capacity}, or more steps"
            )


def replay_bytes(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    capacity: int | None = None,
    rings: int = 1,
) -> int:
    """Bytes that a replay takes, on disk or in memory.

    Args:
        config: what is kept.
        observation_space: see `EpisodeRing`.
        action_space: see `EpisodeRing`.
        capacity: steps, in place of the config's.
        rings: rings that share them.
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
    """Refuse a replay that the disk or the memory cannot hold, before anything is created.

    Even a replay on disk has to fit into memory: one that does not reads the disk for every sample.

    Args:
        config: what is kept.
        observation_space: see `EpisodeRing`.
        action_space: see `EpisodeRing`.
        directory: where it is to lie, or lies already; in memory, if not given.
        capacity: steps, in place of the config's.
        rings: rings that share them.

    Raises:
        MerlError: it does not fit: the message names the largest capacity that would.
    """
    steps = config.capacity if capacity is None else capacity

    def bytes_of(config: ReplayConfig, steps: int) -> int:
        return replay_bytes(config, observation_space, action_space, steps, rings)

    room = {"of memory are available": available_memory()}
    if directory is not None:
        where = existing_parent(directory)
        # Those that are there, if it is opened again.
        ours = sum(file.stat().st_size for file in directory.rglob("*.bin"))
        room[f"of disk are free in {where}"] = free_disk(where) + ours
    what, least = min(room.items(), key=lambda item: item[1])
    if bytes_of(config, steps) > least:
        raise _too_large(config, steps, bytes_of, what, least)


def ring_capacity(steps: int, rings: int) -> int:
    """Steps of one of so many rings that share them."""
    return math.ceil(steps / rings)


def slots_for(config: ReplayConfig, capacity: int) -> int:
    """Timesteps that hold `capacity` steps of episodes of two hundred steps or more.

    An episode has one timestep more than steps, and the oldest step needs its whole stack. Episodes
    that are shorter fill the slots before the capacity is reached. There is always room for one
    step and the beginning of the next episode, even of pictures that no compression makes smaller.
    """
    least = config.frame_stack + 2
    if config.compress:
        least = SLOTS_OF_ANY_PICTURE * (least + 1)  # none reaches across the end of the bytes
    return max(capacity + capacity // 200 + config.frame_stack, least)


def _too_large(
    config: ReplayConfig,
    capacity: int,
    bytes_of: Callable[[ReplayConfig, int], int],
    what: str,
    room: int,
) -> MerlError:
    """The error that names the largest capacity for which there is room."""
    need = bytes_of(config, capacity)
    low, high = 0, capacity  # low fits, high does not
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if bytes_of(config, middle) <= room else (low, middle)
    way_out = f"--replay.capacity {low} would fit" if low else "free some"
    small = bytes_of(replace(config, compress=True), capacity)
    if small < need and small <= room:
        way_out = f"--replay.compress brings it to {small / 1e9:.3g} GB, or {way_out}"
    return MerlError(
        f"a replay of {counted(capacity, 'step')} needs {need / 1e9:.3g} GB, but "
        f"{room / 1e9:.3g} GB {what}: {way_out}"
    )
