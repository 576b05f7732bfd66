"""Evaluation of a trained policy, without exploration noise and from fixed start states."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.generators import kept_generators, seed_global_generators
from merl.acting.rollout import Episode, FrameStack, report_success
from merl.acting.run_env import make_run_env, own_bounds, run_spaces
from merl.agents import make_agent
from merl.config import EvaluationConfig, TrainConfig
from merl.core import Agent, MerlError, NotFinite, Observation, is_image
from merl.core.guards import check_finite
from merl.core.statistics import Interval, bootstrap_interval, wilson_interval
from merl.envs.user_spaces import Modality
from merl.evaluation.recording import EpisodeVideo, warn_user
from merl.evaluation.video import MIN_SIDE
from merl.runs.checkpoint import Checkpoint, load_networks, readable
from merl.runs.run import Run

EVALUATION_SEED = 1_000_000
"""Episode i of every evaluation starts with `env.reset(seed=EVALUATION_SEED + i)`."""

Act = Callable[[Observation], NDArray[np.float32]]


class Policy:
    """A trained agent that acts on single observations; it stacks the frames itself.

    Call `reset()` at the start of each episode, then call the policy with each observation.

    Attributes:
        config: the config of its run.
        step: environment steps at which the policy was saved.
        reports_success: whether the environment was known to report success at that step.
    """

    def __init__(
        self,
        agent: Agent,
        config: TrainConfig,
        space: spaces.Dict,
        device: torch.device,
        step: int = 0,
        run: Run | None = None,
        reports_success: bool = False,
    ) -> None:
        self.config, self.step, self._run = config, step, run
        self.reports_success = reports_success
        self._agent = agent
        self._modalities = {key: _as_trained(key, space[key]) for key in agent.senses}
        images = tuple(key for key in agent.senses if is_image(space[key]))
        self._stack = FrameStack(config.replay.frame_stack, images, device)
        self._fresh = True

    def reset(self) -> None:
        """Start a new episode: discard the stacked frames."""
        self._fresh = True

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Return the action for an observation.

        Args:
            observation: an observation of the environment: images uint8 (H, W, C), vectors float
                (n,).

        Returns:
            The action, float32 (A,), in [-1, 1].

        Raises:
            MerlError: a key is missing, has another shape or type than in training, or cannot be
                converted to an array.
            NotFinite: the observation contains NaN or infinity.
        """
        sensed = {key: self._checked(key, observation) for key in self._modalities}
        if self._fresh:
            self._stack.reset(sensed)
        else:
            self._stack.push(sensed)
        self._fresh = False
        action = self._agent.act(self._stack.observation(), explore=False)[0]
        result: NDArray[np.float32] = action.to("cpu", torch.float32).numpy()
        return result

    def make_env(self, *, trust: bool = False, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment of the run, with the start states of its evaluations.

        Args:
            trust: import the environment that the run names, although you have not trained this run
                on this machine. This runs code of the author of the run. It is not needed for the
                environments of merl and Gymnasium.
            **changes: fields of `EnvConfig`, and `render_mode`; the renderer `auto` is the renderer
                of the training.

        Raises:
            MerlError: the environment is not trusted, cannot be made, or has other spaces than in
                training.
        """
        renderer = changes.get("renderer", self.config.env.renderer)
        if renderer == "auto" and not self.config.own_env:
            renderer = changes["renderer"] = self.config.env.renderer
        if renderer != self.config.env.renderer and not self.config.own_env:
            warnings.warn(
                f"the agent was trained with renderer {self.config.env.renderer!r} but now uses "
                f"{renderer!r}: their images differ, and the agent may perform worse",
                stacklevel=2,
            )
            changes.setdefault("samples", 1)  # the recorded value is for that renderer
        if self._run is not None:
            self._run.load_module(trusted=trust)
        env = make_run_env(self.config.evaluated, **changes)
        if self._run is not None and self.config.own_env:
            try:
                self._run.check_environment(*run_spaces(self.config, env), own_bounds(env))
            except BaseException:
                env.close()
                raise
        return env

    def evaluate(
        self,
        *,
        episodes: int = 10,
        video: Path | None = None,
        renderer: str | None = None,
        max_episode_steps: int | None = None,
        trust: bool = False,
    ) -> Evaluation:
        """Run episodes without noise, from the evaluation's fixed start states.

        Args:
            episodes: number of episodes, at least 1.
            video: record the first episode into this MP4 file.
            renderer: draws the images; None: the renderer of the training.
            max_episode_steps: limit in steps for episodes that do not end earlier; None: as in the
                run.
            trust: see `make_env`.

        Raises:
            MerlError: the environment cannot be made or failed, or the video cannot be written.
            NotFinite: a reward or an observation is NaN or infinite.
        """
        changes: dict[str, Any] = {} if renderer is None else {"renderer": renderer}
        if video is not None:
            size = max(self.config.env.render_size, MIN_SIDE)
            changes |= {"render_mode": "rgb_array", "render_size": size}
        limits = self.config.eval
        if max_episode_steps is not None:
            limits = dataclasses.replace(limits, max_episode_steps=max_episode_steps)
        config = dataclasses.replace(self.config, eval=limits)
        env = self.make_env(trust=trust, **changes)
        try:
            return evaluate(
                self,
                env,
                episodes,
                reset=self.reset,
                video=video,
                max_steps=config.eval_steps,
                reports_success=self.reports_success,
            )
        finally:
            env.close()

    def _checked(self, key: str, observation: Observation) -> NDArray[Any]:
        if not isinstance(observation, Mapping):
            raise MerlError(
                f"the observation is a {type(observation).__name__}: give a dict with the keys "
                f"{list(self._modalities)}"
            )
        if key not in observation:
            raise MerlError(
                f"the observation lacks {key!r}: the agent needs {list(self._modalities)}"
            )
        value = self._modalities[key].convert(observation[key])
        if not np.isfinite(value).all():
            raise NotFinite(f"observation {key!r} contains NaN or infinity: {value}")
        return value


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


def _as_trained(key: str, space: spaces.Space[Any]) -> Modality:
    """Return the check of an observation key that needs no conversion."""
    assert isinstance(space, spaces.Box)
    return Modality(key, space, space)


def load_policy(
    run: str | Path, *, checkpoint: str | int = "latest", threads: int | None = 1
) -> Policy:
    """Load the policy of a run; no code of the run is imported or executed.

    Args:
        run: the folder of the run.
        checkpoint: "latest", "best" (by evaluation return), or the number of steps of a checkpoint.
        threads: CPU threads that compute an action; None uses torch's setting. For a single
            observation, several threads mostly wait for each other. Torch's setting for the rest of
            the program is restored after each action.

    Raises:
        MerlError: there is no run or no complete checkpoint in it, or `threads` is not possible.
    """
    most = os.cpu_count() or 1
    if threads is not None and (type(threads) is not int or not 1 <= threads <= most):
        raise MerlError(
            f"threads is {threads!r}: give None, or an integer from 1 to {most}, the number of "
            "CPUs of this machine"
        )
    opened = Run.open(Path(run))
    saved = Checkpoint.find(opened.checkpoints, str(checkpoint))
    config, device = opened.config, torch.device("cpu")
    if config.device == "cuda" and torch.cuda.is_available():
        device = torch.device("cuda")
    observation_space, action_space = opened.spaces()
    agent = make_agent(
        config.agent,
        observation_space,
        action_space,
        frame_stack=config.replay.frame_stack,
        seed=0,
        device=device,
        threads=threads,
    )
    load_networks(agent.networks, saved)
    with readable(saved):
        reports_success = bool(saved.state()["progress"].get("reports_success", False))
    return Policy(
        agent,
        config,
        observation_space,
        device,
        step=saved.step,
        run=opened,
        reports_success=reports_success,
    )
