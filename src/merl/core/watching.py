"""Let another process watch this one, and end this one in time: while C code holds the GIL.

Neither a signal handler of Python nor a thread runs then.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from merl.core.watcher import ENDING

END_SECONDS = 9.0
"""Seconds in which environments must close and threads must end; see `ending`."""
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG, _MFD_CLOEXEC, _CLOCK_MONOTONIC, _SIGEV_THREAD = 1, 1, 1, 2  # C headers
_LAST = 0.3
"""Seconds between the printed line and the end of the process."""


def end_with_parent(number: int) -> None:
    """Let the system send this process a signal when its parent process dies."""
    _LIBC.prctl(_PR_SET_PDEATHSIG, number)


@contextmanager
def signals_blocked(numbers: Collection[int] = ENDING) -> Iterator[None]:
    """Start processes in this block: they keep these signals blocked until they are prepared.

    Handlers are called at the end of the block: one that raises must not leave a process that is
    half started. (Other threads may receive the signals, so blocking them here is not enough.)
    """
    arrived, former = list[int](), dict[int, Callable[[int, FrameType | None], Any]]()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            if callable(handler := signal.getsignal(number)):
                former[number] = handler
                signal.signal(number, lambda number, _: arrived.append(number))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in former.items():
            signal.signal(number, handler)
        for number in arrived:
            former[number](number, None)


def new_log() -> int:
    """Return the descriptor of an empty file in memory, for `signal.set_wakeup_fd`.

    Raises:
        OSError: it cannot be made.
    """
    log: int = _LIBC.memfd_create(b"merl-signals", _MFD_CLOEXEC)  # `os` may lack it
    os.set_blocking(log, False)
    return log


@contextmanager
def watched(log: int, patience: float, text: str) -> Iterator[None]:
    """Let a process watch this one during the block, see `merl.core.watcher.watch`."""
    with _crashes() as crash:
        process = _start_watcher(log, crash, patience, text)
        try:
            yield
        finally:
            _stop(process)


@contextmanager
def _crashes() -> Iterator[int]:
    """Yield the descriptor of a file in memory to which Python writes if C code crashes.

    It stays empty if `faulthandler` is already enabled: then Python writes to another file.
    """
    file, ours = new_log(), not faulthandler.is_enabled()
    if ours:
        faulthandler.enable(file, all_threads=False)
    try:
        yield file
    finally:
        if ours:
            faulthandler.disable()
        os.close(file)


@contextmanager
def ending(code: int, text: str) -> Iterator[None]:
    """End this process with an exit code if the block takes `END_SECONDS`, and print a line then.

    The block may hang in C code: another process prints, and a thread of the C library ends this
    one. It may crash there, too: see `merl.core.watcher.watch`.
    """
    with _crashes() as crash:
        process, timer = _start_ending(code, text, crash)
        try:
            yield
        finally:
            if timer is not None:
                _timers().timer_delete(timer)
            _stop(process)


def end_soon(code: int) -> None:
    """End this process with an exit code in `END_SECONDS` if it is still there, and print why.

    Call it last: Python then waits for threads and calls exit handlers, which may hang.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # without a traceback
    others = {*threading.enumerate()} - {threading.main_thread()}
    names = ", ".join(thread.name for thread in others if not thread.daemon)
    what = (
        f"thread {names}, which did not end" if names else "an exit handler, which did not return"
    )
    _start_ending(code, f"merl: warning: ended without waiting for {what} within {END_SECONDS:g} s")


def _start_ending(
    code: int, text: str, crash: int | None = None
) -> tuple[subprocess.Popen[bytes] | None, Any]:
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # None, or closed
            stream.flush()
    null = os.open(os.devnull, os.O_RDONLY)
    process = _start_watcher(null, null if crash is None else crash, END_SECONDS, text, waits=True)
    os.close(null)
    return process, _exit_after(END_SECONDS + _LAST, code)


def _start_watcher(
    log: int, crash: int, patience: float, text: str, *, waits: bool = False
) -> subprocess.Popen[bytes] | None:
    """Start `merl.core.watcher` for this process; return None if that is impossible."""
    if not sys.executable:  # Python is embedded in another program
        return None
    script = str(Path(__file__).with_name("watcher.py"))
    numbers = map(str, (os.getpid(), log, crash, patience))
    line = [sys.executable, "-I", "-S", script, *numbers, text, str(int(waits))]
    with suppress(OSError, subprocess.SubprocessError), signals_blocked():
        return subprocess.Popen(
            line,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[log, crash],
            start_new_session=True,  # Ctrl-C does not reach it
        )
    return None


def _stop(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None:
        process.kill()
        process.wait()


class _Event(ctypes.Structure):
    """`struct sigevent` of glibc: call a function with a value in a new thread."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("rest", ctypes.c_char * 64),
    )


class _Time(ctypes.Structure):
    """`struct itimerspec`: the period and the first time, each in seconds and nanoseconds."""

    _fields_ = (("period", ctypes.c_long * 2), ("first", ctypes.c_long * 2))


def _exit_after(seconds: float, code: int) -> Any:
    """Let a thread of the C library exit at once after some seconds; return the timer."""
    function = ctypes.cast(_LIBC._exit, ctypes.c_void_p)
    event = _Event(value=code, kind=_SIGEV_THREAD, function=function)
    whole, rest = divmod(seconds, 1.0)
    when, timer = _Time(first=(int(whole), int(rest * 1e9))), ctypes.c_void_p()
    with suppress(OSError, AttributeError):  # a system without these timers
        if not _timers().timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)):
            _timers().timer_settime(timer, 0, ctypes.byref(when), None)
            return timer
    return None


def _timers() -> ctypes.CDLL:
    """Return the library of timers: the C library itself since glibc 2.34."""
    return _LIBC if hasattr(_LIBC, "timer_create") else ctypes.CDLL("librt.so.1")
