"""Draw the tasks with both renderers (needs OpenGL).

Writes docs/images/tasks.png: the same state by `gl` and by `raster`, and the difference of the
images.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from merl.envs import make_env
from merl.rendering.config import RendererName
from merl.tasks import BOX_TASKS, TASKS

OUTPUT = Path(__file__).resolve().parent.parent / "docs/images/tasks.png"
SEED, SIZE = 3, 240
RENDERERS: tuple[RendererName, ...] = ("gl", "raster")


def first_image(task: str, renderer: RendererName, occluded: bool, size: int) -> NDArray[np.uint8]:
    """Return the first image of an episode."""
    env = make_env(
        task, renderer=renderer, occluded=occluded, image_size=size, observations=("image",)
    )
    try:
        image: NDArray[np.uint8] = env.reset(seed=SEED)[0]["image"]
        return image
    finally:
        env.close()


def main() -> None:
    """Draw one row for each task and each occluded form; print the mean differences (of 255)."""
    rows = [(task, False) for task in TASKS] + [(task, True) for task in BOX_TASKS]
    figure = Figure(figsize=(3.0 * 3, 3.0 * len(rows)), dpi=80, layout="constrained")
    for (task, occluded), panels in zip(rows, figure.subplots(len(rows), 3), strict=True):
        gl, raster = (first_image(task, name, occluded, SIZE) for name in RENDERERS)
        difference = np.abs(gl.astype(int) - raster)
        small = [first_image(task, name, occluded, 84).astype(int) for name in RENDERERS]
        mean = np.abs(small[0] - small[1]).mean()
        name = task + " --occluded" * occluded
        for axes, image, title in zip(
            panels,
            (gl, raster, np.clip(4 * difference, 0, 255).astype(np.uint8)),
            (f"{name}: gl", "raster", f"difference x 4 (mean {difference.mean():.1f} of 255)"),
            strict=True,
        ):
            axes.imshow(image)
            axes.set_title(title, size=9, loc="left")
            axes.axis("off")
        print(f"{name}: mean difference {difference.mean():.2f} at {SIZE}, {mean:.2f} at 84")
    figure.savefig(OUTPUT)


if __name__ == "__main__":
    main()
