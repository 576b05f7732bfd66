"""Frames of LeRobotDataset: one MP4 file for several episodes, or PNG."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image

from merl.core import MerlError


class VideoFrames:
    """The frames of a video by their times, which are asked for in order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._decoder = self._decode()
        self._last: tuple[float, NDArray[np.uint8]] | None = None

    def at(self, time: float, tolerance: float) -> NDArray[np.uint8]:
        """Return the frame at a time, s.

        Raises:
            MerlError: the video cannot be read, or has no frame then.
        """
        try:
            while self._last is None or self._last[0] < time - tolerance:
                self._last = next(self._decoder)
        except StopIteration:
            raise MerlError(
                f"{self.path} has no frame at {time:.3f} s: it is cut off: copy it again"
            ) from None
        except (av.FFmpegError, OSError, ValueError) as error:
            raise MerlError(f"{self.path} cannot be read: {error}") from None
        if self._last[0] > time + tolerance:
            raise MerlError(f"{self.path} has no frame at {time:.3f} s, but at {self._last[0]:.3f}")
        return self._last[1]

    def _decode(self) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        with av.open(str(self.path)) as container:
            if not container.streams.video:
                raise ValueError("it has no video")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            for frame in container.decode(stream):
                yield float(frame.time or 0.0), pixels(frame)


class VideoFile:
    """Writer of one MP4 file; every second frame is a key frame, so that readers can jump."""

    def __init__(self, path: Path, rate: int) -> None:
        self._rate, self._frames = rate, 0
        self._container = av.open(str(path), "w")
        self._stream: VideoStream | None = None

    @property
    def seconds(self) -> float:
        """Return the length so far."""
        return self._frames / self._rate

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append a frame (H, W, 3)."""
        if self._stream is None:
            options = {"crf": "18", "g": "2", "bf": "0"}
            self._stream = self._container.add_stream("libx264", self._rate, options=options)
            self._stream.height, self._stream.width = image.shape[:2]
            self._stream.pix_fmt = "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, self._rate)
        self._container.mux(self._stream.encode(frame))
        self._frames += 1

    def close(self) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()


def decoded(content: Any) -> NDArray[np.uint8]:
    """Return an encoded image, such as PNG, as (H, W, 3)."""
    if not isinstance(content, bytes):
        raise ValueError("an image is missing")
    with av.open(io.BytesIO(content), "r") as container:
        return pixels(next(container.decode(video=0)))


def pixels(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return a decoded frame as RGB (H, W, 3)."""
    found: Any = frame.to_ndarray(format="rgb24")
    return np.asarray(found, np.uint8)


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (H, W, 3) as PNG."""
    output = io.BytesIO()
    Image.fromarray(image).save(output, "png")
    return output.getvalue()
