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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP])
def test_a_signal_is_a_wish_and_the_former_handler_comes_back(number: int) -> None:
    former = signal.getsignal(number)
    with Interrupt().listening() as interrupt:
        assert interrupt.number is None
        os.kill(os.getpid(), number)
        assert interrupt.number == number
    assert signal.getsignal(number) == former


def test_a_second_hangup_lets_it_save() -> None:
    with Interrupt().listening() as interrupt:
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGHUP)
        assert interrupt.number == signal.SIGHUP


def test_the_same_signal_to_process_and_group_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("merl.core.signals._APART", 600.0)  # as far apart as on a busy machine
    with Interrupt().listening() as interrupt:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.number == signal.SIGTERM


def test_what_is_ignored_stays_ignored() -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt().listening() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupt.number is None
    finally:
        signal.signal(signal.SIGHUP, former)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGUSR1])
def test_a_second_signal_ends_at_once(number: int) -> None:
    program = (
        "import os, time; from merl.core.signals import Interrupt\n"
        "with Interrupt().listening():\n"
        f"    for _ in range(2): os.kill(os.getpid(), {int(number)}); time.sleep(0.2)\n"
        "    print('never')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == 128 + number
    assert done.stdout == b""


def test_who_has_to_wait_is_told_for_what() -> None:
    program = (
        "import os, signal; from merl.core import signals\n"
        "signals.PATIENCE = %s\n"
        "with signals.Interrupt().listening() as interrupt:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    timer = interrupt._telling\n"
        "    if signals.PATIENCE < 1: timer.join()\n"
        "timer.join()"
    )
    for patience, told in ((0.1, 1), (600.0, 0)):
        done = subprocess.run(
            [sys.executable, "-c", program % patience], capture_output=True, check=True, text=True
        )
        assert done.stderr.count("a second signal (Ctrl-C) stops at once") == told


def test_where_no_thread_is_to_be_had_it_is_a_wish_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr("threading._start_new_thread", refused)
    monkeypatch.setattr("threading._start_joinable_thread", refused, raising=False)  # 3.13
    with Interrupt().listening() as interrupt:
        os.kill(os.getpid(), signal.SIGTERM)
        assert interrupt.number == signal.SIGTERM


SIGINT_TAKEN_OVER = {
    "by Python": lambda: signal.signal(signal.SIGINT, lambda *_: None),
    "by Python, ignored": lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    "by a C library": lambda: ctypes.CDLL(None).signal(int(signal.SIGINT), ctypes.c_void_p(1)),
}


@pytest.mark.parametrize("how", SIGINT_TAKEN_OVER)
def test_a_handler_that_is_taken_over_is_put_back(how: str) -> None:
    former = signal.getsignal(signal.SIGINT)
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            SIGINT_TAKEN_OVER[how]()
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.number == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) == former


def test_a_signal_that_another_handler_took_is_noted() -> None:
    taken: list[int] = []
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.signal(signal.SIGINT, lambda number, _: taken.append(number))
            os.kill(os.getpid(), signal.SIGUSR1)  # merl's own
            os.kill(os.getpid(), signal.SIGINT)
        assert taken == [signal.SIGINT]
        assert interrupt.number == signal.SIGUSR1
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.signal(signal.SIGINT, lambda number, _: taken.append(number))
            os.kill(os.getpid(), signal.SIGINT)
        assert interrupt.number == signal.SIGINT


def test_handlers_are_left_alone_in_another_thread() -> None:
    def call() -> None:
        with handlers_kept():
            done.append(True)

    done: list[bool] = []
    thread = threading.Thread(target=call)
    thread.start()
    thread.join()
    assert done == [True]


def test_a_call_that_takes_the_wakeup_descriptor_and_the_handler_loses_no_later_signal() -> None:
    with Interrupt().listening() as interrupt:
        with handlers_kept():
            signal.set_wakeup_fd(-1)
        with handlers_kept():
            signal.signal(signal.SIGUSR1, lambda *_: None)
            os.kill(os.getpid(), signal.SIGUSR1)
        assert interrupt.number == signal.SIGUSR1
