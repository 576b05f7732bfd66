"""Storage of the ring on disk: one memory-mapped file per field, with space reserved before use.

`<field>.bin` is the raw little-endian array (slots, *shape) in C order. `replay.json` lists fields,
types, shapes and the number of slots; it is written last, so a directory that has it is complete.
Observation keys are quoted as in a URL: `observation.image.bin`, `observation.arm%2Fjoints.bin`.
The file of compressed images holds one after the other; `observation.image.span.bin` holds their
positions (`compression.py`). An origin gives the slot and the byte at which the ring starts
(`ring_index.py`).
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

from merl.core import MerlError
from merl.core.resources import reserve_file
from merl.modalities import modality_of
from merl.replay.compression import reserved_bytes
from merl.replay.ring_index import Move, RingIndex

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


@dataclass(frozen=True)
class Layout:
    """Positions of all entries.

    Attributes:
        slots: index of the slots; a timestep's entry is its number minus one.
        bytes: index of the bytes of compressed images, by field.
    """

    slots: RingIndex
    bytes: Mapping[str, RingIndex]

    @classmethod
    def of(
        cls,
        fields: Mapping[str, Field],
        slots: int,
        origin: int = 0,
        byte_origins: Mapping[str, int] | None = None,
    ) -> Layout:
        """Make the layout for this number of slots."""
        origins = byte_origins or {}
        compressed = [name for name in fields if f"{name}.span" in fields]
        return cls(
            RingIndex(slots, origin),
            {
                name: RingIndex(slots * fields[name].bytes, origins.get(name, 0))
                for name in compressed
            },
        )


def fields_of(
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    compress: bool = False,
) -> dict[str, Field]:
    """Return the fields of the ring by name; for compressed images, their bytes and spans.

    Raises:
        MerlError: a space is neither an image nor a vector.
    """
    fields: dict[str, Field] = {}
    for key, space in observation_space.spaces.items():
        shape = space.shape or ()
        modality = modality_of(space)
        if modality is None:
            raise MerlError(
                f"observation {key!r} is {space}: replay stores images, Box(H, W, C) of uint8, and "
                "vectors, Box(n) of floats; convert the key in a wrapper, or remove it"
            )
        dtype = modality.stored
        if compress and modality.stacked:
            shape, dtype = (reserved_bytes(math.prod(shape) * dtype.itemsize),), np.dtype("u1")
            fields[span_name(key)] = Field(np.dtype("<i8"), (2,))
        fields[field_name(key)] = Field(dtype, shape)
    if len(action_space.shape) != 1 or not math.prod(action_space.shape):
        raise MerlError(f"the action space is {action_space}: use a vector, Box(n)")
    fields["action"] = Field(np.dtype("<f4"), action_space.shape)
    fields["reward"] = Field(np.dtype("<f4"), ())
    fields["discount"] = Field(np.dtype("<f4"), ())
    fields["position"] = Field(np.dtype("<i4"), ())
    fields["timestep"] = Field(np.dtype("<i8"), ())  # its number; 0: an empty slot
    return fields


def field_name(key: str) -> str:
    """Return the field of an observation key; also a file name, so a slash is quoted."""
    return f"observation.{quote(key, safe='')}"


def span_name(key: str) -> str:
    """Return the field with the positions of a key's compressed images."""
    return f"{field_name(key)}.span"


def check_value(name: str, value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Raise MerlError if the value has another kind of type or another shape than its field."""
    if value is None:
        raise MerlError(f"{name} is missing: return it with each observation, as its space says")
    value = np.asarray(value)
    kind_fits = value.dtype.kind == dtype.kind and (dtype != np.uint8 or value.dtype == np.uint8)
    if value.shape != shape or not kind_fits:
        raise MerlError(
            f"{name} is {value.dtype} {value.shape}, but its space says "
            f"{dtype} {shape}: correct the output of the environment or the agent"
        )


def open_files(
    directory: Path, fields: dict[str, Field], slots: int, capacity: int
) -> tuple[dict[str, mmap.mmap], Layout]:
    """Create the files, or lengthen existing files that are too short, and map them.

    Raises:
        MerlError: the disk is full, the directory cannot be written, or it holds another replay or
            a damaged one. New files are removed, existing files keep their contents.
    """
    header = directory / _HEADER
    before = _read_layout(header, fields)
    held = 0 if before is None else before.slots.length
    layout, moves = Layout.of(fields, slots), dict[str, Move]()
    if before is not None:
        layout, moves = _lengthened(directory, fields, before, slots)
    paths = {name: directory / f"{name}.bin" for name in fields}
    lengths = {paths[name]: held * field.bytes for name, field in fields.items()}
    sizes = {name: layout.slots.length * field.bytes for name, field in fields.items()}
    new_folders = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, path in paths.items():
            if not held:  # no header: left by a process that died while reserving
                path.unlink(missing_ok=True)
            reserve_file(path, sizes[name])
        files = {name: _map(path, sizes[name]) for name, path in paths.items()}
        if layout != before:
            for name, move in moves.items():
                files[name].move(move.to, move.begin, move.entries)
                files[name].flush()
            _write_text(header, _header_text(fields, layout, capacity))
    except BaseException as error:
        with suppress(OSError):
            _undo(lengths, new_folders)
        if isinstance(error, OSError):
            why = error.strerror or error
            raise MerlError(f"cannot store a replay in {directory}: {why}") from error
        raise
    return files, layout


def _lengthened(
    directory: Path, fields: Mapping[str, Field], layout: Layout, slots: int
) -> tuple[Layout, dict[str, Move]]:
    """Return a layout of `slots` slots, or a few more if necessary, and the moves it requires.

    Moves are in bytes, by field. A ring that has enough slots stays unchanged.
    """
    held = layout.slots.length
    if slots <= held:
        return layout, {}
    timesteps = int(np.fromfile(directory / "timestep.bin", "<i8", held).max(initial=0))
    ends = {}  # position after the newest compressed image
    for name in layout.bytes:
        spans = np.fromfile(directory / f"{name}.span.bin", "<i8", 2 * held).reshape(-1, 2)
        ends[name] = int(spans[layout.slots.of(timesteps - 1)].sum()) if timesteps else 0
    least = [layout.slots.least_longer(timesteps)]
    for name, ring_index in layout.bytes.items():
        least.append(-(-ring_index.least_longer(ends[name]) // fields[name].bytes))
    slots = max(slots, *least)
    ring_index, move = layout.slots.longer(slots, timesteps)
    moves, byte_indices = {}, {}
    for name, field in fields.items():
        if name not in layout.bytes:
            if move is not None:
                moves[name] = Move(*(field.bytes * part for part in move))
            continue
        byte_indices[name], byte_move = layout.bytes[name].longer(slots * field.bytes, ends[name])
        if byte_move is not None:
            moves[name] = byte_move
    return Layout(ring_index, byte_indices), moves


def _undo(lengths: Mapping[Path, int], new_folders: Iterable[Path]) -> None:
    """Restore the former lengths of files; remove new files and new folders."""
    for path, length in lengths.items():
        if not length:
            path.unlink(missing_ok=True)
        elif path.stat().st_size > length:
            os.truncate(path, length)
    for folder in new_folders:
        folder.rmdir()


def _read_layout(header: Path, fields: dict[str, Field]) -> Layout | None:
    """Return the layout of the existing ring, or None if there is none.

    Raises:
        MerlError: the existing ring has other fields or is damaged, so that it cannot be used.
    """
    if not header.exists():
        return None
    directory = header.parent
    try:
        found = json.loads(header.read_text())
        held = int(found["slots"])
        layout = Layout.of(
            fields,
            held,
            int(found.get("origin", 0)),
            {name: int(origin) for name, origin in found.get("byte_origins", {}).items()},
        )
        same = found["format"] == _FORMAT and found["fields"] == _described(fields)
        whole = all(
            (directory / f"{name}.bin").stat().st_size >= held * field.bytes
            for name, field in fields.items()
        )
    except (
        OSError,
        ArithmeticError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
    ) as error:
        raise MerlError(f"{directory} holds a damaged replay: use another folder") from error
    if not same:
        raise MerlError(
            f"{directory} holds a replay of other observations or actions: use another folder"
        )
    if not whole or held < 1:
        raise MerlError(f"{directory} holds a truncated replay: use another folder")
    return layout


def _header_text(fields: dict[str, Field], layout: Layout, capacity: int) -> str:
    header = {
        "format": _FORMAT,
        "capacity": capacity,
        "slots": layout.slots.length,
        "origin": layout.slots.origin,
        "byte_origins": {name: ring_index.origin for name, ring_index in layout.bytes.items()},
        "fields": _described(fields),
    }
    return json.dumps(header, indent=2) + "\n"


def _described(fields: dict[str, Field]) -> dict[str, Any]:
    """Describe the fields for JSON."""
    return {
        name: {"dtype": field.dtype.str, "shape": list(field.shape)}
        for name, field in fields.items()
    }


def _write_text(path: Path, text: str) -> None:
    """Replace the file atomically."""
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
