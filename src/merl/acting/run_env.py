"""The environment of a run, made from its config, with only the keys that the agent uses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
from gymnasium import spaces

from merl.acting.instances import EnvRecipe, with_keys
from merl.agents.config import ObservationConfig
from merl.agents.networks import observation_spec
from merl.config import TrainConfig
from merl.core import MerlError
from merl.envs.config import OBSERVATION_KINDS, EnvConfig, ObservationKey
from merl.envs.user_env import MakeEnv
from merl.modalities import ObservationSpec


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
    if config.has_user_env:
        changes.pop("render_size", None)
        if refused := sorted(changes.keys() - {"render_mode"}):
            raise MerlError(
                f"{', '.join(refused)} is for merl's own tasks only: {config.task} sets its own "
                "observations; leave the option out"
            )
    env = recipe(config, make).instance(**changes)
    try:
        return with_keys(env, run_spec(config, env).modalities)
    except BaseException:
        env.close()
        raise


def recipe(config: TrainConfig, make: MakeEnv | None = None) -> EnvRecipe:
    """Return what decides the environment of a run; `make` as in `make_run_env`."""
    env = config.env
    if not config.has_user_env:
        env = replace(env, observations=_asked_for(config.agent, env))
    return EnvRecipe(config.task, env, config.user_env, config.action_repeat, make)


def run_spec(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> ObservationSpec:
    """Return what the agent of a run observes in its environment."""
    assert isinstance(env.observation_space, spaces.Dict)
    return observation_spec(config.agent, env.observation_space, config.replay.frame_stack)


def run_spaces(config: TrainConfig, env: gymnasium.Env[Any, Any]) -> tuple[spaces.Dict, spaces.Box]:
    """Return the observation keys that the agent uses, with their spaces, and the action space."""
    assert isinstance(env.action_space, spaces.Box)
    return run_spec(config, env).space, env.action_space


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
