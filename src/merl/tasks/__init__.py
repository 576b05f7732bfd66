"""What is solved: each task is a dm_control composer task with named reward terms and success."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from merl.core import MerlError, meant
from merl.tasks.simulator import check_versions  # before the tasks: it guards their imports

# isort: split
from merl.tasks.jaco import HandStart, JacoTask
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.reach_duplo import ReachDuplo

__all__ = [
    "AROUND",
    "OCCLUDED",
    "TASKS",
    "HandStart",
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


AROUND: dict[str, Callable[[], JacoTask]] = {
    "move_box": partial(MoveBox, start="around"),
    "lift_box": partial(LiftBox, start="around"),
}
"""The tasks in which the hand can also start around the object."""


def make_task(name: str, *, occluded: bool = False, start: HandStart = "above") -> JacoTask:
    """A task by its name.

    Args:
        name: a key of `TASKS`.
        occluded: with a disc between camera and object.
        start: where the hand starts.

    Raises:
        MerlError: there is no such task, or it has no such form.
    """
    if name not in TASKS:
        raise MerlError(f"task {name!r} is unknown: {meant(name, TASKS)}")
    if occluded and name not in OCCLUDED:
        raise MerlError(f"{name} has no occluded form: choose from {', '.join(OCCLUDED)}")
    if start == "above":
        return (OCCLUDED if occluded else TASKS)[name]()
    if name not in AROUND:
        raise MerlError(f"{name} is solved where the hand starts around the object: start above")
    if occluded:
        raise MerlError("under the disc there is no room for the hand: occluded needs start above")
    return AROUND[name]()
