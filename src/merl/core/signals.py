"""Signal handling: signals are deferred until the next safe point.

Signals come from Ctrl-C, from a batch system at the end of a job, or from a closed terminal.
"""

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
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
_MIN_INTERVAL = 0.1
"""Seconds within which a second signal is ignored: `timeout` and batch systems may send one signal
twice, to the process and to its group."""
_getsignal, _signal = unwrap(signal.getsignal), unwrap(signal.signal)
"""The functions without the conversion to enums, which takes ten times as long."""
_wakeup: list[int] = []
"""Write ends of the pipes that receive signal numbers, one for each listening `Interrupt`."""
PATIENCE = 3.0
"""Seconds after a signal until the program prints what it waits for."""


class Stopped(KeyboardInterrupt):
    """A signal arrived before there is anything to save.

    Attributes:
        number: the signal number.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@dataclass
class Interrupt:
    """A request by a signal to stop; a second signal ends the process immediately.

    In a notebook or a Python prompt, which must go on, it raises KeyboardInterrupt instead.
    """

    _number: int | None = None
    _time: float = 0.0
    _raises: bool = False
    _reminder: Timer | None = None
    _arrived: int | None = None  # read end of a pipe: all signals, whichever handler received them

    @property
    def number(self) -> int | None:
        """Return the number of the first signal; None if no signal has arrived."""
        if self._number is None and self._arrived is not None:
            with suppress(BlockingIOError):
                arrived = [n for n in os.read(self._arrived, 4096) if n in _SIGNALS]
                if arrived:  # a handler of the environment received it
                    self.note(arrived[0])
        return self._number

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Treat SIGINT, SIGTERM, SIGUSR1 and SIGHUP as a request to stop at the next safe point.

        Signals that the process ignores, e.g. because of `nohup`, stay ignored. Outside of Python's
        main thread, which alone receives signals, nothing changes.
        """
        if not _in_main_thread():
            yield self
            return
        handled = [number for number in _SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        former = {number: signal.signal(number, self._handle) for number in handled}
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
            if self._reminder is not None:
                self._reminder.cancel()

    def note(self, number: int) -> None:
        """Record a signal as the request to stop, if it is the first one.

        Raises:
            Stopped: inside a `raising` block.
        """
        if self._number is not None:
            return
        self._number, self._time = number, time.monotonic()
        if self._raises:
            raise Stopped(number)
        self._reminder = Timer(PATIENCE, _print_reminder)
        self._reminder.daemon = True
        with suppress(RuntimeError):  # no thread can be started: saving is more important
            self._reminder.start()

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Make the first signal raise `Stopped` in this block, which has no safe point."""
        self._raises = True
        try:
            yield
        finally:
            self._raises = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._number is None:
            self.note(number)
        # A closed terminal sends SIGHUP twice; the second one must not interrupt saving.
        elif number != signal.SIGHUP and time.monotonic() - self._time > _MIN_INTERVAL:
            if hasattr(sys, "ps1"):  # an interactive session
                raise KeyboardInterrupt
            with suppress(OSError, ValueError):  # the terminal was closed
                if sys.stdout.isatty():  # the live view hides the cursor
                    os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)


class handlers_kept:  # noqa: N801 (a context manager, used like a function)
    """Restore the signal handlers of the process at the end of a call into user code.

    The handlers are always set again, since a library may have replaced them without Python knowing
    it. Entering and leaving takes about 3 microseconds.
    """

    def __enter__(self) -> None:
        """Record the handlers."""
        self._former = [(number, _getsignal(number)) for number in _SIGNALS]

    def __exit__(self, *_: object) -> None:
        """Restore the handlers; only Python's main thread may do so."""
        if _in_main_thread():
            for number, handler in self._former:
                if handler is not None:  # None: set by another library before Python started
                    _signal(number, handler)
            if _wakeup:
                signal.set_wakeup_fd(_wakeup[-1], warn_on_full_buffer=False)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _print_reminder() -> None:
    """Print that the run still waits for a step, an update or a save; it may never end."""
    print(
        "merl: stopping after this step is done and saved; a second signal (Ctrl-C) stops at once, "
        "and the steps since the last checkpoint are lost",
        file=sys.stderr,
        flush=True,
    )
