"""A ring of single frames; stacks of frames and n-step returns are made when sampled.

One slot holds one *moment*: what was seen, and the action, reward and discount that led there. An
episode of T steps is T + 1 moments in a row, the first of which was led to by nothing. Moments are
numbered 1, 2, 3, ... as they come; moment i lies in slot (i - 1) mod slots.

    moment        7      8      9     10     11     12
    position      0      1      2      3      0      1      in its episode; 0 begins one
    step              *      *      *             *         o_t -> o_{t+1}, what is sampled

In a directory each field is a file of its own, `<field>.bin`: the raw little-endian array
(slots, *shape) in C order, memory-mapped. `replay.json` lists fields, types, shapes and the number
of slots; it is written last, so a directory that has it is whole. An observation's key is quoted as
in a URL: `observation.image.bin`, `observation.arm%2Fjoints.bin`.
"""

from __future__ import annotations

import json
import math
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from merl.core import Batch, MerlError, Observation, Transition
from merl.resources import available_memory, existing_parent, free_disk, reserve_file

_FORMAT = 1
_HEADER = "replay.json"


@dataclass(frozen=True)
class ReplayConfig:
    """What the replay keeps and how it is sampled."""

    capacity: int = 1_000_000
    """Steps that are kept; a run that is shorter reserves only its own length."""
    batch_size: int = 256
    """Samples in one update."""
    n_step: int = 3
    """Rewards that are summed before the critic's estimate takes over."""
    frame_stack: int = 3
    """Pictures in a row that make one observation."""
    discount: float = 0.99
    """What a reward is worth one step later (gamma), from 0 to 1."""

    def __post_init__(self) -> None:
        for name in ("capacity", "batch_size", "n_step", "frame_stack"):
            value = getattr(self, name)
            if value < 1:
                raise MerlError(f"replay.{name} is {value}: give a whole number of at least 1")
        if not 0 <= self.discount <= 1:
            raise MerlError(f"replay.discount is {self.discount}: give a number from 0 to 1")
        _check_batch(self.batch_size, self.capacity)


@dataclass(frozen=True)
class _Field:
    """One array of the ring, without its first axis, the slots."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Bytes of one slot."""
        return self.dtype.itemsize * math.prod(self.shape)


@dataclass(frozen=True)
class _Picks:
    """Where B sampled steps lie in the ring, and what they paid."""

    now: NDArray[np.int64]  # (B, K) slots of o_t's frames, oldest first
    then: NDArray[np.int64]  # (B, K) slots of o_{t+m}'s
    action: NDArray[np.int64]  # (B,) slot of the moment that a_t led to
    reward: NDArray[np.float32]  # (B,)
    discount: NDArray[np.float32]  # (B,)


def replay_bytes(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    capacity: int | None = None,
) -> int:
    """Bytes that a replay takes, on disk or in memory; `capacity` counts steps."""
    steps = config.capacity if capacity is None else capacity
    slot = sum(field.bytes for field in _fields(observation_space, action_space).values())
    return slot * _slots(steps, config.frame_stack)


def check_fits(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    *,
    directory: Path | None = None,
    capacity: int | None = None,
) -> None:
    """Refuse a replay that the disk or the memory cannot hold, before anything is created.

    Even a replay on disk has to fit into memory: one that does not reads the disk for every sample.

    Raises:
        MerlError: it does not fit; names what it needs, what is there, and what would fit.
    """
    steps = config.capacity if capacity is None else capacity
    room = {"of memory are available": available_memory()}
    if directory is not None:
        where = existing_parent(directory)
        held = sum(
            file.stat().st_size for file in directory.glob("*.bin")
        )  # reopened: already ours
        room[f"of disk are free in {where}"] = free_disk(where) + held
    what, least = min(room.items(), key=lambda item: item[1])
    need = replay_bytes(config, observation_space, action_space, steps)
    if need > least:
        raise _too_large(config, observation_space, action_space, steps, what, least)


class Replay:
    """The steps that were taken, and batches of them for the learner.

    Every step that is held is sampled with the same probability, those of the episode in progress
    included. Nothing reaches across an episode's boundary: at the start the stack repeats the first
    frame, at the end the return is shorter. An episode that was begun while the former had not
    ended cuts that one off; it bootstraps, as at a time limit.
    """

    def __init__(
        self,
        config: ReplayConfig,
        observation_space: gymnasium.spaces.Dict,
        action_space: gymnasium.spaces.Box,
        *,
        directory: Path | None = None,
        capacity: int | None = None,
    ) -> None:
        """Create the ring, or open the one that `directory` holds with all that was written to it.

        Args:
            config: what is kept and how it is sampled.
            observation_space: the keys that are kept: images (uint8, H x W x C) and vectors
                (float, n).
            action_space: a vector.
            directory: where the ring lies, memory-mapped; without one it lies in memory.
            capacity: steps that are kept, in place of the config's. A ring that is opened again
                grows to it, unless it has wrapped already.

        Raises:
            MerlError: a space that cannot be kept, a capacity that does not fit, a directory that
                holds another replay or cannot be written. Nothing is left behind.
        """
        self.config = config
        self.capacity = config.capacity if capacity is None else capacity
        _check_batch(config.batch_size, self.capacity)
        fields = _fields(observation_space, action_space)
        check_fits(
            config, observation_space, action_space, directory=directory, capacity=self.capacity
        )
        self._slots = _slots(self.capacity, config.frame_stack)
        self._files: dict[str, mmap.mmap] = {}
        self._data: dict[str, NDArray[Any]] = {}
        if directory is None:
            for name, field in fields.items():
                self._data[name] = np.zeros((self._slots, *field.shape), field.dtype)
        else:
            self._slots = _prepare(directory, fields, self._slots)
            for name, field in fields.items():
                self._files[name] = file = _map(directory / f"{name}.bin")
                self._data[name] = np.frombuffer(file, field.dtype).reshape(-1, *field.shape)
        self._keys = list(observation_space.spaces)
        self._moments = self._steps = self._first = self._gap = 0
        self._open = False
        # Step i led away from moment _sources[i mod capacity]; steps _first to _steps - 1 are held.
        self._sources = np.zeros(self.capacity, np.int64)
        self._take_over(moments=int(self._data["moment"].max()))

    def __len__(self) -> int:
        """Steps that can be sampled now."""
        return self._steps - self._first

    def begin(self, observation: Observation) -> None:
        """The first moment of an episode; one still in progress is cut off.

        Raises:
            MerlError: the observation does not fit the space.
        """
        self._write(observation, position=0, action=None, reward=0.0, discount=1.0)
        self._open = True

    def add(self, transition: Transition) -> None:
        """One step of the episode in progress.

        Raises:
            MerlError: action or observation do not fit the space.
            ValueError: no episode is in progress, or the discount contradicts `last`.
        """
        if not self._open:
            raise ValueError("no episode is in progress: call begin() with its first observation")
        if transition.discount != 1.0 and not (transition.discount == 0.0 and transition.last):
            raise ValueError(
                f"discount {transition.discount} with last={transition.last}: it is 0 at a true "
                "end, which is last, and 1 everywhere else"
            )
        source = self._moments
        self._write(
            transition.observation,
            position=int(self._data["position"][self._slot(source)]) + 1,
            action=transition.action,
            reward=transition.reward,
            discount=transition.discount,
        )
        self._sources[self._steps % self.capacity] = source
        self._steps += 1
        self._forget()
        self._open = not transition.last

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """Draw steps uniformly, with replacement.

        The same content and the same state of `rng` give the same batch.

        Returns:
            Tensors on the CPU that are the caller's own; shapes as in `merl.core.Batch`.

        Raises:
            ValueError: no step is held yet.
        """
        if not len(self):
            raise ValueError("the replay is empty: add a step before sampling")
        steps = rng.integers(self._first, self._steps, size=batch_size)
        picks = self._pick(self._sources[steps % self.capacity])
        return Batch(
            observation=self._observation(picks.now),
            action=torch.from_numpy(self._data["action"][picks.action]),
            reward=torch.from_numpy(picks.reward),
            discount=torch.from_numpy(picks.discount),
            next_observation=self._observation(picks.then),
        )

    def flush(self) -> None:
        """Have everything written reach the disk; returns when it has."""
        for file in self._files.values():
            file.flush()

    def state_dict(self) -> dict[str, int | bool]:
        """The cursor and its counts as plain numbers; the moments stay where they are."""
        return {
            "moments": self._moments,
            "steps": self._steps,
            "first": self._first,
            "open": self._open,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to what `state_dict` said; what was written since then is forgotten.

        Of the moments held then, those overwritten since are gone: there are such only where the
        ring has wrapped and its reserve (a hundredth of the capacity) is used up.

        Raises:
            MerlError: the ring does not hold what the state names.
        """
        moments = int(state["moments"])
        if moments and self._data["moment"][self._slot(moments)] != moments:
            raise MerlError(
                f"the replay does not hold moment {moments:,}, at which the checkpoint was taken: "
                "it is not this run's, or was written to since; start a new run"
            )
        self._take_over(moments, int(state["steps"]), int(state["first"]), bool(state["open"]))

    def _slot(self, moment: int) -> int:
        """Where the ring holds a moment."""
        return (moment - 1) % self._slots

    def _write(
        self,
        observation: Observation,
        *,
        position: int,
        action: NDArray[Any] | None,
        reward: float,
        discount: float,
    ) -> None:
        """Write the next moment; all is checked before anything is changed."""
        data = self._data
        values = {f"observation.{quote(key, safe='')}": observation.get(key) for key in self._keys}
        values["action"] = np.zeros_like(data["action"][0]) if action is None else action
        for name, value in values.items():
            _check_value(name, value, data[name])
        moment = self._moments + 1
        slot = self._slot(moment)
        data["moment"][slot] = 0  # while it is written it is no moment, should the process die here
        for name, value in values.items():
            data[name][slot] = value
        data["position"][slot] = position
        data["reward"][slot] = reward
        data["discount"][slot] = discount
        data["moment"][slot] = moment
        self._moments = moment
        self._forget()

    def _forget(self) -> None:
        """Let go of the oldest steps: beyond the capacity, or with a frame that is overwritten."""
        while self._first < self._steps:
            source = int(self._sources[self._first % self.capacity])
            position = int(self._data["position"][self._slot(source)])
            oldest = source - min(position, self.config.frame_stack - 1)
            if self._steps - self._first <= self.capacity and oldest > self._lost():
                break
            self._first += 1

    def _lost(self) -> int:
        """The newest moment that is no longer held."""
        return max(self._moments - self._slots, self._gap)

    def _take_over(
        self, moments: int, steps: int | None = None, first: int = 0, is_open: bool = False
    ) -> None:
        """Find the steps among the moments up to number `moments` that lie in the ring."""
        stamps = self._data["moment"]
        stamps[stamps > moments] = 0  # else they would pass for what follows, if opened once more
        numbers = np.arange(max(0, moments - self._slots) + 1, moments + 1)
        slots = (numbers - 1) % self._slots
        missing = numbers[stamps[slots] != numbers]
        self._gap = int(missing[-1]) if missing.size else 0
        whole = numbers > self._gap
        leads = whole[:-1] & (self._data["position"][slots[1:]] > 0)
        sources = numbers[:-1][leads][-self.capacity :]
        self._moments, self._open = moments, is_open
        self._steps = len(sources) if steps is None else steps
        self._first = max(first, self._steps - len(sources))
        self._sources[np.arange(self._steps - len(sources), self._steps) % self.capacity] = sources
        self._forget()

    def _pick(self, source: NDArray[np.int64]) -> _Picks:
        """Lay out the samples that start at moments `source`, (B,)."""
        data, gamma = self._data, self.config.discount
        begun = source - data["position"][(source - 1) % self._slots]  # (B,) the episode's first
        powers = np.arange(self.config.n_step)
        ahead = source[:, None] + 1 + powers  # (B, n) the moments that r_t, r_{t+1}, ... led to
        slots = (ahead - 1) % self._slots
        same = (ahead <= self._moments) & (data["position"][slots] > 0)
        same = np.logical_and.accumulate(same, axis=1)
        m = same.sum(axis=1)
        end = source + m
        rewards = np.where(same, data["reward"][slots], 0.0)  # float64
        discount = gamma**m * data["discount"][(end - 1) % self._slots]
        back = np.arange(self.config.frame_stack)[::-1]
        now = np.maximum(source[:, None] - back, begun[:, None])
        then = np.maximum(end[:, None] - back, begun[:, None])
        return _Picks(
            now=(now - 1) % self._slots,
            then=(then - 1) % self._slots,
            action=slots[:, 0],
            reward=(rewards @ gamma**powers).astype(np.float32),
            discount=discount.astype(np.float32),
        )

    def _observation(self, slots: NDArray[np.int64]) -> dict[str, torch.Tensor]:
        """Images (B, K, H, W, C) at slots (B, K), vectors (B, n) at the newest of them."""
        observation = {}
        for key in self._keys:
            array = self._data[f"observation.{quote(key, safe='')}"]
            index = slots if array.dtype == np.uint8 else slots[:, -1]
            observation[key] = torch.from_numpy(array.take(index, axis=0))
        return observation


def _slots(capacity: int, frame_stack: int) -> int:
    """Moments that hold `capacity` steps of episodes of a hundred steps or more.

    An episode has one moment more than steps, and the oldest step needs its whole stack. Episodes
    shorter than a hundred steps fill the slots before the capacity is reached. What is to spare
    also lets a run go back to its last checkpoint after the ring has wrapped.
    """
    return capacity + capacity // 100 + frame_stack


def _fields(
    observation_space: gymnasium.spaces.Dict, action_space: gymnasium.spaces.Box
) -> dict[str, _Field]:
    """The arrays of the ring, by name."""
    fields: dict[str, _Field] = {}
    for key, space in observation_space.spaces.items():
        box = isinstance(space, gymnasium.spaces.Box)
        shape = space.shape or ()
        if box and space.dtype == np.uint8 and len(shape) == 3:
            dtype: np.dtype[Any] = np.dtype("u1")
        elif box and np.issubdtype(space.dtype, np.floating) and len(shape) == 1:
            dtype = np.dtype("<f4")
        else:
            raise MerlError(
                f"observation {key!r} is {space}: replay keeps images, Box(H, W, C) of uint8, and "
                "vectors, Box(n) of floats; wrap the environment or leave the key out"
            )
        fields[f"observation.{quote(key, safe='')}"] = _Field(dtype, shape)
    if len(action_space.shape) != 1:
        raise MerlError(f"the action space is {action_space}: replay keeps vectors, Box(n)")
    fields["action"] = _Field(np.dtype("<f4"), action_space.shape)
    fields["reward"] = _Field(np.dtype("<f4"), ())
    fields["discount"] = _Field(np.dtype("<f4"), ())
    fields["position"] = _Field(np.dtype("<i4"), ())
    fields["moment"] = _Field(np.dtype("<i8"), ())  # its number; 0 while there is none
    return fields


def _check_batch(batch_size: int, capacity: int) -> None:
    if batch_size > capacity:
        raise MerlError(
            f"replay.batch_size {batch_size} is larger than the replay of {capacity} steps: "
            f"give at most {capacity}, or more steps"
        )


def _check_value(name: str, value: Any, array: NDArray[Any]) -> None:
    """Raise MerlError unless the value can be stored in one slot of the array as it is."""
    if value is None:
        raise MerlError(f"{name} is missing, although the observation space has it")
    value = np.asarray(value)
    kind_fits = value.dtype.kind == array.dtype.kind and (
        array.dtype != np.uint8 or value.dtype == np.uint8
    )
    if value.shape != array.shape[1:] or not kind_fits:
        raise MerlError(
            f"{name} is {value.dtype} {value.shape}, but its space says "
            f"{array.dtype} {array.shape[1:]}: mend what the environment or the agent returns"
        )


def _too_large(
    config: ReplayConfig,
    observation_space: gymnasium.spaces.Dict,
    action_space: gymnasium.spaces.Box,
    capacity: int,
    what: str,
    room: int,
) -> MerlError:
    """The error that names the largest capacity for which there is room."""
    need = replay_bytes(config, observation_space, action_space, capacity)
    low, high = 0, capacity  # low fits, high does not
    while high - low > 1:
        middle = (low + high) // 2
        fits = replay_bytes(config, observation_space, action_space, middle) <= room
        low, high = (middle, high) if fits else (low, middle)
    way_out = f"--replay.capacity {low} would fit" if low else "free some"
    return MerlError(
        f"a replay of {capacity:,} steps needs {need / 1e9:.3g} GB, but {room / 1e9:.3g} GB "
        f"{what}: {way_out}"
    )


def _map(path: Path) -> mmap.mmap:
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 0)


def _prepare(directory: Path, fields: dict[str, _Field], slots: int) -> int:
    """Create the files, or grow those that are there; returns their number of slots."""
    header = directory / _HEADER
    layout = {name: [field.dtype.str, *field.shape] for name, field in fields.items()}
    missing = [path for path in (directory, *directory.parents) if not path.exists()]
    existed = header.exists()
    if existed:
        slots = max(slots, _check_header(header, layout, slots))
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, field in fields.items():
            reserve_file(directory / f"{name}.bin", slots * field.bytes)
        text = json.dumps({"format": _FORMAT, "slots": slots, "fields": layout}, indent=2)
        temporary = header.with_suffix(".tmp")
        with temporary.open("w") as file:
            file.write(text + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(header)
    except OSError as error:
        if not existed:
            for name in fields:
                (directory / f"{name}.bin").unlink(missing_ok=True)
            header.with_suffix(".tmp").unlink(missing_ok=True)
            for path in missing:
                if path.exists():
                    path.rmdir()
        raise MerlError(f"no replay in {directory}: {error.strerror}") from error
    return slots


def _check_header(header: Path, layout: dict[str, list[Any]], slots: int) -> int:
    """The slots of the ring that lies there, after a check that it is of this kind."""
    found = json.loads(header.read_text())
    if found["format"] != _FORMAT or found["fields"] != layout:
        raise MerlError(f"{header.parent} holds a replay with other fields: give another folder")
    return int(found["slots"])
