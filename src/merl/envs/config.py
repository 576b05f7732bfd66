"""Configs of environments: renderer, images, observations, starts and rewards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from merl.core import Kind, MerlError
from merl.core.choices import HandStart, ProprioSet, RewardForm, StateSet
from merl.core.fields import NOT_EMPTY, Range, check_fields
from merl.rendering.config import LARGEST_IMAGE, RendererName, Samples, check_samples

ImageLayout = Literal["auto", "hwc", "chw"]
ObservationKey = Literal["image", "depth", "wrist", "wrist_depth", "proprio", "touch", "state"]
OBSERVATION_KINDS: dict[ObservationKey, Kind] = {
    "image": "image",
    "depth": "depth",
    "wrist": "image",
    "wrist_depth": "depth",
    "proprio": "vector",
    "touch": "vector",
    "state": "vector",
}
"""Keys of an observation of merl's own tasks, with their kinds."""
DEPTH_RANGE = (0.0, 2.0)
"""Bounds of `depth`, m; greater distances, such as those of the sky, are clipped."""


@dataclass(frozen=True)
class EnvConfig:
    """Settings of an environment."""

    renderer: RendererName = "raster"
    """Renderer of the images: `gl` (OpenGL, as in dm_control) or `raster` (a z-buffer that needs no
    OpenGL and is much faster on a CPU). Their images differ: to an agent they are different
    cameras."""

    image_size: Annotated[int, Range(16, LARGEST_IMAGE)] = 84
    """Height and width of the agent's image, in pixels; from 16 to 2048."""

    samples: Samples = 1
    """Samples along each edge of a pixel of the agent's image, 1 to 4, for renderer `raster`. A
    pixel is the mean of its samples. An image takes as long as one of `samples` times the size: 24
    pixels with 3 samples take as long as 72 pixels with 1."""

    proprio: ProprioSet = "paper"
    """Content of `proprio`: `paper` (angles and velocities of arm and fingers, 24 numbers) or
    `full` (also joint torques and the hand's position and rotation, 42 numbers)."""

    state: StateSet = "absolute"
    """Content of `state`: `absolute` (`full` proprioception, the object's pose and velocities, the
    target) or `relative` (also the vectors from hand to object and from object to target)."""

    observations: Annotated[tuple[ObservationKey, ...], NOT_EMPTY] = ("image", "proprio")
    """Keys of an observation: any of `image` and `depth` (m) of the camera in front of the arm,
    `wrist` and `wrist_depth` of a camera at the wrist, `proprio`, `touch` (forces on the palm and
    the six links of the fingers) and `state`. Other keys are not computed."""

    occluded: bool = False
    """Put a disc between the camera and the object, for `move_box` and `lift_box`. Where the camera
    does not see the object, the agent needs proprioception."""

    start: Annotated[tuple[HandStart, ...], NOT_EMPTY] = ("above",)
    """Where the hand starts: `above` (20 to 40 cm above the floor) or, for `move_box` and
    `lift_box`, `around` (open fingers around the box), `holding` (closed around the box) or
    `carrying` (closed around the box, anywhere on the way to the target). With several, each
    episode draws one."""

    reward: RewardForm = "paper"
    """Reward of `move_box` and `lift_box`: `paper` (Eqs. 4 and 5) or `staged` (the authors' later
    code, with one more term for the last centimetre)."""

    render_size: Annotated[int, Range(16, LARGEST_IMAGE)] = 480
    """Height and width of the images in videos, in pixels; from 16 to 2048."""

    def __post_init__(self) -> None:
        check_fields(self)
        check_samples(self.samples, self.image_size)
        if self.samples != 1 and self.renderer != "raster":
            raise MerlError(
                f"samples is {self.samples}, and renderer {self.renderer!r} takes one sample per "
                "pixel: use renderer raster, or samples 1"
            )

    @property
    def form(self) -> dict[str, Any]:
        """What demonstrations record of a task of merl's: its reward, starts and disc."""
        return {name: getattr(self, name) for name in ("reward", "start", "occluded")}


@dataclass(frozen=True)
class UserEnvConfig:
    """How the spaces of a user's environment are interpreted."""

    image_layout: ImageLayout = "auto"
    """Order of the axes of the environment's images: `hwc` (height, width, channels), `chw`
    (channels, height, width), or `auto`, which recognises the channel axis by its size."""

    allow_wide_actions: bool = False
    """Accept actions whose bounds are more than 1,000,000 apart."""

    def __post_init__(self) -> None:
        check_fields(self, "env.")
