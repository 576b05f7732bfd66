"""Files of a run folder: opened, read, written, replaced and removed here.

They may come from anyone, so kind and size are checked before the content: a FIFO would hang, a
device could do anything, and a sparse file of a terabyte would fill the memory. A refusal is an
`OSError` whose `strerror` says why, like that of a full, read-only or lost disk. Whoever can go on
without the file catches it; everyone else turns it into one line with `reporting`.
"""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import stat
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

from merl.core.errors import MerlError

MOST_TEXT = 1 << 28
"""Bytes of the largest text file that is read: a hundred times the longest run's metrics."""
_SEAL = "checksum"
_NOT_THAT_FILE = {
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EINVAL,
    errno.EFBIG,
    errno.ELOOP,
}
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def reporting(problem: str) -> Iterator[None]:
    """Turn an `OSError` inside the block into one line: the problem, and the system's reason.

    Raises:
        MerlError: in place of the `OSError`.
    """
    try:
        yield
    except OSError as error:
        raise MerlError(f"{problem}: {cause(error)}") from error


def cause(error: OSError) -> str:
    """Return why a file operation failed, without the name of the file."""
    return error.strerror or str(error)


def is_damage(error: Exception) -> bool:
    """Return whether an error says that a file is missing or damaged.

    Other errors of the disk may pass: they say nothing about the content.
    """
    return not isinstance(error, OSError) or error.errno in _NOT_THAT_FILE


def check_kind(path: Path) -> None:
    """Check that a path is a file, or does not exist.

    Raises:
        OSError: it is something else, or a loop of links.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError:
        return
    if kind in _KINDS:
        code = errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL
        raise OSError(code, f"it is {_KINDS[kind]}, not a file", str(path))


def open_file(
    path: Path, mode: str = "rb", *, most: int | None = None, buffering: int = -1
) -> BinaryIO:
    """Open a file in a binary mode.

    Args:
        path: the file.
        mode: see `open`.
        most: the largest size in bytes.
        buffering: see `open`.

    Raises:
        OSError: it cannot be opened, is not a file, or is larger.
    """
    check_kind(path)
    file = cast(BinaryIO, path.open(mode, buffering))
    size = os.fstat(file.fileno()).st_size
    if most is not None and size > most:
        file.close()
        why = f"it has {size:,} bytes, and at most {most:,} belong there"
        raise OSError(errno.EFBIG, why, str(path))
    return file


def read_file(path: Path, most: int = MOST_TEXT) -> bytes:
    """Return the content of a file.

    Raises:
        OSError: see `open_file`.
    """
    with open_file(path, most=most) as file:
        return file.read()


def read_json(path: Path) -> Any:
    """Return the value in a JSON file.

    Raises:
        OSError: see `open_file`.
        ValueError: it is not valid JSON, or it is damaged: it has another checksum than `sealed`
            gave it.
    """
    try:
        value = json.loads(read_file(path))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeDecodeError:
        raise ValueError("it is not a text file") from None
    if isinstance(value, dict) and _SEAL in value and sealed(value)[_SEAL] != value[_SEAL]:
        raise ValueError(
            "it was damaged or changed since merl wrote it: restore it from a copy, or remove its "
            f"{_SEAL!r} to use it as it is"
        )
    return value


def sealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with a checksum of its values, by which `read_json` finds damage."""
    content = {name: value for name, value in record.items() if name != _SEAL}
    text = json.dumps(content, sort_keys=True)
    return {**content, _SEAL: f"{zlib.crc32(text.encode()):08x}"}


def replace_file(path: Path, *content: bytes) -> None:
    """Write a file under a temporary name, flush it to disk, and give it its name.

    Raises:
        OSError: that is not possible; an existing file keeps its content.
    """
    part = part_of(path)
    try:
        with open_file(part, "wb") as file:
            file.writelines(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        remove(part)
        raise


def part_of(path: Path) -> Path:
    """Return the temporary name of a file while it is written."""
    return path.with_name(f".{path.name}.part")


def append_whole(file: io.FileIO, data: bytes | bytearray) -> None:
    """Write `data` at the end of a file in one write; if that fails, remove the written part.

    Raises:
        OSError: it cannot be written.
    """
    end = file.seek(0, io.SEEK_END)
    try:
        if (file.write(data) or 0) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        with suppress(OSError):  # the disk may refuse this, too
            file.truncate(end)
        raise error from None


def remove(path: Path) -> None:
    """Remove a file, or a folder with all that is in it, as far as possible."""
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def entries(folder: Path) -> list[Path]:
    """Return what a folder holds, sorted by name; nothing if there is no such folder.

    Raises:
        OSError: it cannot be read; `Path.glob` would find nothing.
    """
    try:
        return sorted(folder.iterdir())
    except FileNotFoundError:
        return []


def is_gone(path: Path) -> bool:
    """Return whether a file is missing, as far as the disk can be asked."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        pass
    return False


def sync(path: Path) -> None:
    """Flush a file, or the directory entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
