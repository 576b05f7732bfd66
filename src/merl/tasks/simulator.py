"""The simulator, imported with care: its version checked, and no OpenGL asked for.

dm_control looks for an OpenGL library while it is imported, and fails where `MUJOCO_GL` names one
that is not there. Physics needs none, so it is imported with OpenGL switched off; a renderer that
wants OpenGL switches it on (`merl.envs.rendering`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version

from merl.core import MerlError

PINS = {"mujoco": "3.17.0", "dm_control": "1.0.50"}
"""The versions that work together; dm_control 1.0.50 fails with mujoco 4 in obscure ways."""


def check_versions() -> None:
    """Make sure that the simulator is the one that the tasks were built on.

    Raises:
        MerlError: a package of `PINS` is missing or has another version.
    """
    for package, wanted in PINS.items():
        try:
            found = version(package)
        except PackageNotFoundError:
            found = "not installed"
        if found != wanted:
            raise MerlError(
                f"merl needs {package} {wanted}, found {found}: pip install '{package}=={wanted}'"
            )


@contextmanager
def opengl_backend(name: str) -> Iterator[None]:
    """Set `MUJOCO_GL` to `name` for as long as something is being imported."""
    before = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = name
    try:
        yield
    finally:
        if before is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = before


check_versions()
with opengl_backend("disabled"):
    pass
