"""Film strips: rows of frames, of a run's videos (Figure 4) or of other episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    return draw_rows({f"{step:,}": frames for step, frames in rows.items()}, output)


def draw_rows(rows: Mapping[str, Sequence[Frame]], output: Path) -> Path:
    """Draw rows of frames.

    Args:
        rows: {label: frames, (H, W, 3) each}.
        output: the image's file (`.png`, `.jpg`).

    Raises:
        MerlError: the file cannot be written.
    """
    columns = max(len(frames) for frames in rows.values())
    strip = Image.new(
        "RGB", (LABEL + columns * (SIDE + MARGIN), len(rows) * (SIDE + MARGIN)), "white"
    )
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default(15)
    for row, (label, frames) in enumerate(rows.items()):
        top = row * (SIDE + MARGIN)
        draw.text((LABEL - 8, top + SIDE // 2), label, "black", font, anchor="rm")
        for column, frame in enumerate(frames):
            few = frame.shape[0] < SIDE  # enlarged, each pixel stays visible
            how = Image.Resampling.NEAREST if few else Image.Resampling.LANCZOS
            image = Image.fromarray(frame).resize((SIDE, SIDE), how)
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
        count = sum(1 for _ in container.decode(video=0))
    picked = equally_spaced(count)
    with av.open(str(video)) as container:  # again: a whole video is too large for the memory
        frames = {
            index: _square(frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False))
            for index, frame in enumerate(container.decode(video=0))
            if index in picked
        }
    return [frames[index] for index in picked]


def equally_spaced(count: int) -> list[int]:
    """Return `FRAMES` indices from the first to the last of `count` frames."""
    if not count:
        raise IndexError("no frame")
    return [int(index) for index in np.linspace(0, count - 1, FRAMES).round()]


def _square(frame: Frame) -> Frame:
    height, width = frame.shape[:2]
    side = min(height, width)  # a caption stands below the image
    left = (width - side) // 2
    return frame[:side, left : left + side]
