"""Failing file operations: a child process in which the k-th operation in a folder fails or kills.

`with_faults(action, Faults(folder, at, code, lasts))` runs `action()` in a forked child, which has
what this process has imported, and counts every operation on a file in `folder`: opening, reading,
writing, flushing, renaming, removing, truncating, mapping, listing, and asking for its status.
Operation number `at`, or all from that one on if `lasts`, raises an OSError with `code`, or kills
the process.
"""

from __future__ import annotations

import builtins
import io
import mmap
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TextIO

_AUDITED = {
    "open": (0,),
    "os.rename": (0, 1),
    "os.remove": (0,),
    "os.rmdir": (0,),
    "os.mkdir": (0,),
    "os.truncate": (0,),
    "os.listdir": (0,),
    "os.scandir": (0,),
    "mmap.__new__": (0,),
    "fcntl.flock": (0,),
}
"""Events of `sys.addaudithook` before operations on files: the places of their paths."""
_WRAPPED = ("fsync", "write", "pwrite", "posix_fallocate", "stat", "lstat")
"""Functions of `os` that Python does not audit; their first argument is a path or a descriptor."""
_READING = {"open for reading", "stat", "lstat", "os.listdir", "os.scandir", "read"}
"""Operations that a read-only or a full disk allows."""


@dataclass
class Faults:
    """Failures of the operations on files in a folder.

    Attributes:
        folder: the folder.
        at: number of the first operation that fails, from 1; 0: none, they are only counted.
        code: the number of the error, e.g. `errno.EROFS`; 0: the process is killed (SIGKILL).
        lasts: whether all later operations fail, too.
        writing: whether only operations that change the folder are counted, as on a disk that is
            full or read-only.
        names: the operations so far.
    """

    folder: Path
    at: int = 0
    code: int = 0
    lasts: bool = False
    writing: bool = False
    names: list[str] = field(default_factory=list)

    def check(self, name: str, *paths: Any) -> None:
        """Count an operation.

        Raises:
            OSError: it fails.
        """
        found = next((path for path in map(_path, paths) if self._holds(path)), None)
        if found is None or (self.writing and name in _READING):
            return
        self.names.append(f"{name} {os.path.relpath(found, self.folder)}")
        count = len(self.names)
        if count == self.at or (self.lasts and 0 < self.at < count):
            if self.code == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            raise OSError(self.code, os.strerror(self.code), found)

    def _holds(self, path: str) -> bool:
        return path == str(self.folder) or path.startswith(f"{self.folder}/")

    def install(self) -> None:
        """Watch the operations of this process until its end."""
        sys.addaudithook(self._audit)
        for name in _WRAPPED:
            setattr(os, name, self._wrapped(name, getattr(os, name)))
        check = self.check

        class Map(mmap.mmap):
            """A map whose flush is counted; `path` is that of its file."""

            path: str

            def __new__(cls, fileno: int, *args: Any, **options: Any) -> Map:
                made = super().__new__(cls, fileno, *args, **options)
                made.path = _path(fileno)
                return made

            def flush(self, *args: Any) -> None:
                check("flush", self.path)
                super().flush(*args)

        class File(io.FileIO):
            """A file whose reads, writes and truncation are counted."""

            def readinto(self, buffer: Any) -> int | None:
                check("read", self.name)
                return super().readinto(buffer)

            def readall(self) -> Any:
                check("read", self.name)
                return super().readall()

            def write(self, data: Any) -> Any:
                check("write", self.name)
                return super().write(data)

        def opened(
            file: Any, mode: str = "r", buffering: int = -1, *args: Any, **options: Any
        ) -> Any:
            if not isinstance(file, int) and self._holds(_path(file)):
                raw = File(file, mode.replace("b", "").replace("t", ""))
                if buffering == 0:
                    return raw
                if "+" in mode:
                    binary: Any = io.BufferedRandom(raw)
                else:
                    binary = (io.BufferedReader if "r" in mode else io.BufferedWriter)(raw)
                return binary if "b" in mode else io.TextIOWrapper(binary, *args, **options)
            return original(file, mode, buffering, *args, **options)

        original = io.open
        mmap.mmap, io.FileIO = Map, File  # type: ignore[misc]
        io.open = builtins.open = opened

    def _audit(self, event: str, args: tuple[Any, ...]) -> None:
        places = _AUDITED.get(event)
        if places is None:
            return
        if event == "open" and isinstance(args[2], int):
            changes = args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            event = "open for writing" if changes else "open for reading"
        self.check(event, *(args[place] for place in places))

    def _wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def checked(path: Any, *args: Any, **options: Any) -> Any:
            self.check(name, path)
            return function(path, *args, **options)

        return checked


def _path(path: Any) -> str:
    """Return the absolute path of a path or of a descriptor; nothing for any other argument."""
    try:
        if isinstance(path, int):
            return str(Path(f"/proc/self/fd/{path}").readlink())
        return str(Path.cwd() / os.fsdecode(path))
    except (OSError, TypeError):
        return ""


class Ended(NamedTuple):
    """A child that has ended: its exit code, what it printed, and its operations."""

    code: int
    out: str
    err: str
    names: list[str]


def with_faults(action: Callable[[], int], faults: Faults | None = None) -> Ended:
    """Run `action`, which returns an exit code, in a child process with faults."""
    with ExitStack() as stack:
        out, err, names = (stack.enter_context(tempfile.TemporaryFile("w+")) for _ in range(3))
        pid = os.fork()
        if pid == 0:
            _run(action, faults or Faults(Path(os.devnull)), out, err, names)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        for file in (out, err, names):
            file.seek(0)
        return Ended(code, out.read(), err.read(), names.read().splitlines())


def _run(
    action: Callable[[], int], faults: Faults, out: TextIO, err: TextIO, names: TextIO
) -> NoReturn:
    """Run the action, with its output in files, and end this process."""
    os.dup2(out.fileno(), 1)
    os.dup2(err.fileno(), 2)
    sys.stdout, sys.stderr = out, err
    code = 70
    try:
        faults.install()
        code = action()
    except BaseException:
        traceback.print_exc()
    finally:
        names.write("\n".join(faults.names))
        for file in (out, err, names):
            file.flush()
        os._exit(code)
