"""What several tests need to read output and to wait for a run."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable


def flat(text: str) -> str:
    """The text with single spaces, so that it does not matter where a terminal wraps its lines."""
    return " ".join(text.split())


def wait_for(happens: Callable[[], object], process: subprocess.Popen[str] | None = None) -> None:
    """Wait until `happens()` is true.

    Args:
        happens: asked again and again.
        process: what is waited for happens in it: its end is a failure.

    Raises:
        AssertionError: the process ended before it happened, or nothing happened for five minutes,
            which a busy machine does not need.
    """
    deadline = time.monotonic() + 300
    while not happens():
        if process is not None and process.poll() is not None and not happens():
            raise AssertionError(f"the process ended with exit code {process.returncode}")
        assert time.monotonic() < deadline, "it took too long"
        time.sleep(0.01)
