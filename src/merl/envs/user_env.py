"""A user's own environment, brought into the form that agents take: any robot, any senses."""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import registry

from merl.core import MerlError, suggest
from merl.core.python_path import set_value, users_value
from merl.envs.config import UserEnvConfig
from merl.envs.packages import installing
from merl.envs.registration import ENV_IDS
from merl.envs.wrappers import adapt, failing, in_one_line

BUNDLED = ("merl.envs.dot:whole", "merl.envs.dot:split")
"""Tasks in the form module:function that come with merl."""
CLOSE = 0.8
"""How similar an unknown id must be to a known one to be a mistyped form of it."""


def make_user_env(
    task: str, render_mode: str | None = None, config: UserEnvConfig | None = None
) -> gymnasium.Env[Any, Any]:
    """An environment that merl does not bring along, in the form that agents take.

    Args:
        task: a Gymnasium id (`Pendulum-v1`, `module:Id-v0`), or `module:function`, the function
            being called without arguments, or with `render_mode` if it knows that.
        render_mode: what is asked of it; where it cannot render, it is made without.
        config: how its spaces are read.

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
        return adapt(env, config)
    except BaseException:
        env.close()
        raise


def imports_code(task: str) -> bool:
    """Whether making a task's environment runs code that comes neither with merl nor Gymnasium."""
    if task in ENV_IDS or task in BUNDLED:
        return False
    if ":" in task:
        return True
    spec = registry.get(task)  # an id that is not registered is refused before anything is imported
    return spec is not None and not str(spec.entry_point).startswith("gymnasium.envs.")


def module_folder(task: str) -> Path | None:
    """The folder from which the module of `module:function` or `module:Id-v0` was loaded.

    None for a Gymnasium id without a module, and for a module that is installed: Python finds it.
    """
    module, colon, _ = task.partition(":")
    file = _file_of(module.partition(".")[0]) if colon else None
    if file is None or {"site-packages", "dist-packages"} & {*file.parts}:
        return None
    return file.parent.parent if file.name == "__init__.py" else file.parent


def load_module(task: str, *folders: Path) -> ModuleType:
    """Import the module of `module:function` or `module:Id-v0`.

    Args:
        task: names the module.
        folders: where the module is looked for first. The one that has it is appended to
            `sys.path`, so that the module can import its neighbours, and everything else is found
            where it was before.

    Raises:
        MerlError: there is no such module, or it cannot be imported.
    """
    module = task.partition(":")[0]
    if not all(part.isidentifier() for part in module.split(".")):
        raise MerlError(f"task {task!r}: write it as my_robot:make_env, for my_robot.py here")
    try:
        if task not in BUNDLED:
            set_value(users_value())  # it may start Python processes that need the folder
            any(_load_from(folder, module.partition(".")[0]) for folder in folders)
        return importlib.import_module(module)
    except MerlError:
        raise
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise MerlError(
                f"task {task!r}: {module!r} imports {error.name!r}, which is not installed here"
            ) from None
        ring_index = " or ".join([*map(str, folders), "what is installed"])
        way = installing(task.partition(":")[2], module)
        way = way or "name its folder in PYTHONPATH, or call `merl train` where it lies"
        raise MerlError(f"task {task!r}: {error} in {ring_index}: {way}") from None
    except Exception as error:
        raise MerlError(
            f"task {task!r}: importing {module!r} failed: {in_one_line(error)}"
        ) from error


def _load_from(folder: Path, name: str) -> bool:
    """Load a top-level module or package from a folder, whatever is installed.

    Returns:
        Whether the folder has it.

    Raises:
        MerlError: another module of that name is loaded already.
    """
    importlib.invalidate_caches()
    spec = PathFinder.find_spec(name, [str(folder)])
    if spec is None:
        return False
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    if spec.loader is None or spec.origin is None:  # no __init__.py: what is installed comes first
        return False
    if name not in sys.modules:
        module = sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            sys.modules.pop(name, None)
            raise
    elif _file_of(name) != Path(spec.origin).resolve():
        raise MerlError(
            f"{spec.origin} cannot be imported: {name!r} is the name of another module, "
            f"{_file_of(name) or 'of Python itself'}; rename it"
        )
    return True


def _file_of(name: str) -> Path | None:
    """The file of a module that is loaded."""
    file = getattr(sys.modules.get(name), "__file__", None)
    return None if file is None else Path(file).resolve()


def _make(task: str, render_mode: str | None) -> gymnasium.Env[Any, Any]:
    module, colon, name = task.partition(":")
    env_id = name if colon else task
    if env_id in ENV_IDS.values():
        known = next(task for task, known in ENV_IDS.items() if known == env_id)
        raise MerlError(f"task {task!r} is merl's own: call it {known}")
    if not colon:
        if task not in registry:
            way = installing(task) or suggest(task, [*ENV_IDS, *registry], CLOSE)
            if not way.startswith(("did", "it comes")):
                way = f"choose from {', '.join(ENV_IDS)}, or name a Gymnasium id or module:function"
            raise MerlError(f"task {task!r} is unknown: {way}")
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
    env = _called(task, make, render_mode)
    if not isinstance(env, gymnasium.Env):
        raise MerlError(f"task {task!r} gave {type(env).__name__}, not a gymnasium.Env")
    return env


def _called(task: str, make: Any, render_mode: str | None) -> Any:
    """What the function gives, told how to render if it knows that."""
    try:
        signature = inspect.signature(make)
        given = {"render_mode": render_mode} if "render_mode" in signature.parameters else {}
        signature.bind(**given)
    except (TypeError, ValueError) as error:
        raise MerlError(
            f"task {task!r}: a function is needed that makes an environment and takes no "
            f"arguments, or render_mode alone ({error})"
        ) from None
    try:
        with failing(f"function {task.partition(':')[2]}"):
            return make(**given)
    except MerlError:
        if render_mode is None:
            raise
        return _called(task, make, None)  # it may not know this way to render


def _renders(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether it draws; what it draws with may not be installed."""
    if env.render_mode is None:
        return False
    try:
        with failing("render"):
            env.reset(seed=0)
            picture: Any = env.render()
    except MerlError as error:
        warnings.warn(f"the environment cannot be filmed: {error}", stacklevel=1)
        return False
    usable = isinstance(picture, np.ndarray) and picture.dtype == np.uint8
    if not usable or picture.ndim != 3 or picture.shape[2] != 3:
        warnings.warn(
            "the environment cannot be filmed: it does not render uint8 (H, W, 3)", stacklevel=1
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
    except ImportError as error:
        newest = _newest_version(env_id)
        way = (
            "install what it needs; Gymnasium's own come with its extras, as pip install "
            '"gymnasium[mujoco]"'
            if newest == env_id
            else f"take its newest version, {newest}"
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
