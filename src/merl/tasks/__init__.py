"""What is solved: each task is a dm_control composer task with named reward terms and success."""

from __future__ import annotations

from collections.abc import Callable

from merl.tasks.simulator import check_versions  # before the tasks: it guards their imports

# isort: split
from merl.tasks.jaco import JacoTask
from merl.tasks.reach_duplo import ReachDuplo

__all__ = ["TASKS", "JacoTask", "ReachDuplo", "check_versions"]

TASKS: dict[str, Callable[[], JacoTask]] = {"reach_duplo": ReachDuplo}
"""Every task by its name."""
