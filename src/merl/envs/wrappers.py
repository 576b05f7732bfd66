"""Wrapper that converts a user's environment to the form that agents use, and checks its values."""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import EnvironmentFailed, MerlError, NotFinite, counted
from merl.core.signals import Stopped
from merl.core.user_code import in_one_line
from merl.envs.config import UserEnvConfig
from merl.envs.user_spaces import UserKey, action_bounds, advice, brief, is_depth, user_key
from merl.envs.user_values import shown, to_bool, to_info, to_number


def adapt(
    env: gymnasium.Env[Any, Any], config: UserEnvConfig | None = None
) -> gymnasium.Env[Any, Any]:
    """Convert an environment to the form that agents use.

    A plain box of numbers becomes `state`, and a plain image becomes `image`. From a `Dict`, images
    (uint8 boxes), depth images (boxes of distances), vectors (boxes with one axis) and histories
    (boxes with two axes) are kept, and other keys are left out. A box of actions with finite bounds
    is rescaled to [-1, 1]. `info["is_success"]` counts as `success`.

    Args:
        env: the user's environment.
        config: how to interpret its spaces.

    Raises:
        MerlError: the actions are not a box with finite bounds, or no observation can be used.
    """
    for name in ("observation_space", "action_space"):
        if not isinstance(getattr(env, name, None), spaces.Space):
            raise MerlError(f"the environment has no {name}: set it to a gymnasium.spaces.Space")
    return Adapted(env, config or UserEnvConfig())


_LOG = logging.getLogger(__name__)


class Adapted(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment with a `Dict` of images and vectors as observation, and actions in [-1, 1].

    Args:
        env: an environment whose observations are a box or a `Dict`, and whose actions are a box
            with finite bounds.
        config: how to interpret its spaces.

    Attributes:
        keys: the observation keys that agents can use, each with its conversion.
        left_out: the other keys, each with the reason and advice.
        own_bounds: the environment's lower bounds and upper bounds of the actions.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], config: UserEnvConfig) -> None:
        super().__init__(env)
        actions = env.action_space
        self._low, self._high = action_bounds(actions, config.allow_wide_actions)
        self._dtype = actions.dtype
        self.own_bounds = self._low.tolist(), self._high.tolist()
        self.action_space = spaces.Box(-1.0, 1.0, self._low.shape, np.float32)

        given = env.observation_space
        self._plain = None if isinstance(given, spaces.Dict) else _plain_key(given)
        parts = given.spaces if isinstance(given, spaces.Dict) else {str(self._plain): given}
        self.keys: dict[str, UserKey] = {}
        self.left_out: dict[str, str] = {}
        for key, part in parts.items():
            if not isinstance(key, str):
                raise MerlError(
                    f"the environment's observation has the key {key!r}: use a string as key"
                )
            used = user_key(key, part, config.image_layout)
            if used is None:
                self.left_out[key] = f"{brief(part)}: {advice(part)}"
            else:
                self.keys[key] = used
        if not self.keys:
            reasons = [
                reason if self._plain else f"{key!r} is {reason}"
                for key, reason in self.left_out.items()
            ]
            raise MerlError(
                "the environment's observation has neither an image (a uint8 box, H x W x C), nor "
                "a depth image, a vector (a box of n numbers) or a history: "
                f"{'; '.join(reasons) or 'it is an empty Dict'}"
            )
        self.observation_space = spaces.Dict({k: u.modality.space for k, u in self.keys.items()})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`.

        Raises:
            EnvironmentFailed: the environment raised an exception, or returned an invalid
                observation.
        """
        with failing("reset"):
            given = self.env.reset(seed=seed, options=options)
        observation, info = _unpacked("reset", given, ("observation", "info"))
        with failing("observation or info"):
            return self._adapted(observation), to_info(info)

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], Any, bool, bool, Any]:
        """Take an action in [-1, 1]; see `gymnasium.Env.step`.

        Raises:
            MerlError: the action has the wrong shape, and is not sent to the environment.
            NotFinite: the action is not finite, and is not sent to the environment.
            EnvironmentFailed: the environment raised an exception, or returned an invalid value.
        """
        wanted = self._scaled(action)
        with failing("step"):
            given = self.env.step(wanted)
        names = ("observation", "reward", "terminated", "truncated", "info")
        observation, reward, terminated, truncated, info = _unpacked("step", given, names)
        with failing("observation, reward or info"):
            over = to_bool("terminated", terminated), to_bool("truncated", truncated)
            return self._adapted(observation), to_number("reward", reward), *over, to_info(info)

    def render(self) -> Any:
        """See `gymnasium.Env.render`.

        Raises:
            EnvironmentFailed: the environment raised an exception.
        """
        with failing("render"):
            return self.env.render()

    def close(self) -> None:
        """Close the environment; if that fails, warn and continue."""
        close_env(self.env)

    def _scaled(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """Rescale an action from [-1, 1] to the environment's bounds, never beyond them."""
        share = (np.asarray(action, np.float64) + 1.0) / 2.0
        if share.shape != self._low.shape:
            raise MerlError(f"action has shape {share.shape}: it must have {self._low.shape}")
        wanted = (self._low + share * (self._high - self._low)).clip(self._low, self._high)
        scaled: NDArray[Any] = wanted.astype(self._dtype)
        if not (np.isfinite(wanted).all() and np.isfinite(scaled).all()):
            raise NotFinite(
                f"the action is {shown(action)}, rescaled {shown(scaled)}: it is not finite, and "
                "not sent to the environment"
            )
        return scaled

    def _adapted(self, observation: Any) -> dict[str, Any]:
        whole = observation if self._plain is None else {self._plain: observation}
        if not isinstance(whole, Mapping):
            raise EnvironmentFailed(
                f"the environment's observation is a {type(whole).__name__}, but its space is a "
                "Dict"
            )
        for key in self.keys:
            if key not in whole:
                raise EnvironmentFailed(
                    f"the environment's observation lacks {key!r}, which its space has"
                )
        return {key: used.convert(whole[key]) for key, used in self.keys.items()}


def _plain_key(space: spaces.Space[Any]) -> str:
    """Return the key for an observation that is not a `Dict`."""
    shape = space.shape or ()
    if len(shape) - shape.count(1) <= 1:
        return "state"
    if isinstance(space, spaces.Box) and is_depth(space):
        return "depth"
    return "image" if space.dtype == np.uint8 else "history"


def close_env(env: gymnasium.Env[Any, Any]) -> None:
    """Close a user's environment; if that fails, warn and continue."""
    try:
        with failing("close"):
            env.close()
    except MerlError as error:
        _LOG.warning("%s", error)


@contextmanager
def failing(what: str) -> Iterator[None]:
    """Report exceptions of the user's code in one line, with the file and line in that code.

    Raises:
        EnvironmentFailed: naming the call that failed.
    """
    try:
        yield
    except MerlError:
        raise
    except BaseException as error:  # drivers call sys.exit, bindings raise unusual kinds
        own = isinstance(error, Stopped)  # raised by merl's signal handler
        if own or (isinstance(error, KeyboardInterrupt) and _ctrl_c_raises()):
            raise
        raise EnvironmentFailed(f"the environment's {what} raised {in_one_line(error)}") from error


def _ctrl_c_raises() -> bool:
    """Return whether Ctrl-C raises KeyboardInterrupt; else the environment itself raised it."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _unpacked(what: str, given: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    """Check the length of the tuple that a call returned, and return the tuple."""
    if not isinstance(given, tuple) or len(given) != len(names):
        many = counted(len(given), "value") if isinstance(given, tuple) else type(given).__name__
        raise EnvironmentFailed(
            f"the environment's {what} returned {many}: it must return {', '.join(names)}"
        )
    return given
