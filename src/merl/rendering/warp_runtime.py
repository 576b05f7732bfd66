"""Start Warp: silent, with CPU compiler flags, and with a folder for its compiled kernels."""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from merl.core import MerlError
from merl.core.files import remove
from merl.core.resources import reserve_file
from merl.core.user_code import in_one_line

_COMPILER_FLAGS = "-menable-no-nans -fno-signed-zeros -Wno-nan-infinity-disabled"
"""Flags that cut the time to a quarter with identical images: the kernels never produce NaN."""
_ROOM = 8 << 20
"""Bytes that must be free for compiled kernels: if the disk is full, LLVM ends the process."""
_MODULES = "merl.rendering.raster."
Loaded = TypeVar("Loaded")
_warp_lock = threading.RLock()


def start_warp() -> Any:
    """Return the module warp, silent and with a folder for its compiled kernels."""
    with _warp_lock:
        _configure_warp()
        return importlib.import_module("warp")


@cache
def _configure_warp() -> None:
    """Configure Warp, once per process, even if another module has imported it before."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    if warp.config.kernel_cache_dir is None:  # else the calling program has set it
        warp.config.kernel_cache_dir = str(_kernel_cache())
    flags = warp.config.cpu_compiler_flags
    # With None, too, Warp compiles for this processor.
    base_flags = "-march=native" if flags is None else flags
    warp.config.cpu_compiler_flags = f"{base_flags} {_COMPILER_FLAGS}"
    with _silent_stderr():  # Warp's C code reports a missing NVIDIA driver
        warp.init()  # type: ignore[no-untyped-call]


@contextmanager
def compiling(seconds: float = 2.0) -> Iterator[threading.Thread]:
    """Let one thread at a time compile or load kernels, because Warp crashes if several do.

    Print a notice to stderr if this takes more than `seconds` of processor time. Loading kernels
    that are already compiled takes less, even on a busy machine.

    Yields:
        The thread that prints the notice.
    """
    with _warp_lock, _notice_if_slow(seconds) as watching:
        yield watching


def load_kernels(load: Callable[[], Loaded]) -> Loaded:
    """Return `load()`, which compiles kernels or loads them from the cache, in `compiling`.

    If it fails, the files in the cache may be damaged, or its disk may be full. It is then called
    again after merl's kernels were removed from the cache, and at last with a temporary folder.

    Raises:
        MerlError: it fails even then.
    """
    for prepare in (None, _empty_cache, _leave_cache):
        try:
            if prepare is not None:
                prepare()
            return load()
        except Exception as error:  # Warp has no class of its own for its errors
            failure = error
    raise MerlError(
        f"the renderer's kernels cannot be compiled: {in_one_line(failure)}: free space in the "
        "folder of temporary files (TMPDIR), or use --renderer gl"
    ) from failure


def _empty_cache() -> None:
    """Remove merl's kernels from the cache."""
    import warp

    for folder in Path(str(warp.config.kernel_cache_dir)).glob(f"wp_{_MODULES}*"):
        remove(folder)
    for name in [name for name in sys.modules if name.startswith(_MODULES)]:
        module: Any = warp.get_module(name)
        module.mark_modified()  # else Warp only repeats the failure


def _leave_cache() -> None:
    """Use a folder that ends with this process."""
    import warp

    folder = tempfile.mkdtemp(prefix="merl-warp-")
    atexit.register(remove, Path(folder))
    warp.config.kernel_cache_dir = folder
    _empty_cache()


@contextmanager
def _notice_if_slow(seconds: float) -> Iterator[threading.Thread]:
    begin, is_over = time.process_time(), threading.Event()

    def watch() -> None:
        while not is_over.wait(0.1):
            if time.process_time() - begin > seconds:
                print("merl: compiling the renderer (only once, 5 to 20 s)", file=sys.stderr)
                return

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield watching
    finally:
        is_over.set()


def _kernel_cache() -> Path:
    """Return a folder of this user with room: in the user's cache, else among temporary files."""
    candidates = [Path(tempfile.gettempdir()) / f"merl-warp-{os.getuid()}"]
    with suppress(RuntimeError):  # the user may have no home
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        candidates.insert(0, home / "merl" / "warp")
    if "WARP_CACHE_PATH" in os.environ:
        candidates.insert(0, Path(os.environ["WARP_CACHE_PATH"]))
    for folder in candidates:
        with suppress(OSError):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            probe = folder / f".part-{os.getpid()}"
            try:
                reserve_file(probe, _ROOM)
            finally:
                remove(probe)
            if folder.stat().st_uid == os.getuid():  # only run this user's code
                return folder
    return Path(tempfile.mkdtemp(prefix="merl-warp-"))


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """Discard everything that C libraries write to stderr."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
