"""Helpers of several tests: read output, and wait for a run."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable


def flat(text: str) -> str:
    """Return the text with single spaces, so that line wraps of a terminal do not matter."""
    return " ".join(text.split())


def wait_for(condition: Callable[[], object], process: subprocess.Popen[str] | None = None) -> None:
    """Wait until `condition()` is true.

    Args:
        condition: called repeatedly.
        process: the process that makes the condition true; its end is a failure.

    Raises:
        AssertionError: the process ended before the condition was true, or the condition was not
            true within five minutes, which is long enough on a busy machine.
    """
    deadline = time.monotonic() + 300
    while not condition():
        if process is not None and process.poll() is not None and not condition():
            raise AssertionError(f"the process ended with exit code {process.returncode}")
        assert time.monotonic() < deadline, "the condition was not true within five minutes"
        time.sleep(0.01)
