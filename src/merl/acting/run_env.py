"""The environment of a run, made from its config, with only the keys that the agent uses."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FilterObservation

from merl.acting.env_checks import refuse_running_statistics
from merl.acting.generators import global_state, set_global_state
from merl.agents.config import ObservationConfig
from merl.agents.networks import observation_spec
from merl.config import TrainConfig
from merl.core import MerlError
from merl.core.signals import handlers_kept
from merl.envs import make_env
from merl.envs.action_repeat import ActionRepeat
from merl.envs.config import OBSERVATION_KINDS, EnvConfig, ObservationKey
from merl.envs.user_env import MakeEnv, make_user_env
from merl.envs.user_spaces import brief
from merl.modalities import ObservationSpec

_LOG = logging.getLogger(__name__)


def make_run_env(
    config: TrainConfig, make: MakeEnv | None = None, **changes: Any
) -> gymnasium.Env[Any, Any]:
    """Make the environment of a run.

    Its observation has only the keys that the agent uses; other keys are not rendered.

    Args:
        config: the config of the run.
        make: makes the environment, in place of `config.task`.
        **changes: fields of `EnvConfig` to change, and `render_mode`.

    Raises:
        MerlError: there is no such environment, or it lacks a key that the agent uses.
    """
    render_mode = changes.pop("render_mode", None)
    env: gymnasium.Env[Any, Any]
    if config.has_user_env:
        changes.pop("render_size", None)
        if changes:
            raise MerlError(
                f"{', '.join(changes)} is for merl's own tasks only: {config.task} sets its own "
                "observations; leave the option out"
            )
        with handlers_kept():
            env = Supervised(make_user_env(config.task, render_mode, config.user_env, make))
        refuse_running_statistics(env)
    else:
        seen = dataclasses.replace(config.env, observations=_asked_for(config.agent, config.env))
        settings = {name: getattr(seen, name) for name in type(seen).__dataclass_fields__}
        env = make_env(config.task, render_mode=render_mode, **settings | changes)
    if config.action_repeat > 1:
        env = ActionRepeat(env, config.action_repeat)
    try:
        consumed, _ = run_spaces(config, env)
    except BaseException:
        env.close()
        raise
    return env if consumed == env.observation_space else FilterObservation(env, tuple(consumed))


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


def run_spec(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> ObservationSpec:
    """Return what the agent of a run observes in its environment."""
    assert isinstance(env.observation_space, spaces.Dict)
    return observation_spec(config.agent, env.observation_space, config.replay.frame_stack)


def run_spaces(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> tuple[spaces.Dict, spaces.Box]:
    """Return the observation keys that the agent uses, with their spaces, and the action space."""
    assert isinstance(env.action_space, spaces.Box)
    return run_spec(config, env).space, env.action_space


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
    def of(cls, config: TrainConfig, env: gymnasium.Env[Any, Any]) -> EnvSpaces:
        """Return the spaces of a run's environment."""
        return cls(*run_spaces(config, env), own_bounds(env))

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


def key_lines(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> list[str]:
    """Describe which observation keys the agent uses, and which it does not use and why.

    Args:
        config: the config of the run.
        env: the environment from `make_run_env`.

    Returns:
        One line each for images, depth images, vectors, histories, keys of the critic alone and
        unused keys, where there are any.
    """
    spec = run_spec(config, env)
    groups: dict[str, list[str]] = {}
    for key, modality in spec.modalities.items():
        group = f"{modality.plural} used"
        if key in spec.privileged:
            group += " by the critic alone"
        groups.setdefault(group, []).append(f"{key} ({modality.describe()})")
    lines = [f"{group}: {', '.join(keys)}" for group, keys in groups.items()]
    left_out = {}
    if env.has_wrapper_attr("left_out"):
        for key, given in env.get_wrapper_attr("keys").items():
            if key in spec.modalities:
                continue
            left_out[key] = "--agent.keys names others"
            if config.agent.keys is None:
                left_out[key] = (
                    f"agent {config.agent_name} uses no {given.modality.plural}, "
                    f"--agent.modalities {given.modality.kind} adds them"
                )
        left_out |= env.get_wrapper_attr("left_out")
    if left_out:
        lines.append("; ".join(f"{key!r} is not used: {why}" for key, why in left_out.items()))
    return lines


def environment_state(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the state of an environment's random generators, as plain types.

    An environment with other generators has different episodes after a resume.

    Returns:
        The state of the environment's `np_random` (`bit_generator` is one of its keys), empty if
        the environment does not use it, and under `globals` the state of the global generators of
        the process.
    """
    state: dict[str, Any] = {}
    # Gymnasium's property `np_random` makes a generator on access; this attribute does not.
    generator = getattr(env.unwrapped, "_np_random", None)
    if isinstance(generator, np.random.Generator):
        state = dict(generator.bit_generator.state)
        try:
            json.dumps(state)
        except TypeError:
            state = {}
    return state | {"globals": global_state()}


def set_environment_state(env: gymnasium.Env[Any, Any], state: Mapping[str, Any] | None) -> None:
    """Restore from `environment_state()`."""
    own = dict(state or {})
    shared = own.pop("globals", None)
    if shared is not None:
        set_global_state(shared)
    if own:
        env.unwrapped.np_random.bit_generator.state = own


def _asked_for(agent: ObservationConfig, env: EnvConfig) -> tuple[ObservationKey, ...]:
    """Return the observations of a Jaco environment that the agent needs.

    These are the keys that the agent names; if it names none, those of the config. `state` is used
    only if it is named, since a real robot cannot measure it.

    Raises:
        MerlError: only `state` is left, and the agent does not name it.
    """
    named = agent.keys
    if named is None:
        named = tuple(
            name
            for name in env.observations
            if OBSERVATION_KINDS[name] in agent.modalities and name != "state"
        )
        if not named and "state" in env.observations:
            raise MerlError(
                f"the agent can use no observation among {sorted(env.observations)}: add "
                "--agent.keys state, or use --agent merl_state, ddpg or sac"
            )
    asked = {*named, *agent.privileged}
    if not asked <= set(OBSERVATION_KINDS):  # the check of the agent config reports this
        return tuple(OBSERVATION_KINDS)
    return tuple(name for name in OBSERVATION_KINDS if name in asked) or env.observations
