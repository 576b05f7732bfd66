"""A user's own environment, brought into the form that agents take: any robot, any senses."""

from __future__ import annotations

import inspect
import sys
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import registry
from numpy.typing import NDArray

from merl.core import MerlError, is_image, is_vector, meant
from merl.envs.registration import ENV_IDS

MOST_CHANNELS = 4
"""Of an image; where the first axis has so few and the last more, channels come first."""


def make_own(task: str, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """An environment that merl does not bring along, in the form that agents take.

    Args:
        task: a Gymnasium id (`Pendulum-v1`, `module:Id-v0`), or `module:function`, the function
            being called without arguments, or with `render_mode` if it knows that.
        render_mode: what is asked of it; where it cannot render, it is made without.

    Returns:
        The environment, adapted (`Adapted`).

    Raises:
        MerlError: there is no such environment, or it cannot be learnt in.
    """
    env = _make(task, render_mode)
    if render_mode is not None and not _renders(env):
        env.close()
        env = _make(task, None)
    try:
        return adapt(env)
    except BaseException:
        env.close()
        raise


def module_folder(task: str) -> Path | None:
    """Where Python found the module of `module:function` or `module:Id-v0`; None for a plain id."""
    module, colon, _ = task.partition(":")
    loaded = sys.modules.get(module.partition(".")[0]) if colon else None
    file = getattr(loaded, "__file__", None)
    if file is None:
        return None
    path = Path(file).resolve()
    return path.parent.parent if path.name == "__init__.py" else path.parent


def search_also(folder: Path) -> None:
    """Have Python look for modules in this folder too, after all others."""
    if str(folder) not in sys.path and folder.is_dir():
        sys.path.append(str(folder))


def adapt(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """An environment in the form that agents take.

    A plain box of numbers becomes `state`, a plain picture `image`; of a `Dict` the images (uint8
    boxes) and vectors (boxes of one axis) stay, with a warning for the rest. A box of finite
    actions is rescaled to [-1, 1]. `info["is_success"]` counts as `success`.

    Raises:
        MerlError: the actions are not a box of finite bounds, or nothing can be sensed.
    """
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
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        given = env.observation_space
        self._plain = None if isinstance(given, spaces.Dict) else _plain_key(given)
        parts = given.spaces if isinstance(given, spaces.Dict) else {str(self._plain): given}
        taken: dict[str, spaces.Space[Any]] = {}
        for key, part in parts.items():
            space = _taken(part)
            if space is None:
                warnings.warn(
                    f"observation {key!r} is not used: {part} is neither an image (uint8, "
                    "H x W x C) nor a vector (n numbers)",
                    stacklevel=2,
                )
            else:
                taken[key] = space
        if not taken:
            raise MerlError(
                f"the environment's observation {given} has neither an image (a uint8 box, "
                "H x W x C) nor a vector (a box of n numbers): wrap it so that it has"
            )
        self._spaces = taken
        self.observation_space = spaces.Dict(taken)
        actions = env.action_space
        assert isinstance(actions, spaces.Box)
        self._low, self._high = actions.low.astype(np.float64), actions.high.astype(np.float64)
        self._dtype = actions.dtype
        self.action_space = spaces.Box(-1.0, 1.0, actions.shape, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._adapted(observation), info

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], Any, bool, bool, Any]:
        """Take an action in [-1, 1]; see `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, info = self.env.step(self._scaled(action))
        if "is_success" in info and "success" not in info:
            info = {**info, "success": info["is_success"]}
        over = bool(terminated), bool(truncated)
        return self._adapted(observation), float(reward), *over, info

    def _scaled(self, action: NDArray[np.float32]) -> NDArray[Any]:
        """From [-1, 1] to the environment's own bounds, never beyond them."""
        share = (np.asarray(action, np.float64) + 1.0) / 2.0
        wanted = self._low + share * (self._high - self._low)
        return wanted.clip(self._low, self._high).astype(self._dtype)

    def _adapted(self, observation: Any) -> dict[str, Any]:
        whole = observation if self._plain is None else {self._plain: observation}
        adapted = {}
        for key, space in self._spaces.items():
            if key not in whole:
                raise MerlError(f"the environment's observation lacks {key!r}, which its space has")
            adapted[key] = _part(key, space, whole[key])
        return adapted


def _part(key: str, space: spaces.Space[Any], value: Any) -> NDArray[Any]:
    """One modality as its space has it."""
    array = np.asarray(value)
    if is_image(space):
        if array.dtype != np.uint8:
            raise MerlError(
                f"observation {key!r} is of {array.dtype}, but its space says uint8: give pixels "
                "from 0 to 255"
            )
        if array.shape != space.shape:
            array = array[..., None] if array.ndim == 2 else np.moveaxis(array, 0, -1)
    return array.astype(space.dtype, copy=False)


def _plain_key(space: spaces.Space[Any]) -> str:
    """The key of an observation that has none."""
    return "image" if space.dtype == np.uint8 and len(space.shape or ()) > 1 else "state"


def _taken(space: spaces.Space[Any]) -> spaces.Box | None:
    """The space as agents know it; None if it is neither image nor vector."""
    if not isinstance(space, spaces.Box):
        return None
    if is_image(space) or (space.dtype == np.uint8 and len(space.shape) == 2):
        shape = (*space.shape, 1) if len(space.shape) == 2 else space.shape
        if shape[0] <= MOST_CHANNELS < shape[2]:
            shape = (*shape[1:], shape[0])
        return spaces.Box(0, 255, shape, np.uint8)
    if is_vector(space) or len(space.shape) == 1:
        low, high = space.low.astype(np.float32), space.high.astype(np.float32)
        return spaces.Box(low, high, space.shape, np.float32)
    return None


def _make(task: str, render_mode: str | None) -> gymnasium.Env[Any, Any]:
    module, colon, name = task.partition(":")
    env_id = name if colon else task
    if env_id in ENV_IDS.values():
        known = next(task for task, known in ENV_IDS.items() if known == env_id)
        raise MerlError(f"task {task!r} is merl's own: call it {known}")
    if not colon:
        if task not in registry:
            way = meant(task, [*ENV_IDS, *registry])
            if not way.startswith("did"):
                way = f"choose from {', '.join(ENV_IDS)}, or name a Gymnasium id or module:function"
            raise MerlError(f"task {task!r} is unknown: {way}")
        return _by_id(task, render_mode)
    found = _imported(task, module)
    make = getattr(found, name, None)
    if make is None:
        if name in registry:
            return _by_id(name, render_mode)
        raise MerlError(
            f"task {task!r}: module {module!r} has no function {name!r}, and registers no "
            "environment of that name"
        )
    env = _called(task, make, render_mode)
    if not isinstance(env, gymnasium.Env):
        raise MerlError(f"task {task!r} gave {type(env).__name__}, not a gymnasium.Env")
    return env


def _imported(task: str, module: str) -> ModuleType:
    """The module, from the folder where we are before any other, as `python` would."""
    if not all(part.isidentifier() for part in module.split(".")):
        raise MerlError(f"task {task!r}: write it as my_robot:make_env, for my_robot.py here")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MerlError(
            f"task {task!r}: {error}: call merl where it lies, or name its folder in PYTHONPATH"
        ) from None
    except Exception as error:
        raise MerlError(
            f"task {task!r}: importing {module!r} failed: {type(error).__name__}: {_line(error)}"
        ) from error


def _called(task: str, make: Any, render_mode: str | None) -> Any:
    """What the function gives, told how to render if it knows that."""
    try:
        signature = inspect.signature(make)
        given = {"render_mode": render_mode} if "render_mode" in signature.parameters else {}
        signature.bind(**given)
    except (TypeError, ValueError) as error:
        raise MerlError(
            f"task {task!r}: a function is needed that makes an environment and takes no "
            f"arguments, or render_mode alone ({_line(error)})"
        ) from None
    return make(**given)


def _renders(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether it draws; what it draws with may not be installed."""
    if env.render_mode is None:
        return False
    try:
        env.reset(seed=0)
        picture: Any = env.render()
    except Exception as error:  # whatever a display or a driver may raise
        warnings.warn(f"the environment cannot be filmed: {_line(error)}", stacklevel=2)
        return False
    usable = isinstance(picture, np.ndarray) and picture.dtype == np.uint8
    if not usable or picture.ndim != 3 or picture.shape[2] != 3:
        warnings.warn(
            "the environment cannot be filmed: it does not render uint8 (H, W, 3)", stacklevel=2
        )
        return False
    return True


def _by_id(env_id: str, render_mode: str | None) -> gymnasium.Env[Any, Any]:
    if render_mode is not None:
        try:
            return gymnasium.make(env_id, render_mode=render_mode)
        except Exception:  # it may not know this way to render
            return _by_id(env_id, None)
    try:
        return gymnasium.make(env_id)
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise MerlError(f"task {env_id!r} cannot be made: {_line(error)}") from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
