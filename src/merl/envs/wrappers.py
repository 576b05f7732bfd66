"""A user's environment in the form that agents take; what it returns is checked."""

from __future__ import annotations

import signal
import sysconfig
import traceback
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import EnvironmentFailed, MerlError, NotFinite, counted
from merl.envs.config import UserEnvConfig
from merl.envs.user_spaces import Modality, action_bounds, advice, brief, modality
from merl.envs.user_values import shown, to_bool, to_info, to_number


def adapt(
    env: gymnasium.Env[Any, Any], config: UserEnvConfig | None = None
) -> gymnasium.Env[Any, Any]:
    """Bring an environment into the form that agents take.

    A plain box of numbers becomes `state`, a plain image `image`; of a `Dict` the images (uint8
    boxes) and vectors (boxes of one axis) stay, the rest is left out. A box of finite actions is
    rescaled to [-1, 1]. `info["is_success"]` counts as `success`.

    Args:
        env: the user's environment.
        config: how its spaces are read.

    Raises:
        MerlError: the actions are not a box of finite bounds, or no observation can be used.
    """
    for name in ("observation_space", "action_space"):
        if not isinstance(getattr(env, name, None), spaces.Space):
            raise MerlError(f"the environment has no {name}: set it to a gymnasium.spaces.Space")
    return Adapted(env, config or UserEnvConfig())


class Adapted(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Observations as a `Dict` of images and vectors, actions in [-1, 1].

    Args:
        env: its observations are a box or a `Dict` of boxes, its actions a finite box.
        config: how its spaces are read.

    Attributes:
        modalities: the observation keys that agents can use, with how each is converted.
        left_out: the other keys, with the reason and the way out.
        own_bounds: the environment's bounds of each action, lower and upper.
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
        self.modalities: dict[str, Modality] = {}
        self.left_out: dict[str, str] = {}
        for key, part in parts.items():
            if not isinstance(key, str):
                raise MerlError(
                    f"the environment's observation has the key {key!r}: name it with a string"
                )
            used = modality(key, part, config.image_layout)
            if used is None:
                self.left_out[key] = f"{brief(part)}: {advice(part)}"
            else:
                self.modalities[key] = used
        if not self.modalities:
            reasons = [
                reason if self._plain else f"{key!r} is {reason}"
                for key, reason in self.left_out.items()
            ]
            raise MerlError(
                "the environment's observation has neither an image (a uint8 box, H x W x C) nor a "
                f"vector (a box of n numbers): {'; '.join(reasons) or 'it is an empty Dict'}"
            )
        self.observation_space = spaces.Dict({k: m.space for k, m in self.modalities.items()})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`.

        Raises:
            EnvironmentFailed: it raised an exception, or returned an invalid observation.
        """
        with failing("reset"):
            given = self.env.reset(seed=seed, options=options)
        observation, info = _apart("reset", given, ("observation", "info"))
        with failing("observation or info"):
            return self._adapted(observation), to_info(info)

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], Any, bool, bool, Any]:
        """Take an action in [-1, 1]; see `gymnasium.Env.step`.

        Raises:
            MerlError: the action has another shape; the environment is not given it.
            NotFinite: the action is not finite; the environment is not given it.
            EnvironmentFailed: it raised an exception, or returned something invalid.
        """
        wanted = self._scaled(action)
        with failing("step"):
            given = self.env.step(wanted)
        names = ("observation", "reward", "terminated", "truncated", "info")
        observation, reward, terminated, truncated, info = _apart("step", given, names)
        with failing("observation, reward or info"):
            over = to_bool("terminated", terminated), to_bool("truncated", truncated)
            return self._adapted(observation), to_number("reward", reward), *over, to_info(info)

    def render(self) -> Any:
        """See `gymnasium.Env.render`.

        Raises:
            EnvironmentFailed: it raised an exception.
        """
        with failing("render"):
            return self.env.render()

    def close(self) -> None:
        """Close it; that it cannot be closed is told, and stops nothing."""
        try:
            with failing("close"):
                self.env.close()
        except MerlError as error:
            warnings.warn(str(error), stacklevel=1)

    def _scaled(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """Rescale from [-1, 1] to the environment's own bounds, never beyond them."""
        share = (np.asarray(action, np.float64) + 1.0) / 2.0
        if share.shape != self._low.shape:
            raise MerlError(f"action has shape {share.shape}: {self._low.shape} is needed")
        wanted = (self._low + share * (self._high - self._low)).clip(self._low, self._high)
        scaled: NDArray[Any] = wanted.astype(self._dtype)
        if not (np.isfinite(wanted).all() and np.isfinite(scaled).all()):
            raise NotFinite(
                f"the action is {shown(action)}, rescaled {shown(scaled)}: the environment is not "
                "given it"
            )
        return scaled

    def _adapted(self, observation: Any) -> dict[str, Any]:
        whole = observation if self._plain is None else {self._plain: observation}
        if not isinstance(whole, Mapping):
            raise EnvironmentFailed(
                f"the environment's observation is of {type(whole).__name__}, but its space says a "
                "dict"
            )
        for key in self.modalities:
            if key not in whole:
                raise EnvironmentFailed(
                    f"the environment's observation lacks {key!r}, which its space has"
                )
        return {key: used.convert(whole[key]) for key, used in self.modalities.items()}


def _plain_key(space: spaces.Space[Any]) -> str:
    """The key of an observation that has none."""
    shape = space.shape or ()
    return "image" if space.dtype == np.uint8 and len(shape) - shape.count(1) > 1 else "state"


@contextmanager
def failing(what: str) -> Iterator[None]:
    """What the user's code raises, in one line with its place there.

    Raises:
        EnvironmentFailed: naming what was called.
    """
    try:
        yield
    except MerlError:
        raise
    except BaseException as error:  # drivers call sys.exit, bindings raise kinds of their own
        if isinstance(error, KeyboardInterrupt) and _ctrl_c_raises():
            raise
        raise EnvironmentFailed(f"the environment's {what} raised {in_one_line(error)}") from error


def _ctrl_c_raises() -> bool:
    """Whether a KeyboardInterrupt is the user's wish; elsewhere it is the environment's own."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def in_one_line(error: BaseException) -> str:
    """An exception's kind and text, and the last place in the user's own files that led to it."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # the exception's own __str__ may fail
        text = ""
    kind = type(error).__name__
    described = f"{kind}: {text}" if text else kind
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if _is_users(frame.filename):
            return f"{described} ({Path(frame.filename).name}, line {frame.lineno})"
    return described


def _is_users(filename: str) -> bool:
    """Whether code is in a file that exists, outside Python, installed packages and merl."""
    path = Path(filename)
    if filename.startswith("<") or not path.is_file():
        return False
    path = path.resolve()
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    libraries = [Path(sysconfig.get_path(name)).resolve() for name in names]
    libraries.append(Path(__file__).resolve().parents[1])
    return not (
        any(path.is_relative_to(library) for library in libraries)
        or {"site-packages", "dist-packages"} & {*path.parts}
    )


def _apart(what: str, given: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    """The tuple that a call returned, checked for its length."""
    if not isinstance(given, tuple) or len(given) != len(names):
        many = counted(len(given), "value") if isinstance(given, tuple) else type(given).__name__
        raise EnvironmentFailed(
            f"the environment's {what} gave {many}: it must return {', '.join(names)}"
        )
    return given
