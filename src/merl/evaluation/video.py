"""Writer of videos that every browser can play: H.264, in real time, with captions."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from merl.core import MerlError
from merl.core.resources import load_matplotlib

MIN_SIDE = 480  # pixels; in smaller videos the fingers and the captions are not recognisable
FPS = 25.0  # frames per second: one frame for each control step of 0.04 s

Value = str | bool | int | float
"""A value of a caption; a float is rounded to one decimal, a bool becomes yes or no."""


class VideoWriter(contextlib.AbstractContextManager["VideoWriter"]):
    """Writer of an MP4 file (H.264, yuv420p); a context manager.

    Until `close` the video has a temporary name beside `path`, so that an incomplete video never
    has the final name. An exception in the `with` block removes it.

    The video has the size of the first frame, without its last row or column if that size is odd; a
    frame with a side below 480 pixels is enlarged by an integer factor.

    Args:
        path: the file to write, usually `*.mp4`; its folder is created, an existing file replaced.
        fps: frames per second; for real time, 1 / (seconds between two added frames).

    Raises:
        MerlError: the file cannot be written, or the installed PyAV has no H.264 encoder.
    """

    def __init__(self, path: Path | str, fps: float = FPS) -> None:
        self._path = Path(path)
        self._part = self._path.with_name(f".{self._path.name}.part")
        self._rate = Fraction(fps).limit_denominator(1001)
        self._stream: VideoStream | None = None
        self._shape: tuple[int, ...] | None = None  # of the first frame, (H, W, 3)
        self._frames = 0
        if "libx264" not in av.codecs_available:
            raise MerlError(
                "videos need PyAV with libx264, which the installed PyAV lacks: "
                "pip install --force-reinstall --only-binary :all: av"
            )
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # faststart puts the index first, so that a browser can play the video while loading it
            self._container: OutputContainer | None = av.open(
                str(self._part), "w", format="mp4", options={"movflags": "+faststart"}
            )
        except OSError as error:
            raise self._failure(error) from None

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Finish the video, or remove it if the block raised an exception."""
        if kind is None:
            self.close()
        else:
            self.abort()

    def add(self, frame: NDArray[np.uint8], caption: Mapping[str, Value] | None = None) -> None:
        """Append a frame.

        Args:
            frame: (H, W, 3) uint8, RGB, of the same shape as the first frame; it is not changed.
            caption: name -> value, up to about five, written side by side in equal columns on a
                translucent strip along the lower edge. Use the same names in every frame, so that
                the columns do not move.

        Raises:
            MerlError: the file cannot be written, or the frame has another shape or type; the
                incomplete video is removed.
            ValueError: the writer is closed.
        """
        if self._container is None:
            raise ValueError(f"{self._path} is closed")
        self._check(frame)
        if self._stream is None:
            self._stream = self._open_stream(self._container, frame)
        width, height = self._stream.width, self._stream.height
        if frame.shape[0] < height:
            enlarged = Image.fromarray(frame).resize((width, height), Image.Resampling.LANCZOS)
            image = np.asarray(enlarged)
        else:
            image = frame[:height, :width]
        if caption:
            image = _captioned(image, caption)
        self._encode(self._container, self._stream, np.ascontiguousarray(image))

    def close(self) -> None:
        """Finish the video and rename it to `path`; do nothing if it is already closed.

        Raises:
            MerlError: the file cannot be written; the incomplete video is removed.
            ValueError: no frame was added.
        """
        if self._container is None:
            return
        if self._stream is None:
            self.abort()
            raise ValueError(f"{self._path}: a video without frames")
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
        """Remove the incomplete video; do nothing if it is finished."""
        container, self._container = self._container, None
        if container is not None:
            with contextlib.suppress(Exception):  # the first error is already known
                container.close()
        with contextlib.suppress(OSError):
            self._part.unlink(missing_ok=True)

    def _check(self, frame: NDArray[np.uint8]) -> None:
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            raise MerlError(
                f"a video frame must be uint8 (H, W, 3), not {frame.dtype} {frame.shape}"
            )
        self._shape = self._shape or frame.shape
        if frame.shape != self._shape:
            raise MerlError(
                f"video frame has shape {frame.shape}, but the first one had {self._shape}"
            )

    def _open_stream(self, container: OutputContainer, frame: NDArray[np.uint8]) -> VideoStream:
        options = {"crf": "20", "preset": "veryfast"}
        stream = container.add_stream("libx264", rate=self._rate, options=options)
        height, width = frame.shape[:2]
        times = math.ceil(MIN_SIDE / min(height, width))
        times += times % 2 if times > 1 else 0  # an even size
        stream.width, stream.height = times * width // 2 * 2, times * height // 2 * 2
        stream.pix_fmt = "yuv420p"  # every player supports this format; it needs even sides
        return stream

    def _encode(
        self, container: OutputContainer, stream: VideoStream, image: NDArray[np.uint8]
    ) -> None:
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts = self._frames
        frame.time_base = 1 / self._rate
        try:
            container.mux(stream.encode(frame))
        except OSError as error:
            self.abort()
            raise self._failure(error) from None
        self._frames += 1

    def _check_whole(self) -> None:
        """Count the written frames and flush them: FFmpeg does not report every failed write."""
        with av.open(str(self._part)) as video:
            packets = sum(packet.size > 0 for packet in video.demux(video=0))
        if packets != self._frames:
            raise OSError(
                f"only {packets} of {self._frames} frames were written; is the disk full?"
            )
        with self._part.open("rb") as file:
            os.fsync(file.fileno())

    def _failure(self, error: OSError) -> MerlError:
        reason = " ".join((error.strerror or str(error)).split())
        return MerlError(f"the video {self._path} cannot be written: {reason}")


def _captioned(image: NDArray[np.uint8], caption: Mapping[str, Value]) -> NDArray[np.uint8]:
    """Return a copy of an image (H, W, 3) with a caption on a dark strip along its lower edge."""
    height, width = image.shape[:2]
    unit = min(height, width) / 100
    margin, gap = round(1.8 * unit), round(0.8 * unit)
    small, large = round(2.4 * unit), round(3.4 * unit)  # pixels: 12 and 16 in a frame of 480
    strip = small + large + 2 * margin + gap

    result = image.copy()
    result[-strip:] = result[-strip:] * 0.4  # black at 60 %, so that the background stays visible
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
    """Return a font of at most `size` pixels in which `text` is at most `room` pixels wide.

    The smallest size is 6 pixels, in which the text may be wider.
    """
    font = _face(size)
    while size > 6 and font.getlength(text) > room:
        size -= 1
        font = _face(size)
    return font


@lru_cache(maxsize=64)
def _face(size: int) -> ImageFont.FreeTypeFont:
    """Return DejaVu Sans of `size` pixels; the font file is part of Matplotlib."""
    load_matplotlib()
    from matplotlib import get_data_path

    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
