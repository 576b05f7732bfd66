"""Files of a run folder, which may come from anyone: kind and size are checked before the content.

Every file of a run is opened here. A FIFO would hang, a device could do anything, and a sparse file
of a terabyte would fill the memory. A refusal is an `OSError` whose `strerror` says why.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

MOST_TEXT = 1 << 28
"""Bytes of the largest text file that is read: a hundred times the longest run's metrics."""
_SEAL = "checksum"
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


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


def sync(path: Path) -> None:
    """Flush a file, or the directory entries of a folder, to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
