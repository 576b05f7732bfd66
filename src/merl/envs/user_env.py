"""Import and make a user's environment, and convert it to the form that agents use."""

from __future__ import annotations

import importlib
import inspect
import logging
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import registry

from merl.core import MerlError, suggest, user_code
from merl.core.user_code import in_one_line
from merl.envs.config import UserEnvConfig
from merl.envs.install_hints import installing
from merl.envs.registration import ENV_IDS
from merl.envs.wrappers import adapt, close_env, failing

BUNDLED = ("merl.envs.dot:whole", "merl.envs.dot:split")
"""Tasks in the form module:function that are part of merl."""
MakeEnv = Callable[..., gymnasium.Env[Any, Any]]
"""A function without arguments, or with `render_mode` alone, that makes an environment."""
CLOSE = 0.8
"""Minimum similarity at which an unknown id counts as a misspelling of a known one."""


_LOG = logging.getLogger(__name__)


def make_user_env(
    task: str,
    render_mode: str | None = None,
    config: UserEnvConfig | None = None,
    make: MakeEnv | None = None,
) -> gymnasium.Env[Any, Any]:
    """Make an environment that is not part of merl, in the form that agents use.

    Args:
        task: a Gymnasium id (`Pendulum-v1`, `module:Id-v0`), or `module:function`. The function is
            called without arguments, or with `render_mode` if it accepts that. With `make`, only a
            name for messages.
        render_mode: requested render mode; an environment that cannot render is made without it.
        config: how to interpret its spaces.
        make: the function that makes the environment, in place of `task`.

    Returns:
        The environment, wrapped in `Adapted`.

    Raises:
        MerlError: there is no such environment, or agents cannot learn in it.
    """
    env = _make(task, render_mode, make)
    # One without a render mode is kept: making it again would move a robot again.
    if render_mode is not None and env.render_mode is not None and not _renders(env):
        close_env(env)
        env = _make(task, None, make)
    if env.has_wrapper_attr("own_bounds"):
        return env  # it has that form already
    try:
        return adapt(env, config)
    except BaseException:
        close_env(env)
        raise


def task_of(make: MakeEnv) -> tuple[str, MakeEnv | None]:
    """Return the task of a function that makes an environment.

    Returns:
        `module:function` and None if the function can be imported by that name. Otherwise `name()`,
        which a run cannot find again, and the function.
    """
    named = getattr(make, "func", make)  # of a functools.partial
    name = getattr(named, "__qualname__", type(named).__name__)
    module = getattr(make, "__module__", "__main__")
    if module != "__main__" and getattr(sys.modules.get(module), name, None) is make:
        return f"{module}:{name}", None
    return re.sub(r"\W", "", name.rpartition(".")[2]) + "()", make


def imports_code(task: str) -> bool:
    """Return whether making a task's environment runs code from outside merl and Gymnasium."""
    if task in ENV_IDS or task in BUNDLED:
        return False
    if ":" in task:
        return True
    spec = registry.get(task)  # an unregistered id is rejected before any import
    return spec is not None and not str(spec.entry_point).startswith("gymnasium.envs.")


def check_task(task: str) -> None:
    """Check that a name can be a task; import nothing.

    Raises:
        MerlError: it is neither a task of merl nor registered with Gymnasium, and names no module.
    """
    if task in ENV_IDS or ":" in task or task in registry:
        return
    way = installing(task) or suggest(task, [*ENV_IDS, *registry], CLOSE)
    if not way.startswith(("did", "it comes")):
        way = f"choose from {', '.join(ENV_IDS)}, or name a Gymnasium id or module:function"
    raise MerlError(f"task {task!r} is unknown: {way}")


def load_module(task: str, *folders: Path) -> ModuleType:
    """Import the module of `module:function` or `module:Id-v0`; see `user_code.load_module`."""
    if task in BUNDLED:
        return importlib.import_module(task.partition(":")[0])
    module, _, name = task.partition(":")
    return user_code.load_module(task, *folders, advice=installing(name, module))


def _make(task: str, render_mode: str | None, make: Any = None) -> gymnasium.Env[Any, Any]:
    if make is not None:
        if not callable(make):
            raise MerlError(
                f"env is a {type(make).__name__}: give a function that makes it, such as `lambda: "
                "gymnasium.make(...)`, because evaluations need an environment of their own"
            )
        return _checked(task, _call_function(task, make, render_mode))
    if task.endswith("()"):
        raise MerlError(
            f"task {task!r} is a Python function, which the run does not record: pass it again, as "
            "`env` of merl.resume or merl.evaluate (to train from the command line, name it as "
            "module:function)"
        )
    module, colon, name = task.partition(":")
    env_id = name if colon else task
    if env_id in ENV_IDS.values():
        known = next(task for task, known in ENV_IDS.items() if known == env_id)
        raise MerlError(f"task {task!r} is a task of merl: use its name, {known}")
    if not colon:
        check_task(task)
        return _by_id(task, render_mode)
    found = load_module(task)
    make = getattr(found, name, None)
    if make is None:
        if name in registry:
            return _by_id(name, render_mode)
        way = suggest(name, registry, CLOSE)
        raise MerlError(
            f"task {task!r}: module {module!r} has no function {name!r}, and registers no "
            f"environment of that name{f': {way}' if way.startswith('did') else ''}"
        )
    return _checked(task, _call_function(task, make, render_mode))


def _checked(task: str, env: Any) -> gymnasium.Env[Any, Any]:
    if not isinstance(env, gymnasium.Env):
        raise MerlError(f"task {task!r} returned {type(env).__name__}, not a gymnasium.Env")
    return env


def _call_function(task: str, make: Any, render_mode: str | None) -> Any:
    """Call the function with `render_mode` if it accepts that, and return its result."""
    try:
        signature = inspect.signature(make)
        given = {"render_mode": render_mode} if "render_mode" in signature.parameters else {}
        signature.bind(**given)
    except (TypeError, ValueError) as error:
        raise MerlError(
            f"task {task!r} must name a function that returns an environment and takes no "
            f"arguments, or only render_mode ({error})"
        ) from None
    try:
        with failing(f"function {task.partition(':')[2] or task}"):
            return make(**given)
    except MerlError:
        if given.get("render_mode") is None:
            raise
        return _call_function(task, make, None)  # it may not support this render mode


def _renders(env: gymnasium.Env[Any, Any]) -> bool:
    """Return whether the environment renders; packages for rendering may be missing."""
    try:
        with failing("render"):
            env.reset(seed=0)
            image: Any = env.render()
    except MerlError as error:
        _LOG.warning("videos of the environment are not possible: %s", error)
        return False
    usable = isinstance(image, np.ndarray) and image.dtype == np.uint8
    if not usable or image.ndim != 3 or image.shape[2] != 3:
        _LOG.warning(
            "videos of the environment are not possible: render() does not return uint8 (H, W, 3)"
        )
        return False
    return True


def _by_id(env_id: str, render_mode: str | None) -> gymnasium.Env[Any, Any]:
    if render_mode is not None:
        try:
            return gymnasium.make(env_id, render_mode=render_mode)
        except Exception:  # it may not support this render mode
            return _by_id(env_id, None)
    try:
        return gymnasium.make(env_id)
    except ImportError as error:
        newest = _newest_version(env_id)
        way = (
            "install its packages; those of Gymnasium's environments are extras, for example pip "
            'install "gymnasium[mujoco]"'
            if newest == env_id
            else f"use its newest version, {newest}"
        )
        reason = " ".join(str(error).split()).rstrip(".")
        raise MerlError(f"task {env_id!r} cannot be made: {reason}: {way}") from None
    except Exception as error:
        raise MerlError(f"task {env_id!r} cannot be made: {in_one_line(error)}") from error


def _newest_version(env_id: str) -> str:
    """Return the id of the newest registered version of an environment."""
    spec = registry[env_id]
    others = (s for s in registry.values() if (s.namespace, s.name) == (spec.namespace, spec.name))
    return max(others, key=lambda s: s.version or 0).id
