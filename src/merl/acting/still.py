"""Environments in which nothing moves: an agent only imitates, or acts on another machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from merl.acting.environments import Environments, Step
from merl.acting.instances import EnvSpaces
from merl.core import MerlError, Observation

EPISODE = 250
"""Steps of an episode: how often a run logs, and may evaluate and save."""


class StillEnvs(Environments):
    """Environments whose observations and rewards are all 0.

    Args:
        space: the observation space.
        action_space: the action space.
        count: number of environments.
    """

    def __init__(self, space: spaces.Dict, action_space: spaces.Box, count: int) -> None:
        self.count, self.action_shape = count, action_space.shape
        self._zeros: Observation = {
            key: np.zeros(box.shape or (), box.dtype) for key, box in space.spaces.items()
        }
        self._steps = 0

    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """See `Environments`."""
        self._steps = 0  # all episodes begin and end together
        return dict.fromkeys(seeds, self._zeros)

    def receive(self) -> list[Step]:
        """See `Environments`."""
        self._steps += 1
        return [Step(self._zeros, 0.0, False, self._steps == EPISODE, {})] * self.count

    def states(self) -> list[dict[str, Any]]:
        """See `Environments`; there are no random numbers to restore."""
        return [{"bit_generator": None}] * self.count


class StillEnv(gymnasium.Env[Any, Any]):
    """An environment that only has spaces: those of one on another machine, or that cannot be used.

    Args:
        known: the spaces.
        error: raised by `reset`.
    """

    def __init__(self, known: EnvSpaces, error: MerlError | None = None) -> None:
        self.observation_space, self.action_space = known.observation, known.action
        self.own_bounds = known.bounds
        self._error = error or MerlError("this environment only has spaces")

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        """Raise the error."""
        raise self._error
