"""Policies of saved runs: loaded from a run folder, they act on single observations."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.instances import own_bounds
from merl.acting.rollout import FrameStack
from merl.acting.run_env import make_run_env, run_spaces
from merl.agents import make_agent
from merl.config import TrainConfig
from merl.core import Agent, MerlError, NotFinite, Observation
from merl.envs.user_env import MakeEnv
from merl.envs.user_spaces import UserKey
from merl.envs.user_values import to_array
from merl.evaluation.evaluation import Evaluation, evaluate
from merl.evaluation.video import MIN_SIDE
from merl.modalities import Modality, modalities_of
from merl.runs.checkpoint import Checkpoint, load_policy_of, readable
from merl.runs.run import Run

_LOG = logging.getLogger(__name__)


class Policy:
    """A trained agent that acts on single observations; it stacks the frames itself.

    Call `reset()` at the start of each episode, then call the policy with each observation.

    Attributes:
        agent: the agent; for merl's own, `agent.networks` is the policy as a torch module.
        config: the config of its run.
        modalities: the modality of each key that the policy uses.
        step: environment steps at which the policy was saved.
        run: its run; None for a policy without a folder.
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
        self.config, self.step, self.run = config, step, run
        self.reports_success = reports_success
        self.agent = agent
        known = modalities_of(space)
        self.modalities = {key: known[key] for key in agent.senses}
        self._stack = FrameStack(self.modalities, config.replay.frame_stack, device)
        self._fresh = True

    def reset(self) -> None:
        """Start a new episode: discard the stacked frames."""
        self._fresh = True

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Return the action for an observation.

        Args:
            observation: an observation of the environment, with the types and shapes of training
                (merl.modalities); images (H, W, C) or (C, H, W).

        Returns:
            The action, float32 (A,), in [-1, 1].

        Raises:
            MerlError: a key is missing, has another shape or type than in training, or cannot be
                converted to an array.
            NotFinite: the observation contains NaN or infinity.
        """
        sensed = {key: checked(key, m, observation) for key, m in self.modalities.items()}
        if self._fresh:
            self._stack.reset(sensed)
        else:
            self._stack.push(sensed)
        self._fresh = False
        action = self.agent.act(self._stack.observation(), explore=False, step=self.step)[0]
        result: NDArray[np.float32] = action.to("cpu", torch.float32).numpy()
        return result

    def make_env(
        self, *, env: MakeEnv | None = None, trust: bool = False, **changes: Any
    ) -> gymnasium.Env[Any, Any]:
        """Make the environment of the run, with the start states of its evaluations.

        Args:
            env: the function that makes the environment, if the run was trained with one; it is
                used in place of the environment that the run names.
            trust: import the environment that the run names, although you have not trained this run
                on this machine. This runs code of the author of the run. It is not needed for the
                environments of merl and Gymnasium.
            **changes: fields of `EnvConfig`, and `render_mode`.

        Raises:
            MerlError: the environment is not trusted, cannot be made, or has other spaces than in
                training.
        """
        renderer = changes.get("renderer", self.config.env.renderer)
        if renderer != self.config.env.renderer and not self.config.has_user_env:
            _LOG.warning(
                "the agent was trained with renderer %r but now uses %r: their images differ, and "
                "the agent may perform worse",
                self.config.env.renderer,
                renderer,
            )
            changes.setdefault("samples", 1)  # the recorded value is for that renderer
        if self.run is not None and env is None:
            self.run.load_module(trusted=trust)
        made = make_run_env(self.config.evaluated, env, **changes)
        if self.run is not None and self.config.has_user_env:
            try:
                self.run.check_environment(*run_spaces(self.config, made), own_bounds(made))
            except BaseException:
                made.close()
                raise
        return made

    def evaluate(
        self,
        *,
        episodes: int = 10,
        video: Path | None = None,
        renderer: str | None = None,
        max_episode_steps: int | None = None,
        env: MakeEnv | None = None,
        wrap: Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]] = lambda made: made,
        trust: bool = False,
        **changes: Any,
    ) -> Evaluation:
        """Run episodes without noise, from the evaluation's fixed start states.

        Args:
            episodes: number of episodes, at least 1.
            video: record the first episode into this MP4 file.
            renderer: draws the images; None: the renderer of the training.
            max_episode_steps: limit in steps for episodes that do not end earlier; None: as in the
                run.
            env: see `make_env`.
            wrap: changes the environment after it was made, e.g. with a wrapper.
            trust: see `make_env`.
            **changes: see `make_env`.

        Raises:
            MerlError: the environment cannot be made or failed, or the video cannot be written.
            NotFinite: a reward or an observation is NaN or infinite.
        """
        if episodes < 1:
            raise MerlError(f"episodes must be at least 1, not {episodes}")
        if renderer is not None:
            changes["renderer"] = renderer
        if video is not None:
            size = max(self.config.env.render_size, MIN_SIDE)
            changes |= {"render_mode": "rgb_array", "render_size": size}
        limits = self.config.eval
        if max_episode_steps is not None:
            limits = dataclasses.replace(limits, max_episode_steps=max_episode_steps)
        config = dataclasses.replace(self.config, eval=limits)
        made = self.make_env(env=env, trust=trust, **changes)
        try:
            return evaluate(
                self,
                wrap(made),
                episodes,
                reset=self.reset,
                video=video,
                max_steps=config.eval_steps,
                reports_success=self.reports_success,
            )
        finally:
            made.close()


def checked(key: str, modality: Modality, observation: Observation) -> NDArray[Any]:
    """Return the value of a key in the form of training.

    Raises:
        MerlError, NotFinite: see `Policy.__call__`.
    """
    if not isinstance(observation, Mapping):
        raise MerlError(
            f"the observation is a {type(observation).__name__}: give a dict with the key {key!r}"
        )
    if key not in observation:
        raise MerlError(f"the observation lacks {key!r}: it has {list(observation)}")
    given = to_array(f"observation {key!r}", observation[key])
    value = UserKey.as_trained(key, modality, given.shape).convert(given)
    if not np.isfinite(value).all():
        raise NotFinite(f"observation {key!r} contains NaN or infinity: {value}")
    return value


def load_policy(
    run: str | Path,
    *,
    checkpoint: str | int = "latest",
    threads: int | None = 1,
    trust: bool = False,
) -> Policy:
    """Load the policy of a run.

    No code of the run is imported or executed, except that of a user's own agent.

    Args:
        run: the folder of the run.
        checkpoint: "latest", "best" (by evaluation return), or the number of steps of a checkpoint.
        threads: CPU threads that compute an action; None uses torch's setting. For a single
            observation, several threads mostly wait for each other. Torch's setting for the rest of
            the program is restored after each action.
        trust: import a user's own agent that the run names, although you have not trained this run
            on this machine. This runs code of the author of the run.

    Raises:
        MerlError: there is no run or no complete checkpoint in it, `threads` is not possible, or
            the run's own agent is not trusted.
    """
    most = os.cpu_count() or 1
    if threads is not None and (type(threads) is not int or not 1 <= threads <= most):
        raise MerlError(
            f"threads is {threads!r}: give None, or an integer from 1 to {most}, the number of "
            "CPUs of this machine"
        )
    opened = Run.open(Path(run)).with_agent(trusted=trust)
    opened.load_encoders(trusted=trust)
    saved = Checkpoint.find(opened.checkpoints, str(checkpoint))
    config, device = opened.config, torch.device("cpu")
    if config.device == "cuda" and torch.cuda.is_available():
        device = torch.device("cuda")
    observation_space, action_space = opened.spaces()
    agent = make_agent(
        config.agent_name,
        config.agent,
        observation_space,
        action_space,
        frame_stack=config.replay.frame_stack,
        seed=0,
        device=device,
        threads=threads,
    )
    load_policy_of(agent, saved)
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
