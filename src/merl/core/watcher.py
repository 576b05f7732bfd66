"""Watch the signals of the parent process, which cannot react while C code of its own hangs.

`merl.core.watching` runs this file as a script, without merl and with few imports, in a process of
its own. It ends with its parent.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress

ENDING = frozenset(
    {
        signal.SIGINT,
        signal.SIGTERM,
        signal.SIGQUIT,
        signal.SIGUSR1,
        signal.SIGUSR2,
        signal.SIGHUP,
        signal.SIGXCPU,
    }
)
"""The signals that ask a run to stop."""
REPEATED = frozenset({signal.SIGHUP, signal.SIGXCPU})
"""A closed terminal sends SIGHUP twice, and the kernel sends SIGXCPU every second: the second one
must not interrupt saving."""
TOLD = b"\0"
"""What the parent writes between its signals when it has printed the text itself."""
_LOOK = 0.1
"""Seconds between two looks at the signals."""
_DUPLICATE = 0.25
"""Seconds within which a second signal is ignored, see `merl.core.signals`; a look is late."""
_GRACE = 0.5
"""Seconds after a second signal in which the parent may end by itself, with its own exit code."""
_BUS_ERROR = "its disk failed or is full, or another process has truncated it"


def watch(parent: int, log: int, crash: int, patience: float, text: str, waits: bool) -> None:
    """Watch a process until it ends; kill it after a second signal if it does not end by itself.

    If C code of it crashed, print a line about it.

    Args:
        parent: the process.
        log: descriptor of a file to which the process's signals are appended, one byte each.
        crash: descriptor of a file to which Python's `faulthandler` writes.
        patience: seconds after the first signal until `text` is printed.
        text: what to print.
        waits: print `text` after `patience` seconds from now on, without a signal.
    """
    position, told, begin = 0, False, time.monotonic()
    first = second = None
    while os.getppid() == parent:
        now, new = time.monotonic(), os.pread(log, 4096, position)
        position, numbers = position + len(new), ENDING.intersection(new)
        if numbers and first is None:
            first = now
        elif numbers - REPEATED and first is not None and now - first > _DUPLICATE:
            second = second or now
        since, told = begin if waits else first, told or TOLD in new
        if not told and since is not None and now - since > patience:
            told = True
            with suppress(OSError):
                os.write(2, f"{text}\n".encode())
        if second is not None and now - second > _GRACE:
            os.kill(parent, signal.SIGKILL)
        time.sleep(_LOOK)
    if description := os.pread(crash, 4096, 0).decode(errors="replace"):
        with suppress(OSError):
            os.write(2, f"{crash_line(description)}\n".encode())


def crash_line(description: str) -> str:
    """Return a line about a crash from what `faulthandler` has written about it."""
    lines = description.splitlines()
    place = next((line.strip() for line in lines if line.startswith("  File ")), "an unknown place")
    if lines[0].endswith("Bus error"):
        what = f"{place}: a file in memory cannot be read or written (SIGBUS): {_BUS_ERROR}"
    else:
        what = f"{place}: C code crashed ({lines[0].rpartition(': ')[2]})"
    return f"merl: error: {what}; merl check tells what is damaged, and merl resume continues a run"


if __name__ == "__main__":
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    parent, log, crash = map(int, sys.argv[1:4])
    watch(parent, log, crash, float(sys.argv[4]), sys.argv[5], sys.argv[6] == "1")
