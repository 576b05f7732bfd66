"""Configs of environments: renderer, images, observations, starts and rewards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from merl.core import MerlError, check_choice

RendererName = Literal["gl", "raster"]
RendererChoice = Literal["auto", "gl", "raster"]
AUTO_RENDERER: RendererName = "raster"
"""The renderer that replaces `auto`. It works on every machine, and is the faster one where both
were measured (docs/explanation/benchmarks.md). It does not depend on the machine, so the same code
gives the same images everywhere."""
ProprioName = Literal["paper", "full"]
StateName = Literal["absolute", "relative"]
StartName = Literal["above", "around", "holding", "carrying"]
RewardName = Literal["paper", "staged"]
ImageLayout = Literal["auto", "hwc", "chw"]
OBSERVATIONS = ("image", "proprio", "state")
SMALLEST_IMAGE, LARGEST_IMAGE = 16, 2048
MOST_SAMPLES = 4
REMOVED = {
    "renderer 'warp'": "renderer raster",
    "reward 'near'": "reward paper or staged",
    "reward 'far'": "reward paper or staged",
    "reward 'both'": "reward paper or staged",
    "floor 'smooth'": "the rough floor",
}
"""Values of earlier versions, which recorded runs may have, and their replacements."""


@dataclass(frozen=True)
class EnvConfig:
    """Settings of an environment."""

    renderer: RendererChoice = "auto"
    """Renderer of the images: `gl` (OpenGL, as in dm_control) or `raster` (a z-buffer that needs no
    OpenGL and is much faster on a CPU). Their images differ: to an agent they are different
    cameras. `auto` selects `raster`."""

    image_size: int = 84
    """Height and width of the agent's image, in pixels; from 16 to 2048."""

    samples: int = 1
    """Samples along each edge of a pixel of the agent's image, 1 to 4, for renderer `raster`. A
    pixel is the mean of its samples. An image takes as long as one of `samples` times the size: 24
    pixels with 3 samples take as long as 72 pixels with 1."""

    proprio: ProprioName = "paper"
    """Content of `proprio`: `paper` (angles and velocities of arm and fingers, 24 numbers) or
    `full` (also joint torques and the hand's position and rotation, 42 numbers)."""

    state: StateName = "absolute"
    """Content of `state`: `absolute` (`full` proprioception, the object's pose and velocities, the
    target) or `relative` (also the vectors from hand to object and from object to target)."""

    observations: tuple[str, ...] = ("image", "proprio")
    """Keys of an observation: any of `image`, `proprio`, `state`. Other keys are not computed."""

    occluded: bool = False
    """Put a disc between the camera and the object, for `move_box` and `lift_box`. Where the camera
    does not see the object, the agent needs proprioception."""

    start: tuple[StartName, ...] = ("above",)
    """Where the hand starts: `above` (20 to 40 cm above the floor) or, for `move_box` and
    `lift_box`, `around` (open fingers around the box), `holding` (closed around the box) or
    `carrying` (closed around the box, anywhere on the way to the target). With several, each
    episode draws one."""

    reward: RewardName = "paper"
    """Reward of `move_box` and `lift_box`: `paper` (Eqs. 4 and 5) or `staged` (the authors' later
    code, with one more term for the last centimetre)."""

    render_size: int = 480
    """Height and width of the images in videos, in pixels; from 16 to 2048."""

    def __post_init__(self) -> None:
        check_not_removed("renderer", self.renderer)
        check_choice("renderer", self.renderer, get_args(RendererChoice))
        if self.renderer == "auto":  # so a config and a run's record name the real one
            object.__setattr__(self, "renderer", AUTO_RENDERER)
        check_choice("proprio", self.proprio, get_args(ProprioName))
        check_choice("state", self.state, get_args(StateName))
        check_not_removed("reward", self.reward)
        check_choice("reward", self.reward, get_args(RewardName))
        if isinstance(self.observations, str) or not self.observations:
            raise MerlError(
                f"observations is {self.observations!r}: give a tuple of at least one of "
                f"{', '.join(OBSERVATIONS)}"
            )
        for name in self.observations:
            check_choice("observations", name, OBSERVATIONS)
        starts = get_args(StartName)
        if isinstance(self.start, str) or not self.start:
            raise MerlError(
                f"start is {self.start!r}: give a tuple of at least one of {', '.join(starts)}"
            )
        for name in self.start:
            check_choice("start", name, starts)
        check_whole("image_size", self.image_size, SMALLEST_IMAGE, LARGEST_IMAGE)
        check_whole("render_size", self.render_size, SMALLEST_IMAGE, LARGEST_IMAGE)
        check_samples(self.samples, self.image_size)
        if self.samples != 1 and self.renderer != "raster":
            raise MerlError(
                f"samples is {self.samples}, and renderer {self.renderer!r} takes one sample per "
                "pixel: use renderer raster, or samples 1"
            )


def check_not_removed(name: str, value: str) -> None:
    """Reject a value that only earlier versions of merl accept.

    Raises:
        MerlError: naming the value and its replacement.
    """
    removed = f"{name} {value!r}"
    if removed in REMOVED:
        raise MerlError(
            f"{removed} no longer exists: train again with {REMOVED[removed]}, or use the version "
            "of merl that the run was trained with"
        )


def check_whole(name: str, value: int, least: int, most: int) -> None:
    """Reject a value that is not a whole number from `least` to `most`.

    Raises:
        MerlError: naming the value and the bounds.
    """
    if type(value) is not int or not least <= value <= most:
        raise MerlError(
            f"{name} is {value!r}: give a whole number, at least {least} and at most {most}"
        )


def check_samples(samples: int, size: int) -> None:
    """Reject a number of samples per pixel edge that is out of range for an image of `size` pixels.

    Raises:
        MerlError: naming the value and the bounds.
    """
    check_whole("samples", samples, 1, MOST_SAMPLES)
    if samples * size > LARGEST_IMAGE:
        raise MerlError(
            f"samples is {samples} at {size} pixels, which is {samples * size} samples along an "
            f"edge of the image: at most {LARGEST_IMAGE} are possible, so use fewer samples or a "
            "smaller image"
        )


@dataclass(frozen=True)
class UserEnvConfig:
    """How the spaces of a user's environment are interpreted."""

    image_layout: ImageLayout = "auto"
    """Order of the axes of the environment's images: `hwc` (height, width, channels), `chw`
    (channels, height, width), or `auto`, which recognises the channel axis by its size."""

    allow_wide_actions: bool = False
    """Accept actions whose bounds are more than 1,000,000 apart."""

    def __post_init__(self) -> None:
        check_choice("env.image-layout", self.image_layout, get_args(ImageLayout))
