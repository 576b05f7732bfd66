"""Film strips: frames of a run's videos, a row for each evaluation (Figure 4)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from merl.core import MerlError

FRAMES, SIDE, MARGIN = 8, 120, 2
LABEL = 78
"""Width of the column with the steps, in pixels."""
MOST_ROWS = 5

Frame = NDArray[np.uint8]


def film_strip(videos: Mapping[int, Path], output: Path) -> Path:
    """Draw frames of the first, the last and some evaluations between, from start to end.

    Args:
        videos: {step of the evaluation: its video}, at least one.
        output: the image's file (`.png`, `.jpg`).

    Returns:
        `output`.

    Raises:
        MerlError: no video can be read, or the file cannot be written.
    """
    steps = [*videos]
    chosen = np.unique(np.linspace(0, len(steps) - 1, min(MOST_ROWS, len(steps))).round())
    rows = {}
    for index in chosen.astype(int):
        try:
            rows[steps[index]] = _frames(videos[steps[index]])
        except (av.FFmpegError, OSError, IndexError):  # e.g. a video that is still written
            continue
    if not rows:
        raise MerlError(f"no video can be read: {', '.join(map(str, videos.values()))}")
    strip = Image.new(
        "RGB", (LABEL + FRAMES * (SIDE + MARGIN), len(rows) * (SIDE + MARGIN)), "white"
    )
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(15)
    for row, (step, frames) in enumerate(rows.items()):
        top = row * (SIDE + MARGIN)
        draw.text((LABEL - 8, top + SIDE // 2), f"{step:,}", "black", font, anchor="rm")
        for column, frame in enumerate(frames):
            image = Image.fromarray(frame).resize((SIDE, SIDE), Image.Resampling.LANCZOS)
            strip.paste(image, (LABEL + column * (SIDE + MARGIN), top))
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        strip.save(output)
    except (OSError, ValueError) as error:
        raise MerlError(f"{output} cannot be written: {error}") from None
    return output


def _frames(video: Path) -> list[Frame]:
    """Return frames of a video, equally spaced from the first to the last, cut to a square."""
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    picked = np.linspace(0, len(frames) - 1, FRAMES).round().astype(int)
    return [_square(frames[index]) for index in picked]


def _square(frame: Frame) -> Frame:
    height, width = frame.shape[:2]
    side = min(height, width)  # a caption stands below the image
    left = (width - side) // 2
    return frame[:side, left : left + side]
