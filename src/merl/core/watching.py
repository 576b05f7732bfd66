"""Let another process watch this one, and end this one in time: while C code holds the GIL.

Neither a signal handler of Python nor a thread runs then.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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
def signals_blocked() -> Iterator[None]:
    """Start processes in this block: they keep these signals blocked until they are prepared.

    The signals that this thread gets meanwhile arrive at the end of the block. SIGTERM is not
    blocked: it can end a process that is still starting.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING - {signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def new_log() -> int:
    """Return the descriptor of an empty file in memory, for `signal.set_wakeup_fd`.

    Raises:
        OSError: it cannot be made.
    """
    log: int = _LIBC.memfd_create(b"merl-signals", _MFD_CLOEXEC)  # `os` may lack it
    os.set_blocking(log, False)
    return log


@contextmanager
def watched(log: int, patience: float, text: str, *, waits: bool = False) -> Iterator[None]:
    """Let a process watch this one during the block, see `merl.core.watcher.watch`."""
    script = str(Path(__file__).with_name("watcher.py"))
    # A session of its own: Ctrl-C does not reach it.
    line = [sys.executable, "-I", "-S", script, str(os.getpid()), str(log), str(patience), text]
    process = None
    with suppress(OSError, subprocess.SubprocessError), signals_blocked():
        process = subprocess.Popen(
            [*line, str(int(waits))],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[log],
            start_new_session=True,
        )
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


@contextmanager
def ending(code: int, text: str) -> Iterator[None]:
    """End the process with an exit code if the block takes too long, and print a line then.

    The block may hang in C code, so another process prints and a thread of the C library ends this
    process.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    null = os.open(os.devnull, os.O_RDONLY)
    try:
        with watched(null, END_SECONDS, text, waits=True), _exit_after(END_SECONDS + _LAST, code):
            yield
    finally:
        os.close(null)


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


@contextmanager
def _exit_after(seconds: float, code: int) -> Iterator[None]:
    """Exit at once after some seconds, unless the block ends before; needs no GIL."""
    function = ctypes.cast(_LIBC._exit, ctypes.c_void_p)
    event = _Event(value=code, kind=_SIGEV_THREAD, function=function)
    whole, rest = divmod(seconds, 1.0)
    when = _Time(first=(int(whole), int(rest * 1e9)))
    timer, rt = ctypes.c_void_p(), ctypes.CDLL("librt.so.1")
    armed = rt.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0
    if armed:
        rt.timer_settime(timer, 0, ctypes.byref(when), None)
    try:
        yield
    finally:
        if armed:
            rt.timer_delete(timer)
