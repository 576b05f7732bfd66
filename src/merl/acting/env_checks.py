"""Checks of a user's environment at the start of a run: what would make its numbers wrong."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import wrappers
from gymnasium.vector import VectorEnv
from gymnasium.wrappers import vector

from merl.acting.generators import held_by, kept_generators, seed_global_generators
from merl.core import MerlError

NORMALIZERS = (
    wrappers.NormalizeObservation,
    wrappers.NormalizeReward,
    vector.NormalizeObservation,
    vector.NormalizeReward,
)


def refuse_running_statistics(env: gymnasium.Env[Any, Any]) -> None:
    """Refuse an environment that scales observations or rewards by running statistics.

    Training, evaluation and the loaded policy each have their own instance of the environment, and
    would each scale by other statistics. Statistics that are frozen (`update_running_mean` is
    false) are accepted.

    Raises:
        MerlError: naming the wrapper.
    """
    layers = [layer for layer in _inner_environments(env) if _has_running_statistics(layer)]
    if layers:  # the innermost one has them, the others hold it
        raise MerlError(
            f"the environment is wrapped in {type(layers[-1]).__name__}, whose running statistics "
            "would differ between training, evaluation and the saved policy: take it off; "
            "--agent.standardize scales the observed vectors with statistics that belong to "
            "the agent"
        )


def check_instances(env: gymnasium.Env[Any, Any], eval_env: gymnasium.Env[Any, Any]) -> None:
    """Warn if training and evaluation share one object, or if starts depend on the past.

    The evaluation's environment is reset with one seed, with another, and with the first again, and
    takes no step. An observation that is filtered, normalised or collected across resets differs
    the second time, and
    so does one that does not follow from the seed (a real robot, an environment that ignores it).
    Statistics that only change in `step` are not seen here.

    Raises:
        MerlError: the environment cannot be reset.
    """
    if env.unwrapped is eval_env.unwrapped:
        warnings.warn(
            "training and evaluation use the same environment object: each evaluation resets it; "
            "--eval.every 0 trains without evaluations",
            stacklevel=1,
        )
    with kept_generators(eval_env):
        first, _, second = (_first_observation(eval_env, seed) for seed in (0, 1, 0))
    differing = [key for key in first if not _equal(first[key], second[key])]
    if differing:
        warnings.warn(
            f"the first observation after resets with the same seed differs in "
            f"{', '.join(map(repr, differing))}: evaluations will not start alike, and a wrapper "
            "that keeps state across resets makes the trained policy see other numbers later",
            stacklevel=1,
        )


def _inner_environments(env: Any) -> Iterator[Any]:
    """The environment and all environments inside it, whatever the attribute is called."""
    found, seen = [env], set[int]()
    while found:
        layer = found.pop()
        if id(layer) in seen:
            continue
        seen.add(id(layer))
        yield layer
        found += [part for part in held_by(layer) if _is_environment(part)]


def _is_environment(value: Any) -> bool:
    """Whether a value is an environment, of Gymnasium or of a library with the same methods."""
    if isinstance(value, gymnasium.Env | VectorEnv):
        return True
    return all(callable(getattr(type(value), name, None)) for name in ("reset", "step"))


def _has_running_statistics(layer: Any) -> bool:
    if not getattr(layer, "update_running_mean", True):
        return False
    # Other libraries and users build such wrappers around a class of this name, too.
    kinds = (kind for value in held_by(layer) for kind in type(value).__mro__)
    return isinstance(layer, NORMALIZERS) or any(
        kind.__name__ == "RunningMeanStd" for kind in kinds
    )


def _first_observation(env: gymnasium.Env[Any, Any], seed: int) -> Mapping[str, Any]:
    seed_global_generators(seed)  # as an evaluation does
    observation: Mapping[str, Any] = env.reset(seed=seed)[0]
    return {key: np.array(value) for key, value in observation.items()}


def _equal(one: Any, other: Any) -> bool:
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
