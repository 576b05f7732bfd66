"""Output streams that never end a run: if a write fails, the text is lost and the run continues.

A write can fail because the reader has exited (`merl train ... | head -1`), the log is on a full
disk, the terminal was closed, or the file descriptor was closed.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO, cast


class TolerantStream:
    """A text stream that discards text that it cannot write; otherwise like the wrapped stream.

    Attributes:
        error: the first error of a write; None if all writes succeeded.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write text if possible; escape characters that the encoding does not have."""
        with self._recording_error():
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoding = self._stream.encoding or "ascii"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write each line; see `write`."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream if possible."""
        with self._recording_error():
            self._stream.flush()

    def isatty(self) -> bool:
        """Return whether the stream is a terminal; False if it is closed."""
        try:
            return self._stream.isatty()
        except (OSError, ValueError):
            return False

    def finish(self) -> None:
        """Flush, and discard text that cannot be flushed; else Python reports it at exit."""
        self.flush()
        if self.error is None:
            return
        with suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    @contextmanager
    def _recording_error(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
        except ValueError as error:  # the stream was closed
            self.error = self.error or OSError(errno.EBADF, str(error))


def tolerate_lost_output() -> tuple[TolerantStream, TolerantStream]:
    """Replace `sys.stdout` and `sys.stderr` by tolerant streams, permanently; return both."""
    _open_closed_descriptors()
    streams = []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # its descriptor was closed when Python started
            stream = Path(os.devnull).open("w")  # noqa: SIM115 (it stays open)
        if not isinstance(stream, TolerantStream):
            stream = TolerantStream(stream)
        setattr(sys, name, stream)
        streams.append(stream)
    return streams[0], streams[1]


@contextmanager
def tolerant_output() -> Iterator[tuple[TolerantStream, TolerantStream]]:
    """Replace `sys.stdout` and `sys.stderr` by tolerant streams inside the block; yield both.

    Both are flushed at the end of the block.
    """
    before = sys.stdout, sys.stderr
    streams = tolerate_lost_output()
    try:
        yield streams
    finally:
        for stream in streams:
            stream.finish()
        sys.stdout, sys.stderr = (
            cast(TextIO, own if was is None else was)
            for own, was in zip(streams, before, strict=True)
        )


def _open_closed_descriptors() -> None:
    """Open the null device on the descriptors of standard streams that are closed.

    Otherwise the next opened file gets that descriptor and receives the output of libraries.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            null = os.open(os.devnull, os.O_RDWR)
            if null != descriptor:
                os.dup2(null, descriptor)
                os.close(null)
            os.set_inheritable(descriptor, True)
