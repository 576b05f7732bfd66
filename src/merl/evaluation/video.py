"""What the arm does, as a video that every browser plays: H.264, in real time, with captions."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Self

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from merl.core import MerlError
from merl.core.resources import load_matplotlib

MIN_SIDE = 480  # pixels; below it neither the fingers nor the captions can be made out
FPS = 25.0  # frames a second: one picture for each control step of 0.04 s

Value = str | bool | int | float
"""What a caption can show; a float is rounded to one decimal, a bool becomes yes or no."""


class VideoWriter:
    """Writes pictures to an MP4 file (H.264, yuv420p); a context manager.

    Until `close` the video lies under a temporary name beside `path`, so that a video cut short
    never sits under the final one. Leaving the `with` block by an exception removes it.

    Args:
        path: the file to make, usually `*.mp4`; its folder is made, an existing file replaced.
        fps: pictures a second; real time is one over the time between two added pictures.
        size: (width, height) of the video in pixels, both even; pictures of another size are
            scaled to it. None: as the first picture, less its last row or column if that is odd;
            one below 480 pixels is enlarged by a whole number.

    Raises:
        MerlError: the file cannot be written, or this PyAV has no H.264 encoder.
        ValueError: a size that is odd or below 480 pixels.
    """

    def __init__(
        self, path: Path | str, fps: float = FPS, size: tuple[int, int] | None = None
    ) -> None:
        if size is not None and (min(size) < MIN_SIDE or size[0] % 2 or size[1] % 2):
            raise ValueError(f"a video is at least {MIN_SIDE} pixels a side, and even: not {size}")
        self._path = Path(path)
        self._part = self._path.with_name(f".{self._path.name}.part")
        self._rate = Fraction(fps).limit_denominator(1001)
        self._size = size
        self._stream: VideoStream | None = None
        self._shape: tuple[int, ...] | None = None  # of the first picture, (H, W, 3)
        self._frames = 0
        if "libx264" not in av.codecs_available:
            raise MerlError(
                "videos need PyAV with libx264, and this one has none: "
                "pip install --force-reinstall --only-binary :all: av"
            )
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # faststart puts the index first, so that a browser plays before it has the whole file
            self._container: OutputContainer | None = av.open(
                str(self._part), "w", format="mp4", options={"movflags": "+faststart"}
            )
        except OSError as error:
            raise self._failure(error) from None

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish the video, or remove it if the block failed."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def add(self, frame: NDArray[np.uint8], caption: Mapping[str, Value] | None = None) -> None:
        """Append a picture.

        Args:
            frame: (H, W, 3) uint8, RGB, each of the first one's shape; it is not changed.
            caption: what to write on a translucent strip along the lower edge, name -> value, up
                to about five, side by side in equal columns; give every picture the same names,
                so that the columns stay where they are.

        Raises:
            MerlError: the file cannot be written, or a picture is of another kind; what there was
                of it is removed.
            ValueError: the writer is closed.
        """
        if self._container is None:
            raise ValueError(f"{self._path} is closed")
        self._check(frame)
        if self._stream is None:
            self._stream = self._open_stream(self._container, frame)
        width, height = self._stream.width, self._stream.height
        if self._size is None:
            picture = frame[:height, :width]
        elif frame.shape[:2] != (height, width):
            scaled = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
            picture = np.asarray(scaled)
        else:
            picture = frame
        if caption:
            picture = _captioned(picture, caption)
        self._encode(self._container, self._stream, np.ascontiguousarray(picture))

    def close(self) -> None:
        """Finish the video and give it its name; without effect if it is closed already.

        Raises:
            MerlError: the file cannot be written; what there was of it is removed.
            ValueError: no picture was added.
        """
        if self._container is None:
            return
        if self._stream is None:
            self.abort()
            raise ValueError(f"{self._path}: a video without a picture")
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
            self._container = None
            self._check_whole()
            self._part.replace(self._path)
        except OSError as error:
            self.abort()
            raise self._failure(error) from None

    def abort(self) -> None:
        """Give the video up and remove what there is of it."""
        container, self._container = self._container, None
        if container is not None:
            with contextlib.suppress(Exception):  # the reason is known, or does not matter any more
                container.close()
        with contextlib.suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _check(self, frame: NDArray[np.uint8]) -> None:
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise MerlError(f"a picture is uint8 (H, W, 3), not {frame.dtype} {frame.shape}")
        if self._shape is None:
            self._shape = frame.shape
            times = math.ceil(MIN_SIDE / min(frame.shape[:2]))
            if self._size is None and times > 1:
                times += times % 2  # an even size
                self._size = (times * frame.shape[1], times * frame.shape[0])
        if frame.shape != self._shape:
            raise MerlError(f"a picture {frame.shape} after pictures {self._shape}")

    def _open_stream(self, container: OutputContainer, frame: NDArray[np.uint8]) -> VideoStream:
        options = {"crf": "20", "preset": "veryfast"}
        stream = container.add_stream("libx264", rate=self._rate, options=options)
        height, width = frame.shape[:2]
        stream.width, stream.height = self._size or (width // 2 * 2, height // 2 * 2)
        stream.pix_fmt = "yuv420p"  # the one that every player knows; it needs even sides
        return stream

    def _encode(
        self, container: OutputContainer, stream: VideoStream, picture: NDArray[np.uint8]
    ) -> None:
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = self._frames
        frame.time_base = 1 / self._rate
        try:
            container.mux(stream.encode(frame))
        except OSError as error:
            self.abort()
            raise self._failure(error) from None
        self._frames += 1

    def _check_whole(self) -> None:
        """FFmpeg does not report every failed write: count what arrived, and see it to disk."""
        with av.open(str(self._part)) as video:
            packets = sum(packet.size > 0 for packet in video.demux(video=0))
        if packets != self._frames:
            raise OSError(f"{packets} of {self._frames} pictures arrived; is the disk full?")
        with self._part.open("rb") as file:
            os.fsync(file.fileno())

    def _failure(self, error: OSError) -> MerlError:
        reason = " ".join((error.strerror or str(error)).split())
        return MerlError(f"the video {self._path} cannot be written: {reason}")


def _captioned(picture: NDArray[np.uint8], caption: Mapping[str, Value]) -> NDArray[np.uint8]:
    """A copy of a picture (H, W, 3) with a caption on a dark strip along its lower edge."""
    height, width = picture.shape[:2]
    unit = min(height, width) / 100
    margin, gap = round(1.8 * unit), round(0.8 * unit)
    small, large = round(2.4 * unit), round(3.4 * unit)  # pixels: 12 and 16 in a picture of 480
    strip = small + large + 2 * margin + gap

    result = picture.copy()
    result[-strip:] = result[-strip:] * 0.4  # black at 60 %: what lies behind still shows
    below = Image.fromarray(result[-strip:])
    draw = ImageDraw.Draw(below)
    column = (width - 2 * margin) / len(caption)
    for i, (name, value) in enumerate(caption.items()):
        left, room = margin + i * column, column - margin
        label, text = name.replace("_", " "), _text(value)
        above = (left, margin + small * 0.8)
        draw.text(above, label, (205, 210, 216), _font(label, small, room), anchor="ls")
        under = (left, strip - margin)
        draw.text(under, text, (255, 255, 255), _font(text, large, room), anchor="ls")
    result[-strip:] = np.asarray(below)
    return result


def _text(value: Value) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{value:.1f}"
    return str(value)


@lru_cache(maxsize=1024)
def _font(text: str, size: int, room: float) -> ImageFont.FreeTypeFont:
    """The font in which `text` is at most `room` pixels wide: of `size` pixels, or smaller."""
    font = _face(size)
    while size > 6 and font.getlength(text) > room:
        size -= 1
        font = _face(size)
    return font


@lru_cache(maxsize=64)
def _face(size: int) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib, of `size` pixels."""
    load_matplotlib()
    from matplotlib import get_data_path

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
