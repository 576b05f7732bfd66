"""Instances of a run's environment: for training, for evaluations, and one per worker process.

A worker process makes its instance without the config of the agent, so that it need not import
torch: this saves seconds and some 150 MB in each of them.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation

from merl.acting.env_checks import refuse_running_statistics
from merl.core import MerlError
from merl.core.signals import handlers_kept
from merl.envs import make_env
from merl.envs.action_repeat import ActionRepeat
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import MakeEnv, make_user_env
from merl.envs.user_spaces import brief

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class EnvRecipe:
    """The part of a run's config that decides its environment.

    Attributes:
        task: one of merl's tasks, or see `make_user_env`.
        env: settings of merl's tasks.
        user_env: settings of a user's environment.
        action_repeat: environment steps of each action.
        make: makes the environment, in place of `task`.
    """

    task: str
    env: EnvConfig
    user_env: UserEnvConfig
    action_repeat: int
    make: MakeEnv | None = None

    def instance(self, render_mode: str | None = None, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make an environment, with all of its keys.

        Args:
            render_mode: see `gymnasium.Env`.
            **changes: fields of `env` to change.

        Raises:
            MerlError: there is no such environment, or agents cannot learn in it.
        """
        env: gymnasium.Env[Any, Any]
        if self.task in ENV_IDS:
            env = make_env(self.task, render_mode=render_mode, **vars(self.env) | changes)
        else:
            with handlers_kept():
                made = make_user_env(self.task, render_mode, self.user_env, self.make)
            env = Supervised(made)
            refuse_running_statistics(env)
        if self.action_repeat > 1:
            env = ActionRepeat(env, self.action_repeat)
        return env


def with_keys(env: gymnasium.Env[Any, Any], keys: Collection[str]) -> gymnasium.Env[Any, Any]:
    """Return an environment that observes only these keys, where it has them."""
    assert isinstance(env.observation_space, spaces.Dict)
    kept = tuple(key for key in env.observation_space if key in keys)
    return env if len(kept) == len(env.observation_space) else FilterObservation(env, kept)


class Supervised(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper of a user's environment that restores the signal handlers after each call.

    Simulators and drivers may install their own handlers, with which Ctrl-C would have no effect.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        with handlers_kept():
            return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take an action; see `gymnasium.Env.step`."""
        with handlers_kept():
            return self.env.step(action)

    def render(self) -> Any:
        """See `gymnasium.Env.render`."""
        with handlers_kept():
            return self.env.render()

    def close(self) -> None:
        """Close the environment; Ctrl-C stops waiting for it, with a warning."""
        try:
            with handlers_kept():
                self.env.close()
        except KeyboardInterrupt:
            _LOG.warning("closing the environment was interrupted")


def own_bounds(env: gymnasium.Env[Any, Any]) -> tuple[list[float], list[float]] | None:
    """Return lower and upper bounds of the actions before rescaling; None if not rescaled."""
    bounds: tuple[list[float], list[float]] | None = None
    if env.has_wrapper_attr("own_bounds"):
        bounds = env.get_wrapper_attr("own_bounds")
    return bounds


@dataclass(frozen=True)
class EnvSpaces:
    """The spaces of an environment, to compare two instances of it.

    Attributes:
        observation: the observation keys that the agent uses.
        action: the agent's actions, in [-1, 1].
        bounds: lower and upper bounds of the actions before rescaling; None if not rescaled.
    """

    observation: spaces.Dict
    action: spaces.Box
    bounds: tuple[list[float], list[float]] | None

    @classmethod
    def of(cls, env: gymnasium.Env[Any, Any]) -> EnvSpaces:
        """Return the spaces of a run's environment, which has only the keys that it uses."""
        assert isinstance(env.observation_space, spaces.Dict)
        assert isinstance(env.action_space, spaces.Box)
        return cls(env.observation_space, env.action_space, own_bounds(env))

    def check(self, other: EnvSpaces, what: str) -> None:
        """Check that another instance has the same spaces.

        Args:
            other: the spaces of the other instance.
            what: a name of the other instance, for the message.

        Raises:
            MerlError: the spaces differ; the message names each difference.
        """
        mine, theirs = self._parts(), other._parts()
        differs = []
        for name in mine | theirs:
            one, two = mine.get(name), theirs.get(name)
            if one != two:
                differs.append(f"{name} is {_describe(one)} and {_describe(two)}")
        if differs:
            raise MerlError(
                f"two instances of the environment differ, the first one and {what}: "
                f"{'; '.join(differs)}: give all instances the same spaces"
            )

    def _parts(self) -> dict[str, Any]:
        parts: dict[str, Any] = {
            f"observation {key!r}": space for key, space in self.observation.items()
        }
        return parts | {"action": self.action, "the actions' bounds": self.bounds}


def _describe(part: Any) -> str:
    if part is None:
        return "missing"
    if isinstance(part, spaces.Space):
        return brief(part)
    low, high = part
    return f"low {low}, high {high}"
