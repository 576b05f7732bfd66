"""Signal handling: signals are deferred until the next safe point.

Signals come from Ctrl-C, from a batch system at the end of a job, or from a closed terminal.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # no enums: ten times as fast
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from threading import Lock, Timer
from types import FrameType

from merl.core.watcher import ENDING, REPEATED, TOLD
from merl.core.watching import new_log, watched

SHOW_CURSOR = "\x1b[?25h"
_MIN_INTERVAL = 0.1
"""Seconds within which a second signal is ignored: `timeout` and batch systems may send one signal
twice, to the process and to its group."""
_REPLACED = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
"""Signals whose handlers C libraries may replace."""
_logs: list[int] = []
"""Descriptors to which the C code of Python writes the number of every signal, the newest last."""
PATIENCE = 3.0
"""Seconds after a signal until the program prints what it waits for."""
_LATER = 0.3
"""Seconds by which another process waits longer, until it prints in place of this one."""
_REMINDER = (
    "merl: stopping after this step is done and saved; a second signal (Ctrl-C) stops at once, and "
    "the steps since the last checkpoint are lost"
)


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
    _log: int | None = None  # all signals, whichever handler received them
    _read: int = 0  # bytes of the log that were read
    _log_open: Lock = field(default_factory=Lock)

    @property
    def number(self) -> int | None:
        """Return the number of the first signal; None if no signal has arrived."""
        if self._number is None and self._log is not None:
            arrived = os.pread(self._log, 4096, self._read)
            self._read += len(arrived)
            for number in arrived:
                if number in ENDING:  # a handler of the environment received it
                    self.note(number)
        return self._number

    @contextmanager
    def listening(self) -> Iterator[Interrupt]:
        """Treat the signals in `ENDING` as a request to stop at the next safe point.

        Signals that the process ignores, e.g. because of `nohup`, stay ignored. Outside of Python's
        main thread, which alone receives signals, nothing changes.
        """
        if not _in_main_thread():
            yield self
            return
        handled = [
            number for number in ENDING if signal.getsignal(number) not in (None, signal.SIG_IGN)
        ]
        former = {number: signal.signal(number, self._handle) for number in handled}
        try:
            with attended(_REMINDER) as self._log:
                self._read = 0
                try:
                    yield self
                finally:
                    with self._log_open:
                        self._log = None
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)
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
        self._reminder = Timer(PATIENCE, self._remind)
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

    def _remind(self) -> None:
        """Print that the run still waits for a step, an update or a save; it may never end."""
        with self._log_open:
            if self._log is not None:
                os.write(self._log, TOLD)
        print(_REMINDER, file=sys.stderr, flush=True)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._number is None:
            self.note(number)
        elif number not in REPEATED and time.monotonic() - self._time > _MIN_INTERVAL:
            if _is_interactive():
                raise KeyboardInterrupt
            with suppress(OSError, ValueError):  # the terminal was closed
                if sys.stdout.isatty():  # the live view hides the cursor
                    os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
            os._exit(128 + number)


@contextmanager
def attended(text: str) -> Iterator[int | None]:
    """Let another process watch the signals, in case that C code hangs: see `watched`.

    It prints `text` if this process has neither ended nor written `TOLD` `PATIENCE` seconds after
    the first signal, and kills this process after the second one. It does neither in an interactive
    session, which must go on, nor outside of Python's main thread.

    Yields:
        The descriptor of the signals that arrive; None outside of Python's main thread.
    """
    if not _in_main_thread():
        yield None
        return
    log = new_log()
    former = signal.set_wakeup_fd(log, warn_on_full_buffer=False)
    _logs.append(log)
    try:
        with nullcontext() if _is_interactive() else watched(log, PATIENCE + _LATER, text):
            yield log
    finally:
        _logs.pop()
        signal.set_wakeup_fd(former)
        os.close(log)


class handlers_kept:  # noqa: N801 (a context manager, used like a function)
    """Restore the signal handlers of the process at the end of a call into user code.

    Those in `_REPLACED` are always set again, since a library may have replaced them without Python
    knowing it. Entering and leaving takes some microseconds.
    """

    def __enter__(self) -> None:
        """Record the handlers."""
        self._former = [(number, _signal.getsignal(number)) for number in ENDING]

    def __exit__(self, *_: object) -> None:
        """Restore the handlers; only Python's main thread may do so."""
        if _in_main_thread():
            for number, handler in self._former:
                if handler is None:  # set by another library before Python started
                    continue
                if number in _REPLACED or _signal.getsignal(number) is not handler:
                    _signal.signal(number, handler)
            if _logs:
                signal.set_wakeup_fd(_logs[-1], warn_on_full_buffer=False)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_interactive() -> bool:
    return hasattr(sys, "ps1")
