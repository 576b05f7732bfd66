"""Gymnasium ids of the tasks; importing this module loads neither torch nor the simulator."""

from __future__ import annotations

from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

ENV_IDS = {
    "reach_duplo": "merl/ReachDuplo-v0",
    "move_box": "merl/MoveBox-v0",
    "lift_box": "merl/LiftBox-v0",
}
"""Gymnasium id of each task."""


def register() -> None:
    """Register the tasks with Gymnasium; repeated calls have no effect."""
    for task, env_id in ENV_IDS.items():
        if env_id not in registry:
            register_with_gymnasium(env_id, entry_point="merl.envs:make_env", kwargs={"task": task})
