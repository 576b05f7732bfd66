"""Output is an observer: a stream that cannot be written to never ends a run.

A reader that has gone away (`merl train ... | head -1`), a log on a full disk, a closed terminal
and a closed descriptor are all the same to a run: what it prints is lost, and the run continues.
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
    """A text stream that drops what it cannot write; all else is as the stream itself has it.

    Attributes:
        error: the first error of a write; None as long as everything was written.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def write(self, text: str) -> int:
        """Write what can be written; a character that the encoding lacks is escaped."""
        with self._noting():
            try:
                self._stream.write(text)
            except UnicodeEncodeError:
                encoding = self._stream.encoding or "ascii"
                self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """See `write`."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush what can be flushed."""
        with self._noting():
            self._stream.flush()

    def isatty(self) -> bool:
        """Whether it is a terminal; a stream that is closed is none."""
        try:
            return self._stream.isatty()
        except (OSError, ValueError):
            return False

    def finish(self) -> None:
        """Flush, and discard what cannot be flushed, or Python would complain when it exits."""
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
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.error = self.error or error
        except ValueError as error:  # the stream was closed
            self.error = self.error or OSError(errno.EBADF, str(error))


def tolerate_lost_output() -> tuple[TolerantStream, TolerantStream]:
    """Make `sys.stdout` and `sys.stderr` tolerant, for good; returns both."""
    _open_closed_descriptors()
    streams = []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # its descriptor was closed when Python started
            stream = Path(os.devnull).open("w")  # noqa: SIM115 (for good)
        if not isinstance(stream, TolerantStream):
            stream = TolerantStream(stream)
        setattr(sys, name, stream)
        streams.append(stream)
    return streams[0], streams[1]


@contextmanager
def tolerant_output() -> Iterator[tuple[TolerantStream, TolerantStream]]:
    """Make `sys.stdout` and `sys.stderr` tolerant inside the block; yields both.

    At the end of the block both are flushed.
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
    """Open the null device in place of standard streams that are closed.

    Otherwise the next file that is opened takes their place, and receives what libraries print.
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
