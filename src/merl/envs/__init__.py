"""How an agent sees a task: Gymnasium environments, and the renderers behind them.

Importing this is cheap; the simulator is loaded when the first environment is made.
"""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from merl.core import MerlError
from merl.envs.config import EnvConfig

if TYPE_CHECKING:
    from merl.envs.jaco_env import JacoEnv

__all__ = ["EnvConfig", "make_env"]


def make_env(task: str, *, render_mode: str | None = None, **config: Any) -> JacoEnv:
    """An environment for a task.

    Args:
        task: a name of `merl.tasks.TASKS`.
        render_mode: `rgb_array` for `env.render()` to return pictures.
        **config: the fields of `EnvConfig`: `renderer`, `image_size`, ...

    Returns:
        The environment, not yet reset; see `merl.envs.jaco_env.JacoEnv`.

    Raises:
        MerlError: the task or a setting is unknown, the renderer does not work here, or the
            simulator has the wrong version.
    """
    settings = EnvConfig(**config)
    from merl.envs.jaco_env import JacoEnv
    from merl.tasks import TASKS

    if task not in TASKS:
        close = get_close_matches(task, TASKS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose from {', '.join(TASKS)}"
        raise MerlError(f"task {task!r} is unknown: {hint}")
    return JacoEnv(TASKS[task](), settings, render_mode)
