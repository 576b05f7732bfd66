"""Import the simulator: check its version, and load it without OpenGL.

MuJoCo and dm_control look for an OpenGL library when they are imported. They warn if there is none,
and fail if `MUJOCO_GL` names a missing one. Physics needs no OpenGL, so this module imports both
with OpenGL disabled, unless they are imported already. The OpenGL renderer enables OpenGL in
dm_control later (`merl.rendering.opengl`).
"""

from __future__ import annotations

import importlib
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version

from merl.core import MerlError

PINS = {"mujoco": "3.17.0", "dm_control": "1.0.50"}
"""The versions that work together: with mujoco 4, dm_control 1.0.50 fails with unclear errors."""


def check_versions() -> None:
    """Check that the installed simulator has the supported versions.

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
    """Set environment variables temporarily, while a module that reads them is imported."""
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
    """Suppress dm_control's warnings about unreachable poses; it then draws another pose."""

    def keep(record: logging.LogRecord) -> bool:
        return not record.getMessage().startswith("Failed to converge")

    logger = logging.getLogger("absl")
    logger.addFilter(keep)
    try:
        yield
    finally:
        logger.removeFilter(keep)


check_versions()
with (
    environment(MUJOCO_GL="disabled", DISABLE_RENDER_THREAD_OFFLOADING="1"),
    warnings.catch_warnings(),  # dm_control.composer lets Python show every deprecation
):
    importlib.import_module("mujoco")
    # Render in the calling thread: dm_control's render thread fails if Python exits first.
    importlib.import_module("dm_control._render.executor")
    importlib.import_module("dm_control.composer")
