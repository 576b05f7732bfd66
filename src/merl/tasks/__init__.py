"""Manipulation tasks: dm_control composer tasks with named reward terms and a success test."""

from __future__ import annotations

from collections.abc import Callable

from merl.core import MerlError, suggest
from merl.core.choices import HandStart, RewardForm
from merl.tasks.simulator import check_versions  # first: it loads MuJoCo without OpenGL

# isort: split
from merl.tasks.arm_task import ArmTask
from merl.tasks.box import ABOVE, BoxTask
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.reach_duplo import ReachDuplo

__all__ = [
    "ABOVE",
    "BOX_TASKS",
    "TASKS",
    "ArmTask",
    "LiftBox",
    "MoveBox",
    "ReachDuplo",
    "check_options",
    "check_versions",
    "make_task",
]

BOX_TASKS: dict[str, type[BoxTask]] = {"move_box": MoveBox, "lift_box": LiftBox}
"""Tasks with a box, by name. They can be occluded, and support every `HandStart`."""

TASKS: dict[str, Callable[[], ArmTask]] = {"reach_duplo": ReachDuplo, **BOX_TASKS}
"""All tasks, by name."""


def make_task(
    name: str,
    *,
    occluded: bool = False,
    starts: tuple[HandStart, ...] = ABOVE,
    reward: RewardForm = "paper",
) -> ArmTask:
    """Make a task by its name.

    Args:
        name: a key of `TASKS`.
        occluded: put a disc between the camera and the object.
        starts: where the hand starts; with several, each episode draws one.
        reward: form of the reward, for tasks with a target.

    Raises:
        MerlError: the task is unknown, or does not support one of the options.
    """
    check_options(name, occluded, starts, reward)
    if name in BOX_TASKS:
        return BOX_TASKS[name](occluded=occluded, starts=starts, reward=reward)
    return TASKS[name]()


def check_options(
    name: str, occluded: bool, starts: tuple[HandStart, ...], reward: RewardForm
) -> None:
    """Check that a task supports these options of `make_task`.

    Raises:
        MerlError: the task is unknown, or does not support one of the options.
    """
    if name not in TASKS:
        raise MerlError(f"task {name!r} is unknown: {suggest(name, TASKS)}")
    if name in BOX_TASKS:
        if occluded and starts != ABOVE:
            raise MerlError(
                "occluded needs --start above: the disc leaves no space for the hand at the box"
            )
        return
    if occluded:
        raise MerlError(f"{name} has no occluded form: choose from {', '.join(BOX_TASKS)}")
    if starts != ABOVE:
        raise MerlError(
            f"{name} has no start {' '.join(starts)!r}, only 'above': choose from "
            f"{', '.join(BOX_TASKS)} for other starts"
        )
    if reward != "paper":
        raise MerlError(
            f"{name} has no reward {reward!r}, only 'paper': choose from {', '.join(BOX_TASKS)} "
            "for other rewards"
        )
