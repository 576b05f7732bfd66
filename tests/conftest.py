"""Fixtures of all tests, and the rule that a skip needs a listed reason."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Iterator

import pytest
import torch

from merl.core import MerlError
from merl.core.watcher import ENDING
from merl.rendering.opengl import enable_opengl

# Environment of the processes that tests start: they share the cores with other tests, and their
# output must not depend on the terminal.
os.environ |= {"OMP_NUM_THREADS": "1", "COLUMNS": "80", "LINES": "25", "TERM": "xterm"}
for _name in ("FORCE_COLOR", "NO_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
    os.environ.pop(_name, None)

ALLOWED_SKIPS = (
    r"no OpenGL library works on this machine",
    r"this machine has CUDA",
    r"this machine has no CUDA device",
    r"no Chromium on this machine",
    r"(timm|gymnasium-robotics) is not installed",
    r"this system does not allow users to mount a disk",
    r"could not import '(tensorboard|wandb|trackio|nbclient|ipykernel|onnxruntime)",
)
"""Regular expressions of the allowed reasons to skip a test; any other skip is a failure."""


@pytest.fixture(autouse=True, scope="session")
def _temporary_run_records(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the records of trained runs in a temporary folder, not in the home folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True, scope="session")
def _curves_are_not_drawn() -> Iterator[None]:
    """Leave out a run's last figure, a third of the time of a run of seconds.

    Runs in processes of their own draw theirs; so does the run of tests/cli/test_cli.py.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("merl.report.figures.learning_curve", lambda run, output, **_: output)
        yield


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread: tests run in parallel on small tensors, so more threads are slower."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip a test on a machine without OpenGL."""
    try:
        enable_opengl()
    except MerlError:
        pytest.skip("no OpenGL library works on this machine")


@pytest.fixture(autouse=True)
def _no_signal_is_ignored() -> Iterator[None]:
    """Reset ignored signals (nohup, background jobs), since merl leaves them ignored."""
    ignored = [number for number in ENDING if signal.getsignal(number) == signal.SIG_IGN]
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
    """Return the report, as a failure if it is a skip without an allowed reason."""
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if not any(re.search(allowed, reason) for allowed in ALLOWED_SKIPS):
            report.outcome = "failed"
            report.longrepr = f"skipped for a reason that is not on the list: {reason}"
    return report
