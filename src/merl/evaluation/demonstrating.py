"""Record demonstrations: a policy acts, with noise if asked for, and its episodes are written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np

from merl.core import MerlError
from merl.core.guards import check_finite
from merl.demos.episode import Episode, EpisodeRecording
from merl.evaluation.evaluation import Act

ATTEMPTS = 5
"""Episodes that may be tried for each one that is wanted."""
FIRST_SEED = 3_000_000
"""Episode i starts with `env.reset(seed=FIRST_SEED + seed * 100_000 + i)`: evaluations start from
other seeds."""


def record_episodes(
    act: Act,
    env: gymnasium.Env[Any, Any],
    episodes: int,
    *,
    reset: Callable[[], None] = lambda: None,
    noise: float = 0.0,
    seed: int = 0,
    failures: bool = False,
) -> Iterator[Episode]:
    """Run a policy and yield its episodes; those that fail are left out.

    Args:
        act: maps an observation to an action in [-1, 1].
        env: the environment.
        episodes: number of episodes to yield.
        reset: called before each episode.
        noise: standard deviation of Gaussian noise that is added to each action.
        seed: selects the start states and the noise.
        failures: also yield episodes that do not end in success.

    Raises:
        MerlError: too few of the episodes succeed.
        NotFinite: a reward or an observation is NaN or infinite.
    """
    kept = tried = 0
    while kept < episodes:
        if tried == ATTEMPTS * episodes:
            raise MerlError(
                f"only {kept} of {tried} episodes succeeded: record failures too (--failures), or "
                "use less noise"
            )
        episode = _episode(act, env, reset, noise, FIRST_SEED + 100_000 * seed + tried)
        tried += 1
        if failures or episode.success is not False:
            kept += 1
            yield episode


def _episode(
    act: Act, env: gymnasium.Env[Any, Any], reset: Callable[[], None], noise: float, seed: int
) -> Episode:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    reset()
    recording = EpisodeRecording(observation)
    terminated = truncated = False
    while not (terminated or truncated):
        intended = action = np.asarray(act(observation), np.float32).clip(-1.0, 1.0)
        if noise:
            action = action + rng.normal(0.0, noise, action.shape).astype(np.float32)
        action = action.clip(-1.0, 1.0)
        observation, reward, terminated, truncated, info = env.step(action)
        check_finite(observation, float(reward), len(recording) + 1)
        recording.add(action, intended, observation, float(reward), info)
    return recording.finish(terminated=bool(terminated))
