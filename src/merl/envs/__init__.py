"""Gymnasium environments for the tasks, and their renderers.

Importing this package is fast; it loads the simulator when the first environment is made.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

from merl.core import MerlError, suggest
from merl.envs.config import EnvConfig

if TYPE_CHECKING:
    from merl.envs.arm_env import ArmEnv

__all__ = ["EnvConfig", "make_env"]


def make_env(task: str, *, render_mode: str | None = None, **config: Any) -> ArmEnv:
    """Make the environment of a task.

    Args:
        task: a key of `merl.tasks.TASKS`.
        render_mode: with `rgb_array`, `env.render()` returns images.
        **config: the fields of `EnvConfig`: `renderer`, `image_size`, `occluded`, ...

    Returns:
        The environment, not yet reset; see `merl.envs.arm_env.ArmEnv`.

    Raises:
        MerlError: the task or a setting is unknown, the renderer does not work on this machine, or
            the simulator has the wrong version.
    """
    known = [field.name for field in fields(EnvConfig)]
    for name in config:
        if name not in known:
            raise MerlError(f"make_env has no setting {name!r}: {suggest(name, known)}")
    settings = EnvConfig(**config)
    from merl.envs.arm_env import ArmEnv
    from merl.tasks import make_task

    scene = make_task(
        task,
        occluded=settings.occluded,
        starts=settings.start,
        reward=settings.reward,
    )
    return ArmEnv(scene, settings, render_mode)
