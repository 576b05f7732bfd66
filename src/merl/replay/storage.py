"""How the ring lies on the disk: a file per field, memory-mapped, its space reserved before use.

`<field>.bin` is the raw little-endian array (slots, *shape) in C order. `replay.json` lists fields,
types, shapes and the number of slots; it is written last, so a directory that has it is whole. An
observation's key is quoted as in a URL: `observation.image.bin`, `observation.arm%2Fjoints.bin`.
Compressed pictures lie behind one another in theirs, `observation.image.span.bin` says where
(`compression.py`).
"""

from __future__ import annotations

import json
import math
import mmap
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import gymnasium
import numpy as np

from merl.core import MerlError, is_image, is_vector
from merl.replay.compression import reserved_bytes
from merl.resources import reserve_file

_FORMAT = 1
_HEADER = "replay.json"


@dataclass(frozen=True)
class Field:
    """One array of the ring, without its first axis, the slots."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Bytes of one slot."""
        return self.dtype.itemsize * math.prod(self.shape)


def fields_of(
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    compress: bool = False,
) -> dict[str, Field]:
    """The arrays of the ring, by name; of compressed pictures their bytes and their spans."""
    fields: dict[str, Field] = {}
    for key, space in observation_space.spaces.items():
        shape = space.shape or ()
        whole = isinstance(space, gymnasium.spaces.Box) and math.prod(shape) > 0
        if whole and is_image(space):
            dtype: np.dtype[Any] = np.dtype("u1")
            if compress:
                shape = (reserved_bytes(math.prod(shape)),)
                fields[span_name(key)] = Field(np.dtype("<i8"), (2,))
        elif whole and is_vector(space):
            dtype = np.dtype("<f4")
        else:
            raise MerlError(
                f"observation {key!r} is {space}: replay keeps images, Box(H, W, C) of uint8, and "
                "vectors, Box(n) of floats; wrap the environment or leave the key out"
            )
        fields[field_name(key)] = Field(dtype, shape)
    if len(action_space.shape) != 1 or not math.prod(action_space.shape):
        raise MerlError(f"the action space is {action_space}: replay keeps vectors, Box(n)")
    fields["action"] = Field(np.dtype("<f4"), action_space.shape)
    fields["reward"] = Field(np.dtype("<f4"), ())
    fields["discount"] = Field(np.dtype("<f4"), ())
    fields["position"] = Field(np.dtype("<i4"), ())
    fields["moment"] = Field(np.dtype("<i8"), ())  # its number; 0 while there is none
    return fields


def field_name(key: str) -> str:
    """The field of an observation's key; also a file name, so a slash is quoted."""
    return f"observation.{quote(key, safe='')}"


def span_name(key: str) -> str:
    """The field that says where a key's compressed pictures lie."""
    return f"{field_name(key)}.span"


def check_value(name: str, value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise MerlError unless the value can be kept as it is in so many numbers of this type."""
    if value is None:
        raise MerlError(f"{name} is missing, although the observation space has it")
    value = np.asarray(value)
    kind_fits = value.dtype.kind == dtype.kind and (dtype != np.uint8 or value.dtype == np.uint8)
    if value.shape != shape or not kind_fits:
        raise MerlError(
            f"{name} is {value.dtype} {value.shape}, but its space says "
            f"{dtype} {shape}: mend what the environment or the agent returns"
        )


def open_files(
    directory: Path, fields: dict[str, Field], slots: int, capacity: int
) -> dict[str, mmap.mmap]:
    """Create the files, or grow those that are there where they are too short, and map them.

    A ring that has wrapped stays as long as it is: its oldest moments lie behind its newest.

    Raises:
        MerlError: the disk is full, the directory cannot be written, or it holds something else.
            What was created is removed again, what was there is as it was.
    """
    header = directory / _HEADER
    header_text = _header_text(fields, slots, capacity)
    held, wrapped = _held_slots(header, fields, header_text)
    slots = held if wrapped else slots
    paths = {name: directory / f"{name}.bin" for name in fields}
    before = {paths[name]: held * field.bytes for name, field in fields.items()}
    sizes = {paths[name]: max(slots, held) * field.bytes for name, field in fields.items()}
    new_folders = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path, size in sizes.items():
            if not held:  # there without a header: left by a process that died while reserving
                path.unlink(missing_ok=True)
            reserve_file(path, size)
        files = {name: _map(path, sizes[path]) for name, path in paths.items()}
        if slots > held:
            _write_text(header, header_text)
    except BaseException as error:
        with suppress(OSError):
            _undo(before, new_folders)
        if isinstance(error, OSError):
            why = error.strerror or error
            raise MerlError(f"cannot keep a replay in {directory}: {why}") from error
        raise
    return files


def _undo(lengths: Mapping[Path, int], new_folders: Iterable[Path]) -> None:
    """Give files the lengths that they had, remove those that had none, and the new folders."""
    for path, length in lengths.items():
        if not length:
            path.unlink(missing_ok=True)
        elif path.stat().st_size > length:
            os.truncate(path, length)
    for folder in new_folders:
        folder.rmdir()


def _held_slots(header: Path, fields: dict[str, Field], text: str) -> tuple[int, bool]:
    """Slots of the ring that lies there, 0 if there is none, and whether it has wrapped.

    Raises:
        MerlError: it cannot be gone on with.
    """
    if not header.exists():
        return 0, False
    directory, wanted = header.parent, json.loads(text)
    try:
        found = json.loads(header.read_text())
        held = int(found["slots"])
        same = all(found[name] == wanted[name] for name in ("format", "fields"))
        whole = all(
            (directory / f"{name}.bin").stat().st_size >= held * field.bytes
            for name, field in fields.items()
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise MerlError(f"{directory} holds a damaged replay: give another folder") from error
    if not same:
        raise MerlError(
            f"{directory} holds a replay of other observations or actions: give another folder"
        )
    if not whole:
        raise MerlError(f"{directory} holds a truncated replay: give another folder")
    newest = np.fromfile(directory / "moment.bin", "<i8", held).max(initial=0)
    return held, bool(newest > held) or _bytes_wrapped(directory, fields, held)


def _bytes_wrapped(directory: Path, fields: dict[str, Field], held: int) -> bool:
    """Whether compressed pictures have come to the end of their bytes."""
    for name, field in fields.items():
        spans = directory / f"{name}.span.bin"
        if f"{name}.span" in fields:
            ends = np.fromfile(spans, "<i8", 2 * held).reshape(-1, 2).sum(axis=1)
            if ends.max(initial=0) > held * field.bytes:
                return True
    return False


def _header_text(fields: dict[str, Field], slots: int, capacity: int) -> str:
    layout = {
        name: {"dtype": field.dtype.str, "shape": field.shape} for name, field in fields.items()
    }
    header = {"format": _FORMAT, "capacity": capacity, "slots": slots, "fields": layout}
    return json.dumps(header, indent=2) + "\n"


def _write_text(path: Path, text: str) -> None:
    """Replace the file as a whole, or not at all."""
    temporary = path.with_suffix(".tmp")
    try:
        with temporary.open("w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _map(path: Path, size: int) -> mmap.mmap:
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), size)
