"""What every test shares; and the rule that no test is skipped in silence."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator

import pytest
import torch

# For the processes that tests start: two test processes share two cores, and what a command prints
# must not depend on the terminal that the tests are run in.
os.environ |= {"OMP_NUM_THREADS": "1", "COLUMNS": "80", "LINES": "25", "TERM": "xterm"}
for _name in ("FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
    os.environ.pop(_name, None)

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP)
ALLOWED_SKIPS = (
    r"no OpenGL library works on this machine",
    r"this machine has CUDA",
    r"this system lets nobody mount a disk of their own",
)
"""Reasons, as regular expressions, for which a test may be skipped; any other skip is a failure."""


@pytest.fixture(autouse=True, scope="session")
def _records_of_their_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The records of trained runs, which a user has in the home folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Tests share two cores and small tensors: threads would only get in each other's way."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def _no_signal_is_ignored() -> Iterator[None]:
    """Merl heeds no signal that it was started to ignore: as under nohup, and in the background."""
    ignored = [number for number in SIGNALS if signal.getsignal(number) == signal.SIG_IGN]
    for number in ignored:
        is_ctrl_c = number == signal.SIGINT
        signal.signal(number, signal.default_int_handler if is_ctrl_c else signal.SIG_DFL)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    return _checked((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    return _checked((yield))


def _checked(report):
    """The report; a failure if it is a skip for a reason that is not on the list."""
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not any(re.search(allowed, reason) for allowed in ALLOWED_SKIPS):
            report.outcome = "failed"
            report.longrepr = f"skipped for a reason that is not on the list: {reason}"
    return report
