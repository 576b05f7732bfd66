"""Reach: bring the hand to a brick on the floor."""

from __future__ import annotations

from collections.abc import Callable

from dm_control import mjcf
from dm_control.entities import props

from merl.tasks import rewards
from merl.tasks.arm_task import ArmTask
from merl.tasks.robots import Robot, jaco


class ReachDuplo(ArmTask):
    """Bring the hand to within 5 cm of a 2x4 Duplo brick (dm_control's `reach_duplo`)."""

    term_names = ("reaching",)
    success_distance = rewards.REACHING_DISTANCE

    def __init__(self, robot: Callable[[], Robot] = jaco) -> None:
        super().__init__(prop=props.Duplo(), robot=robot)

    def distance(self, physics: mjcf.Physics) -> float:
        """Return the distance from the tool centre point to the brick, m."""
        return self.hand_distance(physics)

    def reward_terms(self, physics: mjcf.Physics) -> dict[str, float]:
        """Return `reaching`, in [0, 1] (Eq. 3)."""
        return rewards.reach(self.hand_distance(physics))
