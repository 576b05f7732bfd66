"""Python packages that provide Gymnasium environments, for advice on how to install them."""

from __future__ import annotations

import re
from typing import NamedTuple


class Package(NamedTuple):
    """A package that registers environments with Gymnasium when it is imported."""

    name: str
    """Name for pip."""
    module: str
    """Name for import."""
    ids: str
    """Regular expression that matches the start of its environments' ids."""


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
    Package(
        "highway-env", "highway_env", "(highway|merge|roundabout|parking|intersection|racetrack)-"
    ),
)


def installing(env_id: str, module: str | None = None) -> str | None:
    """Return advice on how to install an environment; None if no known package provides it.

    Args:
        env_id: Gymnasium id of the environment.
        module: the module that should register the environment, if the user named one.
    """
    for package in PACKAGES:
        known_module = module is not None and module.split(".")[0] == package.module.split(".")[0]
        if known_module or (module is None and re.match(package.ids, env_id)):
            return (
                f"it comes with the package {package.name}: pip install '{package.name}', then "
                f"use the task {package.module}:{env_id}"
            )
    return None
