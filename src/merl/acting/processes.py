"""Worker processes that start undisturbed by signals and that never outlive the run.

They do not run the user's script again: a script needs no `if __name__ == "__main__":`.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import resource_tracker, util
from multiprocessing.synchronize import SemLock
from types import ModuleType
from typing import Any

from gymnasium.vector import AsyncVectorEnv
from gymnasium.vector.async_vector_env import _async_worker

from merl.core.watcher import ENDING
from merl.core.watching import end_with_parent, signals_blocked

_IGNORED_SIGNALS = ENDING - {signal.SIGTERM}
"""Signals that workers ignore: a terminal or a batch system sends them to the workers, too, but the
workers must continue until the run has saved and ends them. SIGTERM ends a worker."""


@contextmanager
def _main_module_hidden() -> Iterator[None]:
    """Keep processes that are spawned in the block from importing the main module.

    They do not need it: functions and classes of a script are sent to them by value.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")  # without a file
    try:
        yield
    finally:
        sys.modules["__main__"] = main


class Processes(AsyncVectorEnv):
    """Environments in worker processes, each of which calls `belong_to`.

    If this process is killed, nothing stays behind in `/dev/shm`, unless the processes were still
    starting.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        finalizers = util._finalizer_registry  # type: ignore[attr-defined]
        unlink = SemLock._cleanup  # type: ignore[attr-defined]
        before = {*finalizers}
        with signals_blocked():  # it keeps them blocked: they must not end it
            resource_tracker.ensure_running()
        with ExitStack() as self._starting:
            self._starting.enter_context(signals_blocked(_IGNORED_SIGNALS))
            self._starting.enter_context(_main_module_hidden())
            try:
                super().__init__(*args, **{**options, "worker": _work})
            except BaseException:
                self._kill()
                raise
        # All processes have opened the semaphores, which no longer need names.
        for key in {*finalizers} - before:
            if finalizers[key]._callback is unlink:
                finalizers[key]()

    def _kill(self) -> None:
        """End the processes; then there is nothing to close."""
        self.closed = True
        for process in getattr(self, "processes", ()):
            if process.pid is not None:  # it was started
                process.kill()
                process.join()

    def _check_spaces(self) -> None:
        """Wait for the processes, which were all started before."""
        self._starting.close()
        super()._check_spaces()  # type: ignore[no-untyped-call]


def _work(*args: Any) -> None:
    """Run Gymnasium's loop of a worker process, which is silent if the run is killed.

    The system closes the run's pipes a moment before it kills this process.
    """
    try:
        _async_worker(*args)
    except (EOFError, ConnectionError):
        os._exit(1)


def belong_to(run: int) -> None:
    """Prepare a worker process: it ends with the process of the run, and other signals do not."""
    end_with_parent(signal.SIGKILL)
    if os.getppid() != run:  # it has ended before
        os._exit(1)
    for number in _IGNORED_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _IGNORED_SIGNALS)
