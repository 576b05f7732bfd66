"""Stopping from outside: Ctrl-C, a job's end, a closed terminal."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from inspect import unwrap
from threading import Timer
from types import FrameType

SHOW_CURSOR = "\x1b[?25h"
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
_APART = 0.1
"""Seconds from which on a second signal is one of its own: `timeout` and batch systems may send the
same one twice, to the process and to its group."""
_getsignal, _signal = unwrap(signal.getsignal), unwrap(signal.signal)
"""Without the conversion to enums, which takes ten times as long."""
_wakeup: list[int] = []
"""The pipe that Python writes signals to, as long as an `Interrupt` listens."""
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
    """A request to stop, by a signal; a second signal stops at once."""

    _number: int | None = None
    _at: float = 0.0
    _raises: bool = False
    _telling: Timer | None = None
    _arrived: int | None = None  # a pipe: the signals that came in, whoever handled them

    @property
    def number(self) -> int | None:
        """The first signal's number; None as long as there was none."""
        if self._number is None and self._arrived is not None:
            with suppress(BlockingIOError):
                heard = [n for n in os.read(self._arrived, 4096) if n in _HEARD]
                if heard:  # a handler of the environment's took it
                    self.note(heard[0])
        return self._number

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Take SIGINT, SIGTERM, SIGUSR1 and SIGHUP as a request to stop at the next safe point.

        What the process was told to ignore, as `nohup` does, it goes on ignoring.
        """
        heard = [number for number in _HEARD if signal.getsignal(number) != signal.SIG_IGN]
        former = {number: signal.signal(number, self._handle) for number in heard}
        self._arrived, into = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        former_wakeup = signal.set_wakeup_fd(into, warn_on_full_buffer=False)
        _wakeup.append(into)
        try:
            yield self
        finally:
            _wakeup.pop()
            signal.set_wakeup_fd(former_wakeup)
            for number, handler in former.items():
                signal.signal(number, handler)
            for end in (self._arrived, into):
                os.close(end)
            self._arrived = None
            if self._telling is not None:
                self._telling.cancel()

    def note(self, number: int) -> None:
        """Take a signal as the request to stop, if it is the first one."""
        if self._number is not None:
            return
        self._number, self._at = number, time.monotonic()
        if self._raises:
            raise Stopped(number)
        self._telling = Timer(PATIENCE, _tell)
        self._telling.daemon = True
        with suppress(RuntimeError):  # no thread can be started: saving matters more
            self._telling.start()

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Have the first signal raise `Stopped` in here, where no safe point comes for long."""
        self._raises = True
        try:
            yield
        finally:
            self._raises = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._number is None:
            self.note(number)
        # A closed terminal sends SIGHUP twice, and saving takes a moment.
        elif number != signal.SIGHUP and time.monotonic() - self._at > _APART:
            with suppress(OSError, ValueError):  # the terminal is gone
                if sys.stdout.isatty():  # the live view hides it
                    os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)


class handlers_kept:  # noqa: N801 (a context manager, used like a function)
    """Put the process's signal handlers back at the end of a call into user code.

    They are set without a look at what is there: a library may replace them behind Python's back.
    Entering and leaving takes some 3 microseconds.
    """

    def __enter__(self) -> None:
        """Note the handlers."""
        self._former = [(number, _getsignal(number)) for number in _HEARD]

    def __exit__(self, *_: object) -> None:
        """Put them back; only Python's main thread may do so."""
        if threading.current_thread() is threading.main_thread():
            for number, handler in self._former:
                if handler is not None:  # it is another library's, from before Python's start
                    _signal(number, handler)
            if _wakeup:
                signal.set_wakeup_fd(_wakeup[-1], warn_on_full_buffer=False)


def _tell() -> None:
    """A step of the environment, an update or saving takes its time, or will never end."""
    print(
        "merl: stopping once this step is done and saved; a second signal (Ctrl-C) stops at once, "
        "back to the last checkpoint",
        file=sys.stderr,
        flush=True,
    )
