"""Checks of a user's environment at the start of a run, for faults that falsify the results."""

from __future__ import annotations

import logging
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


_LOG = logging.getLogger(__name__)


def refuse_running_statistics(env: gymnasium.Env[Any, Any]) -> None:
    """Reject an environment that scales observations or rewards with running statistics.

    Training, evaluation and the loaded policy each have their own instance of the environment, and
    each would scale with different statistics. Frozen statistics (`update_running_mean` is false)
    are accepted.

    Raises:
        MerlError: there are running statistics; the message names the wrapper.
    """
    layers = [layer for layer in _inner_environments(env) if _has_running_statistics(layer)]
    if layers:  # the last one is the innermost: it owns the statistics
        raise MerlError(
            f"the environment is wrapped in {type(layers[-1]).__name__}, whose running statistics "
            "would differ between training, evaluation and the saved policy: remove the wrapper; "
            "--agent.standardize scales the observed vectors with statistics that are saved "
            "with the agent"
        )


def check_instances(env: gymnasium.Env[Any, Any], eval_env: gymnasium.Env[Any, Any]) -> None:
    """Warn if training and evaluation share one object, or if a reset depends on earlier resets.

    The evaluation environment is reset with one seed, with another seed, and with the first seed
    again; it takes no step. The first observations with the same seed differ if a wrapper filters,
    normalises or collects observations across resets, or if the seed does not determine the
    observation (a real robot, or an environment that ignores the seed). State that changes only in
    `step` is not detected.

    Raises:
        MerlError: the environment cannot be reset.
    """
    if env.unwrapped is eval_env.unwrapped:
        _LOG.warning(
            "training and evaluation use the same environment object: each evaluation resets it; "
            "--eval.every 0 trains without evaluations"
        )
    with kept_generators(eval_env):
        first, _, second = (_first_observation(eval_env, seed) for seed in (0, 1, 0))
    differing = [key for key in first if not _equal(first[key], second[key])]
    if differing:
        _LOG.warning(
            "the first observation after resets with the same seed differs in %s: evaluations will "
            "not have the same start states; if a wrapper keeps state across resets, the trained "
            "policy will later get different observations",
            ", ".join(map(repr, differing)),
        )


def _inner_environments(env: Any) -> Iterator[Any]:
    """Yield the environment and all environments inside it, under any attribute name."""
    found, seen = [env], set[int]()
    while found:
        layer = found.pop()
        if id(layer) in seen:
            continue
        seen.add(id(layer))
        yield layer
        found += [part for part in held_by(layer) if _is_environment(part)]


def _is_environment(value: Any) -> bool:
    """Return whether a value is an environment of Gymnasium or of a similar library."""
    if isinstance(value, gymnasium.Env | VectorEnv):
        return True
    return all(callable(getattr(type(value), name, None)) for name in ("reset", "step"))


def _has_running_statistics(layer: Any) -> bool:
    if not getattr(layer, "update_running_mean", True):
        return False
    # Other libraries and users often name the class of their statistics `RunningMeanStd`, too.
    kinds = (kind for value in held_by(layer) for kind in type(value).__mro__)
    return isinstance(layer, NORMALIZERS) or any(
        kind.__name__ == "RunningMeanStd" for kind in kinds
    )


def _first_observation(env: gymnasium.Env[Any, Any], seed: int) -> Mapping[str, Any]:
    seed_global_generators(seed)  # as in an evaluation
    observation: Mapping[str, Any] = env.reset(seed=seed)[0]
    return {key: np.array(value) for key, value in observation.items()}


def _equal(one: Any, other: Any) -> bool:
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
