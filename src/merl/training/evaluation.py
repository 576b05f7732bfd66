"""What an agent has learnt: it acts without noise, from starts that are the same every time."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from merl.agents import make_agent
from merl.core import Agent, MerlError, NotFinite, Observation, is_image
from merl.statistics import Interval, bootstrap_interval, wilson_interval
from merl.training.checkpoint import Checkpoint, load_networks
from merl.training.config import TrainConfig
from merl.training.environment import make_run_env, own_bounds, run_spaces
from merl.training.guards import check_moment
from merl.training.rollout import Episode, FrameStack
from merl.training.run import Run
from merl.training.video import VideoWriter

EVALUATION_SEED = 1_000_000
"""Episode i of every evaluation starts from `env.reset(seed=EVALUATION_SEED + i)`."""

LONGEST = 100_000
"""Steps of an episode of an evaluation, lest one that never ends be waited for."""

Act = Callable[[Observation], NDArray[np.float32]]


class Policy:
    """A trained agent, ready to act on single observations; it stacks the frames itself.

    Call `reset()` at the start of every episode, then the policy with each observation in turn.

    Attributes:
        config: of the run that it comes from.
        step: environment steps after which it was saved.
    """

    def __init__(
        self,
        agent: Agent,
        config: TrainConfig,
        space: spaces.Dict,
        device: torch.device,
        step: int = 0,
        run: Run | None = None,
    ) -> None:
        self.config, self.step, self._run = config, step, run
        self._agent = agent
        self._space = {key: space[key] for key in agent.senses}
        images = tuple(key for key in agent.senses if is_image(space[key]))
        self._stack = FrameStack(config.replay.frame_stack, images, device)
        self._fresh = True

    def reset(self) -> None:
        """Forget the last episode."""
        self._fresh = True

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """The action for an observation.

        Args:
            observation: as the environment gives it: images uint8 (H, W, C), vectors float (n,).

        Returns:
            float32 (A,), in [-1, 1].

        Raises:
            MerlError: a key is missing or has another shape or type than the agent was trained
                with.
            NotFinite: a number of it is none.
        """
        sensed = {key: self._checked(key, observation) for key in self._space}
        if self._fresh:
            self._stack.reset(sensed)
        else:
            self._stack.push(sensed)
        self._fresh = False
        action = self._agent.act(self._stack.observation(), explore=False)[0]
        result: NDArray[np.float32] = action.to("cpu", torch.float32).numpy()
        return result

    def make_env(self, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment that the agent was trained in, with fields of `EnvConfig` changed.

        Args:
            **changes: fields of `EnvConfig` and `render_mode`; the renderer `auto` is that of the
                training.

        Raises:
            MerlError: it cannot be made, or is no longer what the agent was trained in.
        """
        renderer = changes.get("renderer", self.config.env.renderer)
        if renderer == "auto" and not self.config.own_env:
            renderer = changes["renderer"] = self.config.env.renderer
        if renderer != self.config.env.renderer and not self.config.own_env:
            warnings.warn(
                f"the agent was trained with renderer {self.config.env.renderer!r} and sees "
                f"{renderer!r} now: these pictures differ, and it may do worse",
                stacklevel=2,
            )
        env = make_run_env(self.config, **changes)
        if self._run is not None and self.config.own_env:
            try:
                self._run.check_environment(*run_spaces(self.config, env), own_bounds(env))
            except BaseException:
                env.close()
                raise
        return env

    def _checked(self, key: str, observation: Observation) -> NDArray[Any]:
        space = self._space[key]
        if key not in observation:
            raise MerlError(
                f"the observation lacks {key!r}: the agent consumes {list(self._space)}"
            )
        value = np.asarray(observation[key])
        if value.shape != space.shape:
            raise MerlError(f"observation {key!r} has shape {value.shape}: {space.shape} is needed")
        if is_image(space) and value.dtype != np.uint8:
            raise MerlError(
                f"observation {key!r} is of {value.dtype}: pixels from 0 to 255, uint8, are needed"
            )
        try:
            value = value.astype(space.dtype, copy=False)
        except (TypeError, ValueError):
            raise MerlError(f"observation {key!r} holds what is no number") from None
        if not np.isfinite(value).all():
            raise NotFinite(f"observation {key!r} holds a NaN or an infinity: {value}")
        return value


@dataclass(frozen=True)
class Evaluation:
    """What came out of some episodes.

    Attributes:
        episodes: one by one, in the order of their seeds.
        returns: the mean return with its bootstrap interval.
        success_end: the rate of success at the last step, with Wilson's interval; None where the
            environment does not say.
        success_any: likewise, at any step.
        success_share: the mean share of steps that are a success, with its bootstrap interval.
    """

    episodes: tuple[Episode, ...]
    returns: Interval
    success_end: Interval | None
    success_any: Interval | None
    success_share: Interval | None

    def metrics(self) -> dict[str, float]:
        """By name, as they stand in `metrics.csv` (behind `eval/`)."""
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
            told = [episode.terms.get(name, 0.0) for episode in self.episodes]
            values[f"reward/{name}"] = float(np.mean(told))
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
) -> Evaluation:
    """Run episodes from the evaluation's starts.

    Args:
        act: observation to action.
        env: with `render_mode="rgb_array"` if there is to be a video.
        episodes: how many.
        reset: called before each episode.
        video: where to film the first episode.
        tick: called after every step, with the number of the episode; may raise to end it.
        warn: is told if the video cannot be made, and the evaluation goes on without it; without
            `warn` that is an error.
    """
    results = []
    for index in range(episodes):
        reset()
        film = video if index == 0 else None
        try:
            results.append(_run_episode(act, env, index, film, tick))
        except MerlError as error:
            if film is None or warn is None:
                raise
            warn(str(error))
            reset()
            results.append(_run_episode(act, env, index, None, tick))
    return summarize(results)


def summarize(episodes: list[Episode]) -> Evaluation:
    """Means and intervals over episodes."""
    told = [e for e in episodes if e.success is not None]  # the others do not speak of success
    count = len(told)
    return Evaluation(
        tuple(episodes),
        bootstrap_interval([e.total_reward for e in episodes]),
        wilson_interval(sum(bool(e.success) for e in told), count) if told else None,
        wilson_interval(sum(e.successes > 0 for e in told), count) if told else None,
        bootstrap_interval([e.successes / e.length for e in told]) if told else None,
    )


def _run_episode(
    act: Act,
    env: gymnasium.Env[Any, Any],
    index: int,
    video: Path | None,
    tick: Callable[[int], None],
) -> Episode:
    episode, over = Episode(), False
    observation, _ = env.reset(seed=EVALUATION_SEED + index)
    with ExitStack() as stack:
        film = None
        if video is not None:
            fps = env.metadata.get("render_fps", 25)
            film = stack.enter_context(VideoWriter(video, fps=fps))
        while not over:
            observation, reward, terminated, truncated, info = env.step(act(observation))
            check_moment(observation, float(reward), episode.length + 1, "of an evaluation")
            episode.add(float(reward), info)
            over = terminated or truncated
            if episode.length >= LONGEST and not over:
                raise MerlError(
                    f"an episode of the evaluation is not over after {LONGEST:,} steps: give the "
                    "environment a limit, gymnasium.wrappers.TimeLimit"
                )
            if film is not None:
                film.add(np.asarray(env.render()), _caption(episode))
            tick(index)
    return episode


def _caption(episode: Episode) -> dict[str, str | float | bool | int]:
    caption: dict[str, str | float | bool | int] = {
        "step": episode.length,
        "return": episode.total_reward,
    }
    if episode.success is not None:
        caption["success"] = episode.success
    return caption


def load_policy(
    run: str | Path, *, checkpoint: str | int = "latest", threads: int | None = 1
) -> Policy:
    """Load the policy that a run has learnt.

    Args:
        run: the run's folder.
        checkpoint: "latest", "best" (by evaluation return), or a checkpoint's number of steps.
        threads: processor threads that compute an action; None takes torch's own setting. For one
            observation, several threads mostly wait for each other. Torch's setting for the rest
            of the program is restored after each action.

    Raises:
        MerlError: there is no run, or no whole checkpoint in it.
    """
    if threads is not None and (type(threads) is not int or threads < 1):
        raise MerlError(f"threads is {threads!r}: give a whole number, at least 1, or None")
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
    return Policy(agent, config, observation_space, device, step=saved.step, run=opened)
