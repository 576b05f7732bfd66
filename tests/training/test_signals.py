from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from merl.training.signals import Interrupt


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_a_wish_and_the_former_handler_comes_back(number: int) -> None:
    former = signal.getsignal(number)
    with Interrupt().listening() as interrupt:
        assert interrupt.number is None
        os.kill(os.getpid(), number)
        assert interrupt.number == number
    assert signal.getsignal(number) == former


def test_a_second_hangup_lets_it_save() -> None:
    with Interrupt().listening() as interrupt:
        for number in (signal.SIGHUP, signal.SIGHUP, signal.SIGTERM):
            os.kill(os.getpid(), number)
        assert interrupt.number == signal.SIGHUP


def test_what_is_ignored_stays_ignored() -> None:
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupt().listening() as interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert interrupt.number is None
    finally:
        signal.signal(signal.SIGHUP, former)


def test_a_second_interrupt_ends_at_once() -> None:
    program = (
        "import os, signal; from merl.training.signals import Interrupt\n"
        "with Interrupt().listening():\n"
        "    for _ in range(2): os.kill(os.getpid(), signal.SIGINT)\n"
        "    print('never')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert done.returncode == 130
    assert done.stdout == b""
