"""Stopping from outside: Ctrl-C, a job's end, a closed terminal."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SHOW_CURSOR = "\x1b[?25h"
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass
class Interrupt:
    """A wish to stop, by a signal; a second Ctrl-C stops at once.

    Attributes:
        number: of the signal; None as long as there was none.
    """

    number: int | None = None

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Take SIGINT, SIGTERM and SIGHUP as a wish to stop at the next safe point.

        What the process was told to ignore, as `nohup` does, it goes on ignoring.
        """
        heard = [number for number in _HEARD if signal.getsignal(number) != signal.SIG_IGN]
        former = {number: signal.signal(number, self._note) for number in heard}
        try:
            yield self
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        # A closed terminal sends SIGHUP twice, and saving takes a moment: only a person's second
        # Ctrl-C means at once.
        if self.number is not None and number == signal.SIGINT:
            if sys.stdout.isatty():  # the live view hides it
                os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)
        if self.number is None:
            self.number = number
