from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from merl.core.signals import Interrupt, handlers_kept
from merl.core.watcher import ENDING, REPEATED


@pytest.mark.parametrize("number", sorted(ENDING))
def test_a_signal_is_recorded_and_the_former_handler_is_restored(number: int) -> None:
    former = signal.getsignal(number)
    with Interrupt().listening() as interrupt:
        assert interrupt.number is None
        os.kill(os.getpid(), number)
        assert interrupt.number == number
    assert signal.getsignal(number) == former


@pytest.mark.parametrize("number", sorted(REPEATED))
def test_a_second_signal_of_the_system_does_not_end_the_process(number: int) -> None:
    with Interrupt().listening() as interrupt:
        os.kill(os.getpid(), number)
        time.sleep(0.2)
        os.kill(os.getpid(), number)
        assert interrupt.number == number


def test_one_signal_to_process_and_group_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("merl.core.signals._MIN_INTERVAL", 600.0)  # a busy machine is slow
    with Interrupt().listening() as interrupt:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.number == signal.SIGTERM


def test_an_ignored_signal_stays_ignored() -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt().listening() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupt.number is None
    finally:
        signal.signal(signal.SIGHUP, former)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT])
def test_a_second_signal_ends_the_process_immediately(number: int) -> None:
    program = (
        "import os, time; from merl.core.signals import Interrupt\n"
        "with Interrupt().listening():\n"
        f"    for _ in range(2): os.kill(os.getpid(), {int(number)}); time.sleep(0.2)\n"
        "    print('never')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == 128 + number
    assert done.stdout == b""


def test_a_second_signal_raises_in_an_interactive_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """It must not end a notebook's kernel, with all that it holds."""
    monkeypatch.setattr("merl.core.signals._MIN_INTERVAL", 0.0)
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    with Interrupt().listening() as interrupt:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.number == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_reminder_is_printed_after_some_seconds() -> None:
    program = (
        "import os, signal; from merl.core import signals\n"
        "signals.PATIENCE = %s\n"
        "with signals.Interrupt().listening() as interrupt:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    timer = interrupt._reminder\n"
        "    if signals.PATIENCE < 1: timer.join()\n"
        "timer.join()"
    )
    for patience, count in ((0.1, 1), (600.0, 0)):
        done = subprocess.run(
            [sys.executable, "-c", program % patience], capture_output=True, check=True, text=True
        )
        assert done.stderr.count("a second signal (Ctrl-C) stops at once") == count


def test_a_signal_is_recorded_if_no_thread_can_be_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("threading._start_new_thread", refused)
    monkeypatch.setattr("threading._start_joinable_thread", refused, raising=False)  # 3.13
    with Interrupt().listening() as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.number == signal.SIGTERM


HANDLER_REPLACED = {
    "by Python": lambda: signal.signal(signal.SIGINT, lambda *_: None),
    "by Python, ignored": lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    "by a C library": lambda: ctypes.CDLL(None).signal(int(signal.SIGINT), ctypes.c_void_p(1)),
}


@pytest.mark.parametrize("method", HANDLER_REPLACED)
def test_a_replaced_handler_is_restored(method: str) -> None:
    former = signal.getsignal(signal.SIGINT)
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            HANDLER_REPLACED[method]()
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.number == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) == former


def test_a_signal_that_another_handler_received_is_recorded() -> None:
    received: list[int] = []
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.signal(signal.SIGINT, lambda number, _: received.append(number))
            os.kill(os.getpid(), signal.SIGUSR1)  # handled by merl
            os.kill(os.getpid(), signal.SIGINT)
        assert received == [signal.SIGINT]
        assert interrupt.number == signal.SIGUSR1
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.signal(signal.SIGINT, lambda number, _: received.append(number))
            os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.number == signal.SIGINT


def test_handlers_kept_has_no_effect_in_another_thread() -> None:
    def call() -> None:
        with handlers_kept():
            done.append(True)

    done: list[bool] = []
    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    assert done == [True]


def test_no_signal_is_lost_after_a_call_replaced_the_wakeup_descriptor() -> None:
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.set_wakeup_fd(-1)
        with handlers_kept():
            signal.signal(signal.SIGUSR1, lambda *_: None)
            os.kill(os.getpid(), signal.SIGUSR1)
        assert interrupt.number == signal.SIGUSR1
