"""What is solved: each task is a dm_control composer task with named reward terms and success."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from merl.core import MerlError, meant
from merl.tasks.simulator import check_versions  # before the tasks: it guards their imports

# isort: split
from merl.tasks.jaco import JacoTask
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.reach_duplo import ReachDuplo

__all__ = [
    "OCCLUDED",
    "TASKS",
    "JacoTask",
    "LiftBox",
    "MoveBox",
    "ReachDuplo",
    "check_versions",
    "make_task",
]

TASKS: dict[str, Callable[[], JacoTask]] = {
    "reach_duplo": ReachDuplo,
    "move_box": MoveBox,
    "lift_box": LiftBox,
}
"""Every task by its name."""

OCCLUDED: dict[str, Callable[[], JacoTask]] = {
    "move_box": partial(MoveBox, occluded=True),
    "lift_box": partial(LiftBox, occluded=True),
}
"""The tasks that can also be had with a disc between camera and object."""


def make_task(name: str, *, occluded: bool = False) -> JacoTask:
    """A task by its name.

    Args:
        name: a key of `TASKS`.
        occluded: with a disc between camera and object.

    Raises:
        MerlError: there is no such task, or it has no occluded form.
    """
    if name not in TASKS:
        raise MerlError(f"task {name!r} is unknown: {meant(name, TASKS)}")
    if occluded and name not in OCCLUDED:
        raise MerlError(f"{name} has no occluded form: choose from {', '.join(OCCLUDED)}")
    return (OCCLUDED if occluded else TASKS)[name]()
