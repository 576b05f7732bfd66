"""Processes that hang in C code, with or without the GIL, are watched from outside."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import psutil
import pytest

from helpers import wait_for
from merl.core.signals import PATIENCE
from merl.core.watching import END_SECONDS, signals_blocked

HANG = """
import ctypes, os, signal, sys, threading, time
from merl.core import signals, watching

def hang(library):
    # A thread that locks a mutex twice waits for ever, whatever signals arrive.
    mutex = ctypes.create_string_buffer(64)
    for _ in range(2):
        library(None).pthread_mutex_lock(mutex)

held, free = ctypes.PyDLL, ctypes.CDLL
"""
LISTENING = """
with signals.Interrupt().listening():
    print("ready", flush=True)
    hang({})
"""


@contextmanager
def running(program: str) -> Iterator[subprocess.Popen[str]]:
    """Start a Python program that prints a line when it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", HANG + program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stderr is not None
    return process.stderr.readline()


def test_a_handler_that_raises_is_called_after_the_start_of_a_process() -> None:
    def start() -> None:
        with signals_blocked():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
            begun.append(True)

    begun: list[bool] = []
    other = threading.Thread(target=time.sleep, args=(0.5,))  # it may receive the signal
    other.start()
    with pytest.raises(KeyboardInterrupt):
        start()
    assert begun
    other.join()


def is_gone(process: psutil.Process) -> bool:
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize("gil", ["held", "free"])
def test_a_hang_in_c_is_reported_and_ended_by_a_second_signal(gil: str) -> None:
    with running("signals.PATIENCE = 0.4" + LISTENING.format(gil)) as process:
        process.send_signal(signal.SIGINT)
        assert "a second signal (Ctrl-C) stops at once" in line_of(process)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == -signal.SIGKILL


@pytest.mark.long
def test_a_hang_in_c_is_reported_after_three_seconds() -> None:
    with running(LISTENING.format("held")) as process:
        begin = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert "a second signal (Ctrl-C) stops at once" in line_of(process)
        assert PATIENCE <= time.monotonic() - begin < PATIENCE + 2.0


def test_repeated_signals_of_one_cause_do_not_end_a_hanging_process() -> None:
    with running("signals.PATIENCE = 0.9" + LISTENING.format("held")) as process:
        process.send_signal(signal.SIGTERM)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.5)
        for number in (signal.SIGHUP, signal.SIGXCPU):  # sent more than once by the system
            process.send_signal(number)
        assert "a second signal" in line_of(process)
        assert process.poll() is None


def test_the_watching_process_ends_with_its_parent_and_not_by_signals() -> None:
    with running(LISTENING.format("free")) as process:
        (watcher,) = psutil.Process(process.pid).children()
        wait_for(lambda: watcher.name().startswith("python") and len(watcher.cmdline()) > 5)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1):
            watcher.send_signal(number)
        time.sleep(0.3)
        assert not is_gone(watcher)
        process.kill()
        wait_for(lambda: is_gone(watcher))


@pytest.mark.parametrize(
    ("crash", "told"),
    [
        ("file.truncate(0)\n    mapped[0] = 1", "(SIGBUS): its disk failed or is full, or another"),
        ("os.abort()", "C code crashed (Aborted); merl check"),
        ("ctypes.string_at(0)", "C code crashed (Segmentation fault); merl check"),
    ],
)
def test_a_crash_of_c_code_is_one_line_that_names_the_place(crash: str, told: str) -> None:
    program = f"""
import mmap, tempfile
file = tempfile.TemporaryFile()
file.truncate(4096)
mapped = mmap.mmap(file.fileno(), 4096)
with signals.Interrupt().listening():
    print("ready", flush=True)
    {crash}
"""
    with running(program) as process:
        _, err = process.communicate(timeout=20)
    assert process.returncode in (-signal.SIGBUS, -signal.SIGABRT, -signal.SIGSEGV)
    (line,) = err.splitlines()
    assert line.startswith("merl: error: File ")
    assert told in line


def test_a_process_that_is_killed_has_no_line_of_a_crash() -> None:
    with running(LISTENING.format("free")) as process:
        process.kill()
        assert process.communicate(timeout=20)[1] == ""


@pytest.mark.parametrize("where", ["session", "thread"])
def test_no_process_watches_an_interactive_session_or_another_thread(where: str) -> None:
    program = """
def listen():
    with signals.Interrupt().listening():
        print("ready", flush=True)
        sys.stdin.read()
"""
    end = {
        "session": "sys.ps1 = '>>> '\nlisten()",
        "thread": "threading.Thread(target=listen, daemon=True).start()\ntime.sleep(1000)",
    }
    with running(program + end[where]) as process:
        assert psutil.Process(process.pid).children() == []


@pytest.mark.parametrize(("gil", "code"), [("held", 0), ("free", 143)])
def test_an_end_that_hangs_is_cut_with_the_exit_code(gil: str, code: int) -> None:
    program = f"""
watching.END_SECONDS = 0.2
print("ready")
with watching.ending({code}, "close() hangs"):
    hang({gil})
"""
    with running(program) as process:
        assert process.wait(30) == code
        assert process.stderr is not None
        assert process.stderr.read() == "close() hangs\n"


def test_an_end_that_crashes_is_one_line() -> None:
    program = "print('ready')\nwith watching.ending(0, 'it hangs'): ctypes.string_at(0)"
    with running(program) as process:
        _, err = process.communicate(timeout=20)
    assert process.returncode == -signal.SIGSEGV
    (line,) = err.splitlines()
    assert "C code crashed (Segmentation fault)" in line


@pytest.mark.long
def test_an_end_that_hangs_takes_at_most_ten_seconds() -> None:
    begin = time.monotonic()
    with running("print('ready')\nwith watching.ending(3, 'it hangs'): hang(held)") as process:
        assert process.wait(30) == 3
        assert END_SECONDS <= time.monotonic() - begin <= 10.0 + 0.5  # the start of Python


def test_an_end_in_time_is_not_cut() -> None:
    program = """
watching.END_SECONDS = 0.3
with watching.ending(3, "it hangs"):
    pass
print("ready", flush=True)
time.sleep(0.8)
"""
    with running(program) as process:
        assert process.wait(30) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""


def test_a_thread_without_end_does_not_keep_the_process_alive() -> None:
    program = """
watching.END_SECONDS = 0.2
threading.Thread(target=lambda: time.sleep(1000), name="camera").start()
print("ready", flush=True)
watching.end_soon(5)
sys.exit(5)
"""
    with running(program) as process:
        assert process.wait(30) == 5
        assert process.stderr is not None
        assert process.stderr.read() == (
            "merl: warning: ended without waiting for thread camera, which did not end within "
            "0.2 s\n"
        )
