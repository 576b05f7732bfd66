"""File of an actor's timesteps, until the learner has saved them.

A timestep is in the file before it is sent. It is removed once a checkpoint of the learner holds
it, so neither a killed actor nor a killed learner loses it.
"""

from __future__ import annotations

import fcntl
import json
import os
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path

from merl.core import MerlError, counted
from merl.core.files import cause, entries, replace_file, reporting, sync

_ABOUT, _LOCK, _SUFFIX = "spool.json", "lock", ".steps"


class Spool:
    """Timesteps `first` to `last` of an actor, in the files of a folder.

    A file holds consecutive timesteps, and its name is the number of the first of them.

    Attributes:
        folder: the folder.
        id: the actor's name, random; the learner keeps a ring of its replay for it.
        run: the run to which the timesteps belong; None before the first connection.
        first: the oldest timestep that is kept.
        last: the newest timestep.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._lock = folder, threading.Lock()
        self.id, self._done = uuid.uuid4().hex, False
        self.run: str | None = None
        self.first, self.last = 1, 0
        self._size, self._file, self._begin = 0, -1, 1
        try:
            about = json.loads((folder / _ABOUT).read_text())
            self.id, self.run, self._done = str(about["id"]), about["run"], bool(about["done"])
        except FileNotFoundError:
            self._write_about()
        except (OSError, ValueError, KeyError, TypeError):
            raise MerlError(
                f"{folder / _ABOUT} cannot be read: name another folder with --spool"
            ) from None

    @classmethod
    @contextmanager
    def open(cls, folder: Path) -> Iterator[Spool]:
        """Open a folder, or create it, and lock it.

        Raises:
            MerlError: another actor uses it, or it cannot be used.
        """
        with ExitStack() as stack:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((folder / _LOCK).open("a"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                spool = cls(folder)
            except BlockingIOError:
                raise MerlError(
                    f"another actor uses {folder}: give each actor its own folder with --spool"
                ) from None
            except OSError as error:
                raise MerlError(f"spool {folder} cannot be used: {cause(error)}") from error
            stack.callback(spool.close)
            yield spool

    def belong_to(self, run: str) -> None:
        """Let the spool belong to a run: what is left of a finished run is removed.

        Raises:
            MerlError: it holds timesteps of another run.
        """
        if self.run == run:
            return
        if self.run is not None:
            with self._reporting():
                count = sum(file.stat().st_size > 0 for file in self._files())
            if count and not self._done:
                raise MerlError(
                    f"{self.folder} holds timesteps of another run: connect to the learner of that "
                    "run, or name another folder with --spool"
                )
            with self._reporting():
                for file in self._files():
                    file.unlink()
            self.id = uuid.uuid4().hex
        self.run, self._done = run, False
        self._write_about()

    def start(self, received: int, size: int, number: Callable[[bytes], int | None]) -> None:
        """Find the timesteps of the folder, of which the learner has `received`.

        Args:
            received: number of the newest timestep that the learner has.
            size: bytes of a timestep.
            number: returns the number of a timestep; None if its bytes are not intact.

        Raises:
            MerlError: the folder and the learner do not fit together.
        """
        self._size = size
        with self._reporting():
            files = self._files()
            if files:  # the machine may have lost power while it wrote the last one
                _cut(files[-1], size, number)
            ends = [int(file.stem) + file.stat().st_size // size for file in files]
        self.first = int(files[0].stem) if files else received + 1
        self.last = ends[-1] - 1 if files else received
        if any(end != int(file.stem) for end, file in zip(ends, files[1:], strict=False)):
            raise MerlError(f"{self.folder} lacks timesteps: name another folder with --spool")
        if received > self.last:
            raise MerlError(
                f"{self.folder} ends at timestep {self.last:,}, but the learner has {received:,} "
                "of this actor: it is an old copy; name another folder with --spool"
            )
        if received < self.first - 1:
            raise MerlError(
                f"the learner resumed from an older checkpoint, and timesteps {received + 1:,} to "
                f"{self.first - 1:,} are no longer in {self.folder}: name another folder with "
                f"--spool; those and the {counted(len(self), 'timestep')} in it are then not used"
            )
        with self._reporting():
            self._new_file()

    def __len__(self) -> int:
        """Return the number of timesteps."""
        return self.last - self.first + 1

    def append(self, data: bytes) -> None:
        """Write timestep number `last` + 1; it survives if this process is killed.

        Raises:
            MerlError: it cannot be written.
        """
        with self._lock:
            try:
                if os.write(self._file, data) != len(data):
                    raise OSError(0, "the disk is full")
            except OSError as error:
                with suppress(OSError):  # `start` removes an incomplete timestep, too
                    os.ftruncate(self._file, (self.last + 1 - self._begin) * self._size)
                raise MerlError(f"spool {self.folder} cannot be written: {cause(error)}") from error
            self.last += 1

    def sync(self) -> None:
        """Wait until all timesteps are on the disk, so that a loss of power cannot remove them.

        Raises:
            MerlError: the disk failed.
        """
        with self._reporting():
            with self._lock:
                file = os.dup(self._file)
            try:
                os.fsync(file)
            finally:
                os.close(file)

    def read(self, number: int, most: int) -> bytes:
        """Return timestep `number` and the next ones in the same file, at most `most`.

        Raises:
            MerlError: they cannot be read.
        """
        with self._reporting(), self._lock:
            begin = max(int(file.stem) for file in self._files() if int(file.stem) <= number)
            with self._path(begin).open("rb") as file:
                file.seek((number - begin) * self._size)
                return file.read(most * self._size)

    def discard(self, saved: int) -> None:
        """Remove the files with timesteps up to number `saved` alone; begin a new file.

        Raises:
            MerlError: the disk failed.
        """
        with self._reporting(), self._lock:
            if self.last >= self._begin:
                os.fsync(self._file)
                self._new_file()
            files = self._files()
            for file, after in pairwise(files):
                if int(after.stem) - 1 <= saved:
                    file.unlink()
                    self.first = int(after.stem)

    def finish(self) -> None:
        """Note that the run is done: the folder may be used for another run."""
        self._done = True
        self._write_about()

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _new_file(self) -> None:
        self.close()
        self._begin = self.last + 1
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
        self._file = os.open(self._path(self._begin), flags, 0o644)
        sync(self.folder)

    def _reporting(self) -> AbstractContextManager[None]:
        return reporting(f"spool {self.folder} cannot be used")

    def _path(self, begin: int) -> Path:
        return self.folder / f"{begin:016d}{_SUFFIX}"

    def _files(self) -> list[Path]:
        return [file for file in entries(self.folder) if file.suffix == _SUFFIX]

    def _write_about(self) -> None:
        about = {"id": self.id, "run": self.run, "done": self._done}
        with self._reporting():
            replace_file(self.folder / _ABOUT, json.dumps(about).encode())
            sync(self.folder)


def _cut(file: Path, size: int, number: Callable[[bytes], int | None]) -> None:
    """Cut off damaged timesteps at the end of a file."""
    count = file.stat().st_size // size
    with file.open("r+b") as data:
        while count:
            data.seek((count - 1) * size)
            if number(data.read(size)) == int(file.stem) + count - 1:
                break
            count -= 1
        data.truncate(count * size)
