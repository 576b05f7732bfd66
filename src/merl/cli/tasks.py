"""The command merl tasks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rich.color import Color
from rich.console import Console, Group
from rich.style import Style
from rich.table import Table
from rich.text import Text

from merl.cli.console import make_console, say
from merl.cli.parsing import parse
from merl.core.files import reporting
from merl.envs import make_env
from merl.envs.registration import ENV_IDS
from merl.tasks import BOX_TASKS, TASKS

IMAGE_WIDTH = 40  # characters
IMAGE_SIZE = 480  # pixels; height and width of the files
START = 3
"""Seed of the start state that is shown, with arm and object in view."""


@dataclass(frozen=True)
class TasksOptions:
    """List the tasks that come with merl, with an image of each."""

    pictures: Path | None = None
    """Also write the images to this folder, as PNG files."""


def tasks(args: list[str]) -> int:
    """List the tasks, with an image of each."""
    folder = parse(TasksOptions, "merl tasks", args).pictures
    console = make_console()
    for name in TASKS:
        image = _image(name)
        console.print(_entry(name, image, console))
        for line in _commands(name):
            say(console, line)
        console.print()
        if folder is not None:
            path = folder / f"{name}.png"
            _write(path, image)
            say(console, f"image: {path}\n")
    return 0


def _entry(name: str, image: NDArray[np.uint8], console: Console) -> Table:
    task = TASKS[name]()
    about = (type(task).__doc__ or name).strip().splitlines()[0]
    terms = task.term_names
    lines = [
        Text(name, style="bold"),
        Text(about),
        Text(f"reward: {' + '.join(terms)}, in [0, 1]; 250 steps of 0.04 s"),
    ]
    entry = Table.grid(padding=(0, 2))
    shows_image = (
        console.color_system is not None
        and "utf" in (console.encoding or "").lower()
        and console.width >= 2 * IMAGE_WIDTH
    )
    entry.add_row(*([_blocks(image)] if shows_image else []), Group(*lines))
    return entry


def _commands(name: str) -> list[str]:
    """Return lines of code that work on any machine, each after a line that says where to paste it.

    They name preset `laptop`, because `paper`, the default on a machine with CUDA, needs OpenGL.
    """
    lines = [
        "in Python:",
        f"    import gymnasium; env = gymnasium.make('merl:{ENV_IDS[name]}')",
        "in a shell:",
        f"    merl train {name} --preset laptop",
    ]
    if name in BOX_TASKS:
        lines += [
            "in a shell, with a disc that hides the object:",
            f"    merl train {name} --preset laptop --occluded",
        ]
    return lines


def _image(name: str) -> NDArray[np.uint8]:
    env = make_env(name, renderer="raster", image_size=IMAGE_SIZE, observations=("image",))
    try:
        image: NDArray[np.uint8] = env.reset(seed=START)[0]["image"]
        return image
    finally:
        env.close()


def _blocks(image: NDArray[np.uint8]) -> Text:
    """Return a square image as text: each character shows two pixels, one above the other."""
    side = IMAGE_WIDTH
    small = np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BOX))
    text = Text()
    for upper, lower in zip(small[::2], small[1::2], strict=True):
        for top, bottom in zip(upper, lower, strict=True):
            text.append("▀", Style(color=Color.from_rgb(*top), bgcolor=Color.from_rgb(*bottom)))
        text.append("\n")
    return text


def _write(path: Path, image: NDArray[np.uint8]) -> None:
    with reporting(f"{path} cannot be written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path)
