"""Replay of several environments: one ring for each, sampled as one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from merl.core import Batch, FrameTransform, FrameTransforms
from merl.replay.config import ReplayConfig, check_fits, ring_capacity
from merl.replay.ring import EpisodeRing


class ReplayBuffer:
    """One ring for each environment, so that each episode is contiguous in its ring.

    Every step in any of the rings is sampled with the same probability.

    Args:
        config: contents of the replay and how it is sampled.
        observation_space: see `EpisodeRing`.
        action_space: see `EpisodeRing`.
        count: number of environments.
        directory: folder of a single ring; several rings are in its folders 0, 1, ...
        capacity: maximum number of steps in all rings together, instead of the config's.

    Attributes:
        rings: the rings, in the order of the environments.

    Raises:
        MerlError: see `EpisodeRing`.
    """

    def __init__(
        self,
        config: ReplayConfig,
        observation_space: gymnasium.spaces.Dict,
        action_space: gymnasium.spaces.Box,
        *,
        count: int = 1,
        directory: Path | None = None,
        capacity: int | None = None,
    ) -> None:
        whole = config.capacity if capacity is None else capacity
        check_fits(
            config,
            observation_space,
            action_space,
            directory=directory,
            capacity=whole,
            rings=count,
        )
        self.rings = [
            EpisodeRing(
                config,
                observation_space,
                action_space,
                directory=directory if directory is None or count == 1 else directory / str(index),
                capacity=ring_capacity(whole, count),
            )
            for index in range(count)
        ]

    def __len__(self) -> int:
        """Return the number of steps that can be sampled."""
        return sum(len(ring) for ring in self.rings)

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        now: FrameTransforms | None = None,
        then: FrameTransforms | None = None,
    ) -> Batch:
        """Draw steps uniformly with replacement; samples of one ring are adjacent.

        Arguments, batch and errors are those of `EpisodeRing.sample`.
        """
        if len(self.rings) == 1 or not len(self):
            return self.rings[0].sample(batch_size, rng, now, then)
        shares = np.array([len(ring) for ring in self.rings]) / len(self)
        counts = rng.multinomial(batch_size, shares)
        firsts = np.cumsum(counts) - counts
        return _joined(
            [
                ring.sample(count, rng, _from(first, now), _from(first, then))
                for ring, count, first in zip(
                    self.rings, counts.tolist(), firsts.tolist(), strict=True
                )
                if count
            ]
        )

    def flush(self) -> None:
        """Write all data to the disk, and return when it is there."""
        for ring in self.rings:
            ring.flush()

    def settle(self) -> None:
        """Confirm that a checkpoint of this state is on disk: older states are not needed."""
        for ring in self.rings:
            ring.settle()

    def state_dict(self) -> dict[str, Any]:
        """Return `EpisodeRing.state_dict()`; with several rings, the states of all."""
        states: list[dict[str, Any]] = [ring.state_dict() for ring in self.rings]
        if len(states) == 1:
            return states[0]
        return {"rings": states, "open": any(state["open"] for state in states)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`; see `EpisodeRing.load_state_dict`.

        Raises:
            MerlError: a ring does not hold the timestep of its state.
        """
        for ring, ring_state in zip(self.rings, state.get("rings", [state]), strict=True):
            ring.load_state_dict(ring_state)


def _from(first: int, transforms: FrameTransforms | None) -> FrameTransforms | None:
    """Return the frame transforms for the part of the batch that starts at sample `first`."""

    def shifted(transform: FrameTransform) -> FrameTransform:
        return lambda sample, frames, out: transform(first + sample, frames, out)

    return transforms and {key: shifted(transform) for key, transform in transforms.items()}


def _joined(batches: list[Batch]) -> Batch:
    if len(batches) == 1:
        return batches[0]

    def observation(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    return Batch(
        observation([batch.observation for batch in batches]),
        torch.cat([batch.action for batch in batches]),
        torch.cat([batch.reward for batch in batches]),
        torch.cat([batch.discount for batch in batches]),
        observation([batch.next_observation for batch in batches]),
    )
