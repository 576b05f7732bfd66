"""Files that are not what they seem, to put in place of a file that a command reads."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def loop(path: Path) -> None:
    path.symlink_to(path)


def sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


def deep(path: Path) -> None:
    path.write_text("[" * 1_000_000)


def absurd(path: Path) -> None:
    path.write_text('{"format": 1e999, "step": ' + "9" * 4000 + ', "files": {}, "score": 1e999}')


def binary(path: Path) -> None:
    path.write_bytes(bytes(range(128, 256)) * 10)


DISGUISES = [pipe, device, folder, loop, sparse, deep, absurd, binary]


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Fail if the block hangs."""

    def fail(*_: object) -> None:
        raise AssertionError("a command hangs")

    former = signal.signal(signal.SIGALRM, fail)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)
