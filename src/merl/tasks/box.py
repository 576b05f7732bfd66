"""What the two tasks with a box share: the box, and the disc that hides it from the camera."""

from __future__ import annotations

from dm_control import composer
from dm_control.entities import props

BOX_HALF_SIZE = 0.025
"""Half the length of an edge, m: also the height at which the box's centre rests."""
BOX_MASS = 0.1
"""kg."""
DISC_CENTER = (0.0, -0.06)
"""Middle of the disc, x and y, m: nearer to the camera than the middle of the workspace, so that
from where the camera stands it hides most of what lies there (docs/tasks.md)."""
DISC_HEIGHT = (0.135, 0.150)
"""Lower and upper face of the disc, m above the floor."""
_RED = (1.0, 0.0, 0.0, 1.0)
_GREY = (0.5, 0.5, 0.5, 1.0)


def make_box() -> composer.Entity:
    """A red cube."""
    size = [BOX_HALF_SIZE] * 3
    return props.Primitive(geom_type="box", size=size, mass=BOX_MASS, rgba=_RED, name="box")


def add_disc(arena: composer.Arena, radius: float) -> None:
    """Fix a solid disc between the camera and the middle of the workspace.

    Args:
        arena: the scene.
        radius: m.
    """
    lower, upper = DISC_HEIGHT
    arena.mjcf_model.worldbody.add(
        "geom",
        name="disc",
        type="cylinder",
        pos=(*DISC_CENTER, (lower + upper) / 2),
        size=(radius, (upper - lower) / 2),
        rgba=_GREY,
    )
