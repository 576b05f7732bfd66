"""Import a user's modules, named as `module:name`, and report exceptions in their code."""

from __future__ import annotations

import importlib
import sys
import sysconfig
import traceback
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType

from merl.core.errors import MerlError
from merl.core.python_path import set_value, users_value

FORMS = {
    "task": "module:function, for example my_robot:make_env for my_robot.py",
    "agent": "module:Class, for example my_agent:MyAgent for my_agent.py",
    "encoder": "module:Class, for example my_robot:WristEncoder for my_robot.py",
}
"""The expected form of a name, by what the name stands for."""


def load_module(
    named: str, *folders: Path, kind: str = "task", advice: str | None = None
) -> ModuleType:
    """Import the module of `module:name`.

    Args:
        named: the name, with its module.
        folders: folders that are searched first. The folder with the module is appended to
            `sys.path`, so that the module can import its neighbours, while all other imports are
            found where they were before.
        kind: what the name stands for, for messages: a key of `FORMS`.
        advice: how to get a missing module; None: to add its folder to the search path.

    Raises:
        MerlError: there is no such module, or it cannot be imported.
    """
    module = named.partition(":")[0]
    if not all(part.isidentifier() for part in module.split(".")):
        raise MerlError(f"{kind} {named!r}: use {FORMS[kind]}")
    try:
        set_value(users_value())  # the module may start Python processes that need the folder
        any(_load_from(folder, module.partition(".")[0]) for folder in folders)
        return importlib.import_module(module)
    except MerlError:
        raise
    except ModuleNotFoundError as error:
        if not f"{module}.".startswith(f"{error.name}."):
            raise MerlError(
                f"{kind} {named!r}: {module!r} imports {error.name!r}, which is not installed"
            ) from None
        searched = " or ".join([*map(str, folders), "the installed packages"])
        way = advice or "add its folder to PYTHONPATH, or run `merl train` in its folder"
        raise MerlError(f"{kind} {named!r}: {error} in {searched}: {way}") from None
    except Exception as error:
        raise MerlError(
            f"{kind} {named!r}: importing {module!r} failed: {in_one_line(error)}"
        ) from error


def module_folder(named: str) -> Path | None:
    """Return the folder from which the module of `module:name` was loaded.

    Return None for a name without a module, and for an installed module, which Python finds without
    the folder.
    """
    module, colon, _ = named.partition(":")
    file = _file_of(module.partition(".")[0]) if colon else None
    if file is None or {"site-packages", "dist-packages"} & {*file.parts}:
        return None
    return file.parent.parent if file.name == "__init__.py" else file.parent


def _load_from(folder: Path, name: str) -> bool:
    """Load a top-level module or package from a folder, even if another one is installed.

    Returns:
        Whether the folder has the module.

    Raises:
        MerlError: another module of that name is loaded already.
    """
    importlib.invalidate_caches()
    spec = PathFinder.find_spec(name, [str(folder)])
    if spec is None:
        return False
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    if spec.loader is None or spec.origin is None:  # no __init__.py: installed comes first
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
            f"{spec.origin} cannot be imported, because another module is named {name!r} "
            f"({_file_of(name) or 'part of Python'}): rename the file"
        )
    return True


def _file_of(name: str) -> Path | None:
    """Return the file of a loaded module; None if it has none or is not loaded."""
    file = getattr(sys.modules.get(name), "__file__", None)
    return None if file is None else Path(file).resolve()


def reason(error: Exception) -> str:
    """Return the message of a `MerlError`, which is made for the user, or else `in_one_line()`."""
    return str(error) if isinstance(error, MerlError) else in_one_line(error)


def in_one_line(error: BaseException) -> str:
    """Return an exception's type and text, and the last line in the user's files that led to it."""
    try:
        text = " ".join(str(error).split())
    except Exception:  # the exception's own __str__ may fail
        text = ""
    kind = type(error).__name__
    return (f"{kind}: {text}" if text else kind) + place(error)


def place(error: BaseException) -> str:
    """Return the last line in the user's files that led to an exception: " (FILE, line N)"."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if _is_users(frame.filename):
            return f" ({Path(frame.filename).name}, line {frame.lineno})"
    return ""


def _is_users(filename: str) -> bool:
    """Return whether code is in an existing file outside Python, installed packages and merl."""
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
