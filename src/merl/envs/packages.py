"""Which Python package brings a Gymnasium environment that is not installed here."""

from __future__ import annotations

import re
from typing import NamedTuple


class Package(NamedTuple):
    """A package that registers environments with Gymnasium when it is imported."""

    name: str
    """What pip installs."""
    module: str
    """What Python imports."""
    ids: str
    """A regular expression that the ids of its environments begin with."""


PACKAGES = (
    Package(
        "gymnasium-robotics",
        "gymnasium_robotics",
        "Fetch|Hand(Reach|Manipulate)|AdroitHand|FrankaKitchen|(Ant|Point)Maze_",
    ),
    Package("panda-gym", "panda_gym", "Panda"),
    Package("metaworld", "metaworld", "Meta-World/"),
    Package("gym-pusht", "gym_pusht", "gym_pusht/"),
    Package("gym-aloha", "gym_aloha", "gym_aloha/"),
    Package("gym-xarm", "gym_xarm", "gym_xarm/"),
    Package("shimmy[dm-control]", "shimmy", "dm_control/"),
    Package("ale-py", "ale_py", r"ALE/|\w+NoFrameskip-v|\w+Deterministic-v"),
    Package("minigrid", "minigrid", "MiniGrid-|BabyAI-"),
    Package(
        "highway-env", "highway_env", "(highway|merge|roundabout|parking|intersection|racetrack)-"
    ),
)


def installing(env_id: str, module: str | None = None) -> str | None:
    """Return how to get an environment; None if no known package has such a one.

    Args:
        env_id: its Gymnasium id.
        module: the module that should register it, if one is named.
    """
    for package in PACKAGES:
        known_module = module is not None and module.split(".")[0] == package.module.split(".")[0]
        if known_module or (module is None and re.match(package.ids, env_id)):
            return (
                f"it comes with the package {package.name}: pip install '{package.name}', then "
                f"name it {package.module}:{env_id}"
            )
    return None
