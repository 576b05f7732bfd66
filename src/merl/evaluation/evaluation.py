"""Evaluation of a trained policy, without exploration noise and from fixed start states."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.acting.generators import kept_generators, seed_global_generators
from merl.acting.rollout import Episode, report_success
from merl.config import EvaluationConfig
from merl.core import Observation
from merl.core.guards import check_finite
from merl.core.statistics import Interval, bootstrap_interval, wilson_interval
from merl.evaluation.episode_video import EpisodeVideo, warn_user

EVALUATION_SEED = 1_000_000
"""Episode i of every evaluation starts with `env.reset(seed=EVALUATION_SEED + i)`."""

Act = Callable[[Observation], NDArray[np.float32]]


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        episodes: the episodes, in the order of their seeds.
        returns: the mean return with its bootstrap interval.
        success_end: the rate of episodes with success at the last step, with Wilson's interval;
            None if the environment does not report success.
        success_any: the same for success at any step.
        success_share: the mean share of successes among the steps that report success or failure,
            with its bootstrap interval; None if the environment does not report success.
        starts: a digest of the first observation of each episode.
    """

    episodes: tuple[Episode, ...]
    returns: Interval
    success_end: Interval | None
    success_any: Interval | None
    success_share: Interval | None
    starts: tuple[str, ...] = ()

    def starts_as(self, other: Evaluation) -> bool:
        """Return whether the episodes that both evaluations have start with equal observations."""
        return all(mine == its for mine, its in zip(self.starts, other.starts, strict=False))

    def metrics(self) -> dict[str, float]:
        """Return the metrics by name; in `metrics.csv` each name has the prefix `eval/`."""
        values = {"episodes": float(len(self.episodes))}
        named = {
            "return": self.returns,
            "success_end": self.success_end,
            "success_any": self.success_any,
            "success_share": self.success_share,
        }
        for name, interval in named.items():
            if interval is not None:
                values |= {
                    name: interval.mean,
                    f"{name}_low": interval.low,
                    f"{name}_high": interval.high,
                }
        for name in dict.fromkeys(name for episode in self.episodes for name in episode.terms):
            terms = [episode.terms.get(name, 0.0) for episode in self.episodes]
            values[f"reward/{name}"] = float(np.mean(terms))
        return values


def evaluate(
    act: Act,
    env: gymnasium.Env[Any, Any],
    episodes: int,
    *,
    reset: Callable[[], None] = lambda: None,
    video: Path | None = None,
    tick: Callable[[int], None] = lambda episode: None,
    warn: Callable[[str], None] | None = None,
    max_steps: int = EvaluationConfig.max_episode_steps,
    reports_success: bool = False,
) -> Evaluation:
    """Run episodes from the fixed start states of evaluations, and restore random generators.

    Args:
        act: maps an observation to an action.
        env: the environment; for a video it needs `render_mode="rgb_array"`.
        episodes: number of episodes.
        reset: called before each episode.
        video: file for a video of the first episode; None for no video.
        tick: called after every step with the index of the episode; may raise to end the
            evaluation.
        warn: receives warnings; if None, Python warnings are issued. If a video cannot be made,
            `warn` receives the reason; without `warn` that is an error.
        max_steps: limit in steps for episodes that do not end earlier; such an episode is
            truncated with a warning.
        reports_success: whether the environment is known to report success; see `summarize`.

    Raises:
        MerlError: the environment failed, or the video could not be made and `warn` is None.
        NotFinite: a reward or an observation is NaN or infinite.
    """
    results, starts = [], []
    with kept_generators(env):
        for index in range(episodes):
            reset()
            film = EpisodeVideo(video, env, warn) if video is not None and index == 0 else None
            episode, start, ended = _run_episode(act, env, index, film, tick, max_steps)
            results.append(episode)
            starts.append(start)
            if not ended:
                (warn or warn_user)(
                    f"an episode of the evaluation was cut after {max_steps:,} steps and counts as "
                    "truncated: --eval.max-episode-steps sets the limit "
                    "(merl evaluate: --max-episode-steps)"
                )
    summary = summarize(results, reports_success=reports_success)
    return dataclasses.replace(summary, starts=tuple(starts))


def summarize(episodes: list[Episode], *, reports_success: bool = False) -> Evaluation:
    """Compute means and confidence intervals over episodes.

    Args:
        episodes: one or more episodes.
        reports_success: whether the environment is known to report success, so that an episode
            without a report counts as a failure. True in any case if one of these episodes has
            reported success or failure.
    """
    reports, count = reports_success or report_success(episodes), len(episodes)
    return Evaluation(
        tuple(episodes),
        bootstrap_interval([e.total_reward for e in episodes]),
        wilson_interval(sum(bool(e.success) for e in episodes), count) if reports else None,
        wilson_interval(sum(e.successes > 0 for e in episodes), count) if reports else None,
        bootstrap_interval([e.success_share for e in episodes]) if reports else None,
    )


def _run_episode(
    act: Act,
    env: gymnasium.Env[Any, Any],
    index: int,
    film: EpisodeVideo | None,
    tick: Callable[[int], None],
    max_steps: int,
) -> tuple[Episode, str, bool]:
    """Run one episode; return it, a digest of its start, and whether it ended by itself."""
    episode, over = Episode(), False
    seed = EVALUATION_SEED + index
    seed_global_generators(seed)
    observation, _ = env.reset(seed=seed)
    start = _digest(observation)
    try:
        while not over and episode.length < max_steps:
            observation, reward, terminated, truncated, info = env.step(act(observation))
            check_finite(observation, float(reward), episode.length + 1, "of an evaluation")
            episode.add(float(reward), info)
            over = bool(terminated or truncated)
            if film is not None:
                film.add(episode)
            tick(index)
        if film is not None:
            film.close()
    finally:
        if film is not None:
            film.abort()  # no effect on a finished video
    return episode, start, over


def _digest(observation: Observation) -> str:
    digest = hashlib.sha256()
    for key in sorted(observation):
        digest.update(np.ascontiguousarray(observation[key]).tobytes())
    return digest.hexdigest()
