"""The simulator, imported with care: its version is checked and no OpenGL is asked for.

MuJoCo and dm_control look for an OpenGL library while they are imported; where there is none they
warn, and where `MUJOCO_GL` names one that is missing they fail. Physics needs none, so both are
imported with OpenGL switched off, unless someone else imported them before; the renderer that wants
OpenGL switches dm_control's on (`merl.envs.rendering`).
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version

from merl.core import MerlError

PINS = {"mujoco": "3.17.0", "dm_control": "1.0.50"}
"""The versions that work together: with mujoco 4, dm_control 1.0.50 fails in obscure ways."""


def check_versions() -> None:
    """Make sure that the simulator is the one that the tasks were built on.

    Raises:
        MerlError: a package of `PINS` is missing or has another version.
    """
    for package, wanted in PINS.items():
        try:
            found = version(package)
        except PackageNotFoundError:
            found = "none"
        if found != wanted:
            raise MerlError(
                f"merl needs {package} {wanted}, found {found}: pip install '{package}=={wanted}'"
            )


@contextmanager
def environment(**variables: str) -> Iterator[None]:
    """Set environment variables for as long as something that reads them is imported."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def quiet_inverse_kinematics() -> Iterator[None]:
    """Drop dm_control's warnings of a pose that it cannot reach: it goes on to draw another."""

    def other(record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith("Failed to converge")

    logger = logging.getLogger("absl")
    logger.addFilter(other)
    try:
        yield
    finally:
        logger.removeFilter(other)


check_versions()
with environment(MUJOCO_GL="disabled", DISABLE_RENDER_THREAD_OFFLOADING="1"):
    importlib.import_module("mujoco")
    # Rendering in the calling thread: a thread of dm_control's own fails when Python exits first.
    importlib.import_module("dm_control._render.executor")
