"""Arrays of the replay, in memory or in memory-mapped files with space reserved before use.

The files are in a folder whose name is the number of slots of a ring. `<field>.bin` is the raw
little-endian array (rings * slots, *shape) in C order; `replay.json` lists types and shapes.
Observation keys are quoted as in a URL: `observation.image.bin`, `observation.arm%2Fjoints.bin`.
The folder gets its name when it is complete. A larger replay is written to a new folder.
"""

from __future__ import annotations

import json
import mmap
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.core.files import (
    cause,
    check_kind,
    entries,
    is_damage,
    is_gone,
    open_file,
    read_json,
    remove,
    replace_file,
    reporting,
)
from merl.core.resources import reserve_file, reserve_holes
from merl.replay.spec import ReplaySpec

_HEADER, _PART = "replay.json", "part"
_WAY_OUT = "restore it from a copy, or use another folder (merl evaluate needs no replay)"


@dataclass(frozen=True)
class Storage:
    """The arrays of a replay.

    Attributes:
        slots: number of timesteps for which each ring has room.
        arrays: the arrays by field, with the slots of all rings one after the other.
        files: the memory-mapped file of each array; empty for arrays in memory.
    """

    slots: int
    arrays: Mapping[str, NDArray[Any]]
    files: Mapping[str, mmap.mmap]

    def flush(self) -> None:
        """Write all data to the disk, and return when it is there."""
        for file in self.files.values():
            file.flush()


def in_memory(spec: ReplaySpec) -> Storage:
    """Return arrays in memory."""
    arrays = {
        name: np.zeros((spec.rings * spec.slots, *field.shape), field.dtype)
        for name, field in spec.fields.items()
    }
    return Storage(spec.slots, arrays, {})


def open_files(directory: Path, spec: ReplaySpec) -> Storage:
    """Open the files of an existing replay with its own number of slots, or create them.

    Raises:
        MerlError: see `new_files`; or the directory holds another replay or a damaged one, or
            cannot be read.
    """
    with _reporting(directory):
        folder = folder_in(directory)
    if folder is None:
        with new_files(directory, spec) as storage:
            return storage
    with _reporting(directory):
        _check(folder, spec)
        _remove_others(folder)
        return _mapped(folder, spec, int(folder.name))


def open_copy(directory: Path, spec: ReplaySpec) -> Storage:
    """Open the files of an existing replay; changes stay in memory and leave the files unchanged.

    Raises:
        MerlError: there is no replay, or another one, or a damaged one, or it cannot be read.
    """
    with _reporting(directory):
        folder = folder_in(directory)
        if folder is None:
            raise MerlError(f"{directory} holds no replay")
        _check(folder, spec)
        return _mapped(folder, spec, int(folder.name), mmap.ACCESS_COPY)


def holds_steps(directory: Path) -> bool:
    """Return whether a folder holds a replay with a timestep.

    Raises:
        OSError: it cannot be read.
    """
    folder = folder_in(directory)
    if folder is None:
        return False
    with open_file(folder / "timestep.bin") as file:
        while chunk := file.read(1 << 20):
            if any(chunk):
                return True
    return False


def folder_in(directory: Path) -> Path | None:
    """Return the folder of an existing replay, the largest; None if there is none.

    Raises:
        OSError: the directory cannot be read.
    """
    folders = [path for path in entries(directory) if path.name.isdecimal()]
    return max(folders, key=lambda path: int(path.name), default=None)


@contextmanager
def new_files(directory: Path, spec: ReplaySpec) -> Iterator[Storage]:
    """Create files; at the end of the block, which fills them, they replace the existing files.

    Raises:
        MerlError: the disk is full, or the directory cannot be written. After this and any other
            error the new files are removed, and existing files keep their contents.
    """
    part = directory / _PART
    new_parents = [path for path in part.parents if is_gone(path)]
    try:
        with reporting(f"cannot store a replay in {directory}"):
            remove(part)  # left by a process that died
            part.mkdir(parents=True)
            for name, field in spec.fields.items():
                reserve_file(part / f"{name}.bin", spec.rings * spec.slots * field.bytes)
            storage = _mapped(part, spec, spec.slots)
            yield storage
            storage.flush()
            replace_file(part / _HEADER, json.dumps(_described(spec), indent=2).encode())
            part.rename(directory / str(spec.slots))
    except BaseException:
        remove(part)
        for parent in new_parents:
            with suppress(OSError):
                parent.rmdir()
        raise
    _remove_others(directory / str(spec.slots))


def _mapped(folder: Path, spec: ReplaySpec, slots: int, access: int = mmap.ACCESS_WRITE) -> Storage:
    files, arrays = {}, {}
    mode = "r+b" if access == mmap.ACCESS_WRITE else "rb"
    for name, field in spec.fields.items():
        size = spec.rings * slots * field.bytes
        with open_file(folder / f"{name}.bin", mode) as file:
            if access == mmap.ACCESS_WRITE:
                reserve_holes(file.fileno())
            files[name] = mmap.mmap(file.fileno(), size, access=access)
        arrays[name] = np.frombuffer(files[name], field.dtype).reshape(-1, *field.shape)
    return Storage(slots, arrays, files)


def is_lost(directory: Path, storage: Storage) -> bool:
    """Return whether a file of a replay was removed, so that only its memory map exists."""
    folder = directory / str(storage.slots)
    return any(is_gone(folder / name) for name in (_HEADER, *(f"{n}.bin" for n in storage.files)))


def _remove_others(folder: Path) -> None:
    """Remove files that this folder replaces, and incomplete files of a process that died."""
    with suppress(OSError):  # they only take space
        for other in entries(folder.parent):
            if other != folder and (other.name == _PART or other.name.isdecimal()):
                remove(other)


def _reporting(directory: Path) -> AbstractContextManager[None]:
    return reporting(f"the replay in {directory} cannot be opened")


def _check(folder: Path, spec: ReplaySpec) -> None:
    """Raise MerlError if the replay in the folder has other fields or is damaged.

    Raises:
        OSError: the disk does not let it be read.
    """
    directory, rows = folder.parent, spec.rings * int(folder.name)
    try:
        same = read_json(folder / _HEADER) == _described(spec)
    except (OSError, ValueError) as error:
        if not is_damage(error):
            raise
        raise MerlError(
            f"{directory} holds a damaged replay ({_HEADER}: {_reason(error)}): {_WAY_OUT}"
        ) from error
    if not same:
        raise MerlError(
            f"{directory} holds a replay of other observations or actions ({folder / _HEADER}): "
            "use another folder"
        )
    for name, field in spec.fields.items():
        file = folder / f"{name}.bin"
        try:
            check_kind(file)
            size = file.stat().st_size
        except OSError as error:
            if not is_damage(error):
                raise
            raise MerlError(
                f"{directory} holds a damaged replay ({file}: {_reason(error)}): {_WAY_OUT}"
            ) from error
        if size != rows * field.bytes or not size:
            raise MerlError(f"{directory} holds a truncated replay ({file}): {_WAY_OUT}")


def _reason(error: Exception) -> str:
    return cause(error) if isinstance(error, OSError) else str(error)


def _described(spec: ReplaySpec) -> dict[str, Any]:
    """Describe the arrays for JSON."""
    fields = {
        name: {"dtype": field.dtype.str, "shape": list(field.shape)}
        for name, field in spec.fields.items()
    }
    return {"rings": spec.rings, "fields": fields}
