"""How Warp is started: silenced, on the CPU, with a folder for its compiled kernels."""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

_COMPILER_FLAGS = "-menable-no-nans -fno-signed-zeros -Wno-nan-infinity-disabled"
"""A quarter of the time, pixel for pixel the same picture: nothing there is ever NaN."""
_warp_lock = threading.RLock()


def start_warp() -> Any:
    """Return the module warp, silenced and with a place for its compiled kernels."""
    with _warp_lock:
        _configure_warp()
        return importlib.import_module("warp")


@cache
def _configure_warp() -> None:
    """Configure Warp, once in a process, whether or not another module has imported it before."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    if warp.config.kernel_cache_dir is None:  # else a program that uses merl has chosen
        warp.config.kernel_cache_dir = str(_kernel_cache())
    flags = warp.config.cpu_compiler_flags
    own = "-march=native" if flags is None else flags  # None: for this processor, too
    warp.config.cpu_compiler_flags = f"{own} {_COMPILER_FLAGS}"
    with _silent_stderr():  # without an NVIDIA driver Warp says so, past Python
        warp.init()  # type: ignore[no-untyped-call]


@contextmanager
def compiling(seconds: float = 2.0) -> Iterator[threading.Thread]:
    """Let one thread at a time compile or load kernels, since Warp crashes where several do.

    Says so on stderr if this takes more than `seconds` of processor time: loading what is compiled
    already takes fewer, also on a busy machine.

    Yields:
        The thread that says it.
    """
    with _warp_lock, _told_if_it_takes_long(seconds) as watching:
        yield watching


@contextmanager
def _told_if_it_takes_long(seconds: float) -> Iterator[threading.Thread]:
    begin, is_over = time.process_time(), threading.Event()

    def watch() -> None:
        while not is_over.wait(0.1):
            if time.process_time() - begin > seconds:
                print("merl: compiling the renderer, once, for 5 to 20 s", file=sys.stderr)
                return

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield watching
    finally:
        is_over.set()


def _kernel_cache() -> Path:
    """A folder of our own that can be written: in the user's cache, else among temporary files."""
    ring_index = [Path(tempfile.gettempdir()) / f"merl-warp-{os.getuid()}"]
    with suppress(RuntimeError):  # there may be no home
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        ring_index.insert(0, home / "merl" / "warp")
    if "WARP_CACHE_PATH" in os.environ:
        ring_index.insert(0, Path(os.environ["WARP_CACHE_PATH"]))
    for place in ring_index:
        with suppress(OSError):
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place):
                if place.stat().st_uid == os.getuid():  # code is loaded from here
                    return place
    return Path(tempfile.mkdtemp(prefix="merl-warp-"))


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Send what C libraries write to stderr nowhere."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
