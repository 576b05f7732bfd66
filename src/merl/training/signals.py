"""Stopping from outside: Ctrl-C, a job's end, a closed terminal."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Timer
from types import FrameType

SHOW_CURSOR = "\x1b[?25h"
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
_APART = 0.1
"""Seconds from which on a second signal is one of its own: `timeout` and batch systems may send the
same one twice, to the process and to its group."""
PATIENCE = 3.0
"""Seconds after which who has asked to stop is told what is waited for."""


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
    _telling: Timer | None = None

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
            if self._telling is not None:
                self._telling.cancel()

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
            self._telling = Timer(PATIENCE, _tell)
            self._telling.daemon = True
            with suppress(RuntimeError):  # no thread is to be had: saving matters more
                self._telling.start()
        # A closed terminal sends SIGHUP twice, and saving takes a moment.
        elif number != signal.SIGHUP and time.monotonic() - self._at > _APART:
            with suppress(OSError, ValueError):  # the terminal is gone
                if sys.stdout.isatty():  # the live view hides it
                    os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)


def _tell() -> None:
    """A step of the environment, an update or saving takes its time, or will never end."""
    print(
        "merl: stopping once this step is done and saved; a second signal (Ctrl-C) stops at once, "
        "back to the last checkpoint",
        file=sys.stderr,
        flush=True,
    )
