"""A user's environment as agents take it: what it gives is checked, what it raises told."""

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

from merl.core import EnvironmentFailed, MerlError, NotFinite, counted, is_image, is_vector

MOST_CHANNELS = 4
"""Of an image whose channels come last; with more, the smaller end has them."""


def adapt(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """An environment in the form that agents take.

    A plain box of numbers becomes `state`, a plain picture `image`; of a `Dict` the images (uint8
    boxes) and vectors (boxes of one axis) stay, with a warning for the rest. A box of finite
    actions is rescaled to [-1, 1]. `info["is_success"]` counts as `success`.

    Raises:
        MerlError: the actions are not a box of finite bounds, or nothing can be sensed.
    """
    for name in ("observation_space", "action_space"):
        if not isinstance(getattr(env, name, None), spaces.Space):
            raise MerlError(f"the environment has no {name}: set it to a gymnasium.spaces.Space")
    actions = env.action_space
    if (
        not isinstance(actions, spaces.Box)
        or len(actions.shape) != 1
        or not np.issubdtype(actions.dtype, np.floating)
    ):
        raise MerlError(
            f"the environment's actions are {actions}: an agent here gives a box of real numbers "
            "(n,)"
        )
    if not np.isfinite([actions.low, actions.high]).all() or (actions.low > actions.high).any():
        raise MerlError(
            f"the environment's actions are {actions}: give them finite bounds, which are scaled "
            "to [-1, 1]"
        )
    return Adapted(env)


class Adapted(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Observations as a `Dict` of images and vectors, actions in [-1, 1].

    Args:
        env: whose observations are a box, or a `Dict` of boxes, and whose actions are a finite box.

    Attributes:
        own_bounds: the environment's bounds of each action, lower and upper.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        given = env.observation_space
        self._plain = None if isinstance(given, spaces.Dict) else _plain_key(given)
        parts = given.spaces if isinstance(given, spaces.Dict) else {str(self._plain): given}
        taken: dict[str, spaces.Space[Any]] = {}
        for key, part in parts.items():
            if not isinstance(key, str):
                raise MerlError(
                    f"the environment's observation has the key {key!r}: name it with a string"
                )
            space = _taken(part)
            if space is None:
                warnings.warn(
                    f"observation {key!r} is not used: {part} is neither an image (uint8, "
                    f"H x W x C) nor a vector (n numbers){_remedy(part)}",
                    stacklevel=1,
                )
            else:
                taken[key] = space
        if not taken:
            raise MerlError(
                f"the environment's observation {given} has neither an image (a uint8 box, "
                f"H x W x C) nor a vector (a box of n numbers){_remedy(given)}: wrap it so that it "
                "has"
            )
        self._spaces = taken
        self.observation_space = spaces.Dict(taken)
        actions = env.action_space
        assert isinstance(actions, spaces.Box)
        self._low, self._high = actions.low.astype(np.float64), actions.high.astype(np.float64)
        self._dtype = actions.dtype
        self.own_bounds = self._low.tolist(), self._high.tolist()
        self.action_space = spaces.Box(-1.0, 1.0, actions.shape, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`.

        Raises:
            EnvironmentFailed: it raised an exception, or gave what is no observation.
        """
        with failing("reset"):
            given = self.env.reset(seed=seed, options=options)
        observation, info = _apart("reset", given, ("observation", "info"))
        return self._adapted(observation), _info(info)

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], Any, bool, bool, Any]:
        """Take an action in [-1, 1]; see `gymnasium.Env.step`.

        Raises:
            NotFinite: the action is no number; the environment is not given it.
            EnvironmentFailed: it raised an exception, or gave what is no step.
        """
        wanted = self._scaled(action)
        with failing("step"):
            given = self.env.step(wanted)
        names = ("observation", "reward", "terminated", "truncated", "info")
        observation, reward, terminated, truncated, info = _apart("step", given, names)
        over = _truth("terminated", terminated), _truth("truncated", truncated)
        return self._adapted(observation), _number("reward", reward), *over, _info(info)

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
        """From [-1, 1] to the environment's own bounds, never beyond them."""
        share = (np.asarray(action, np.float64) + 1.0) / 2.0
        if not np.isfinite(share).all():
            raise NotFinite(f"the action is {action}: the environment is not given it")
        wanted = self._low + share * (self._high - self._low)
        return wanted.clip(self._low, self._high).astype(self._dtype)

    def _adapted(self, observation: Any) -> dict[str, Any]:
        whole = observation if self._plain is None else {self._plain: observation}
        if not isinstance(whole, Mapping):
            raise EnvironmentFailed(
                f"the environment's observation is of {type(whole).__name__}, but its space says a "
                "dict"
            )
        adapted = {}
        for key, space in self._spaces.items():
            if key not in whole:
                raise EnvironmentFailed(
                    f"the environment's observation lacks {key!r}, which its space has"
                )
            adapted[key] = _part(key, space, whole[key])
        return adapted


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
    except (Exception, SystemExit, KeyboardInterrupt) as error:  # drivers do call sys.exit
        if isinstance(error, KeyboardInterrupt) and _ctrl_c_raises():
            raise
        raise EnvironmentFailed(f"the environment's {what} raised {in_one_line(error)}") from error


def _ctrl_c_raises() -> bool:
    """Whether a KeyboardInterrupt is the user's wish; elsewhere it is the environment's own."""
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def in_one_line(error: BaseException) -> str:
    """An exception's kind and text, and where in the user's own code it came from."""
    text = " ".join(str(error).split())
    kind = type(error).__name__
    told = f"{kind}: {text}" if text else kind
    libraries = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib")]
    ours = str(Path(__file__).parents[1])
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith((*libraries, ours, "<")):
            return f"{told} ({Path(frame.filename).name}, line {frame.lineno})"
    return told


def _apart(what: str, given: Any, names: tuple[str, ...]) -> tuple[Any, ...]:
    """What a call must give, as a tuple of so many."""
    if not isinstance(given, tuple) or len(given) != len(names):
        many = counted(len(given), "value") if isinstance(given, tuple) else type(given).__name__
        raise EnvironmentFailed(
            f"the environment's {what} gave {many}: it must return {', '.join(names)}"
        )
    return given


def _number(name: str, value: Any) -> float:
    try:
        return float(np.asarray(value).reshape(()).item())
    except (TypeError, ValueError):
        raise EnvironmentFailed(
            f"the environment's {name} is {value!r}: it must be a number"
        ) from None


def _truth(name: str, value: Any) -> bool:
    try:
        return bool(value)
    except (TypeError, ValueError):
        raise EnvironmentFailed(
            f"the environment's {name} is {value!r}: it must be true or false"
        ) from None


def _info(info: Any) -> dict[str, Any]:
    """`info` with what agents' books are kept of: `success`, and `reward_terms` as numbers."""
    if not isinstance(info, Mapping):
        raise EnvironmentFailed(f"the environment's info is {info!r}: it must be a dict")
    told = dict(info)
    success = told.pop("success", told.get("is_success"))
    if success is not None:
        told["success"] = _truth('info["success"]', success)
    if "reward_terms" in told:
        terms = told["reward_terms"]
        if not isinstance(terms, Mapping):
            raise EnvironmentFailed(
                f'the environment\'s info["reward_terms"] is {terms!r}: it must be a dict of '
                "numbers"
            )
        told["reward_terms"] = {
            str(name): _number(f"reward term {name!r}", value) for name, value in terms.items()
        }
    return told


def _part(key: str, space: spaces.Space[Any], value: Any) -> NDArray[Any]:
    """One modality as its space has it."""
    array = np.asarray(value)
    if is_image(space):
        if array.dtype != np.uint8:
            raise EnvironmentFailed(
                f"observation {key!r} is of {array.dtype}, but its space says uint8: give pixels "
                "from 0 to 255"
            )
        if array.ndim == 2:
            array = array[..., None]
        elif array.shape != space.shape and array.ndim == 3:
            moved = np.moveaxis(array, 0, -1)
            array = moved if moved.shape == space.shape else array
    if array.shape != space.shape:
        raise EnvironmentFailed(
            f"observation {key!r} has shape {array.shape}, but its space says {space.shape}"
        )
    try:
        return array.astype(space.dtype, copy=False)
    except (TypeError, ValueError):
        raise EnvironmentFailed(f"observation {key!r} holds what is no number: {value!r}") from None


def _plain_key(space: spaces.Space[Any]) -> str:
    """The key of an observation that has none."""
    return "image" if space.dtype == np.uint8 and len(space.shape or ()) > 1 else "state"


def _taken(space: spaces.Space[Any]) -> spaces.Box | None:
    """The space as agents know it; None if it is neither image nor vector."""
    if not isinstance(space, spaces.Box):
        return None
    if is_image(space) or (space.dtype == np.uint8 and len(space.shape) == 2):
        shape = (*space.shape, 1) if len(space.shape) == 2 else space.shape
        if shape[0] < shape[2] and shape[0] <= shape[1] and shape[2] > MOST_CHANNELS:
            shape = (*shape[1:], shape[0])
        return spaces.Box(0, 255, shape, np.uint8)
    if is_vector(space) or len(space.shape) == 1:
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
        return spaces.Box(low, high, space.shape, np.float32)
    return None


def _remedy(space: spaces.Space[Any]) -> str:
    """How to have it used, where that is plain."""
    if isinstance(space, spaces.Dict):
        return "; flatten what is nested, as gymnasium.spaces.utils.flatten does"
    if isinstance(space, spaces.Box) and len(space.shape) in (2, 3):
        return "; a picture of real numbers can be given as (255 * x).astype(uint8)"
    return ""
