"""Stopping from outside: Ctrl-C, a job's end, a closed terminal."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SHOW_CURSOR = "\x1b[?25h"
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
_APART = 0.1
"""Seconds from which on a second signal is one of its own: `timeout` and batch systems may send the
same one twice, to the process and to its group."""


class Stopped(KeyboardInterrupt):
    """A signal came where there is nothing to save yet.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@dataclass
class Interrupt:
    """A wish to stop, by a signal; a second one stops at once.

    Attributes:
        number: of the signal; None as long as there was none.
    """

    number: int | None = None
    _at: float = 0.0
    _raises: bool = False

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Take SIGINT, SIGTERM, SIGUSR1 and SIGHUP as a wish to stop at the next safe point.

        What the process was told to ignore, as `nohup` does, it goes on ignoring.
        """
        heard = [number for number in _HEARD if signal.getsignal(number) != signal.SIG_IGN]
        former = {number: signal.signal(number, self._note) for number in heard}
        try:
            yield self
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Have the first signal raise `Stopped` in here, where no safe point comes for long."""
        self._raises = True
        try:
            yield
        finally:
            self._raises = False

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number, self._at = number, time.monotonic()
            if self._raises:
                raise Stopped(number)
        # A closed terminal sends SIGHUP twice, and saving takes a moment.
        elif number != signal.SIGHUP and time.monotonic() - self._at > _APART:
            if sys.stdout.isatty():  # the live view hides it
                os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)
