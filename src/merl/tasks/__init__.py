"""What is solved: each task is a dm_control composer task with named reward terms and success."""

from __future__ import annotations

from collections.abc import Callable

from merl.core import MerlError, suggest
from merl.tasks.simulator import check_versions  # before the tasks: it guards their imports

# isort: split
from merl.tasks.box import ABOVE, BoxTask, HandStart
from merl.tasks.jaco import JacoTask
from merl.tasks.lift_box import LiftBox
from merl.tasks.move_box import MoveBox
from merl.tasks.reach_duplo import ReachDuplo
from merl.tasks.rewards import RewardForm

__all__ = [
    "BOX_TASKS",
    "TASKS",
    "HandStart",
    "JacoTask",
    "LiftBox",
    "MoveBox",
    "ReachDuplo",
    "RewardForm",
    "check_versions",
    "make_task",
]

BOX_TASKS: dict[str, type[BoxTask]] = {"move_box": MoveBox, "lift_box": LiftBox}
"""The tasks with a box by name: those that can be occluded, and begin with the hand at the box."""

TASKS: dict[str, Callable[[], JacoTask]] = {"reach_duplo": ReachDuplo, **BOX_TASKS}
"""Every task by its name."""


def make_task(
    name: str,
    *,
    occluded: bool = False,
    starts: tuple[HandStart, ...] = ABOVE,
    reward: RewardForm = "paper",
) -> JacoTask:
    """A task by its name.

    Args:
        name: a key of `TASKS`.
        occluded: with a disc between camera and object.
        starts: where the hand starts; of several, one is drawn in each episode.
        reward: which reward, for the tasks with a target.

    Raises:
        MerlError: there is no such task, or it has no such form.
    """
    if name not in TASKS:
        raise MerlError(f"task {name!r} is unknown: {suggest(name, TASKS)}")
    if name in BOX_TASKS:
        if occluded and starts != ABOVE:
            raise MerlError(
                "under the disc the hand has no room at the box: occluded needs --start above"
            )
        return BOX_TASKS[name](occluded=occluded, starts=starts, reward=reward)
    if occluded:
        raise MerlError(f"{name} has no occluded form: choose from {', '.join(BOX_TASKS)}")
    if starts != ABOVE:
        raise MerlError(
            f"{name} is solved where the hand starts {starts[0]}: only {', '.join(BOX_TASKS)} can"
        )
    if reward != "paper":
        raise MerlError(
            f"{name} has no reward {reward!r}, only 'paper': {', '.join(BOX_TASKS)} have others"
        )
    return TASKS[name]()
