"""The ring: slots, timesteps and steps; stacks and n-step returns are made when sampled.

One slot holds one *timestep*: an observation, and the action, reward and discount that led to it.
An episode of T steps takes T + 1 timesteps in a row; no action led to the first of them. Timesteps
are numbered 1, 2, 3, ...; timestep i is entry i - 1 of the slots (`ring_index.py`).

    timestep        7      8      9     10     11     12
    position      0      1      2      3      0      1      in its episode; 0 begins one
    step              *      *      *             *         o_t -> o_{t+1}, what is sampled

A process that is killed loses nothing that was written. A machine that loses power loses what came
after the last `flush`, and where that had begun to overwrite old timesteps, those may be torn. A
checkpoint calls `flush`, keeps `state_dict`, and calls `settle` once it is on the disk: what is
overwritten from then on goes into a journal, from which `load_state_dict` puts it back.
"""

from __future__ import annotations

import logging
import mmap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from merl.core import Batch, FrameTransforms, MerlError, Observation, Transition, is_image
from merl.replay.compression import CompressedPictures
from merl.replay.config import ReplayConfig, check_fits, slots_for
from merl.replay.journal import Journal
from merl.replay.pictures import Pictures, RawPictures, ReadAhead, as_it_is, copied
from merl.replay.sampling import SampleIndices, Sampler
from merl.replay.storage import (
    Layout,
    check_value,
    field_name,
    fields_of,
    open_files,
    span_name,
)

_LOG = logging.getLogger(__name__)


class EpisodeRing:
    """The steps that were taken, and batches of them for the learner.

    Every step that is held is sampled with the same probability, those of the episode in progress
    included. Nothing reaches across an episode's boundary: at the start the stack repeats the first
    frame, at the end the return is shorter. An episode that was begun while the former had not
    ended cuts that one off; it bootstraps, as at a time limit.

    Attributes:
        config: what is kept and how it is sampled.
        capacity: steps that are kept.
        places: where the timesteps lie; a timestep's entry is its number less one.
        keys: the field that each of an observation's keys is kept in.
        sources: step i led away from timestep sources[i mod capacity].
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
                grows to it.

        Raises:
            MerlError: a space that cannot be kept, a capacity that does not fit, a directory that
                holds another replay or cannot be written. Nothing is left behind.
        """
        self.config = config
        self.capacity = config.capacity if capacity is None else capacity
        check_fits(
            config, observation_space, action_space, directory=directory, capacity=self.capacity
        )
        fields = fields_of(observation_space, action_space, config.compress)
        slots = slots_for(config, self.capacity)
        self._files: dict[str, mmap.mmap] = {}
        arrays: dict[str, NDArray[Any]]
        if directory is None:
            arrays = {
                name: np.zeros((slots, *field.shape), field.dtype) for name, field in fields.items()
            }
            layout = Layout.of(fields, slots)
        else:
            self._files, layout = open_files(directory, fields, slots, self.capacity)
            arrays = {
                name: np.frombuffer(self._files[name], field.dtype).reshape(-1, *field.shape)
                for name, field in fields.items()
            }
        self.keys = {key: field_name(key) for key in observation_space.spaces}
        self._compressed = {
            name: CompressedPictures(
                arrays.pop(name).reshape(-1),
                layout.bytes[name],
                arrays[span_name(key)],
                observation_space[key].shape or (),
                None if directory is None else directory / f"{name}.starts",
            )
            for key, name in self.keys.items()
            if span_name(key) in fields
        }
        self._data = arrays  # a row for each slot
        self._values = {**fields_of(observation_space, action_space)}  # what is written
        self._ahead = ReadAhead()
        self._images: dict[str, Pictures] = {
            name: self._compressed[name] if name in self._compressed else RawPictures(arrays[name])
            for key, name in self.keys.items()
            if is_image(observation_space[key])
        }
        self._journal: Journal | None = None
        if directory is not None:
            self._journal = Journal(directory, self._data, layout.slots, self._compressed)
        self.ring_index = layout.slots
        fields_there = {name: torch.from_numpy(array) for name, array in arrays.items()}
        self._sampler = Sampler(fields_there, config)
        self._timesteps = self._steps = 0  # ever written
        self._first = 0  # the oldest step that can be sampled
        self._oldest = 1  # the oldest timestep that is held
        self._open = False  # an episode is in progress
        self._settled = 0  # the newest timestep of the last checkpoint
        self._told = False  # that fewer steps are held than asked for
        self.sources = np.zeros(self.capacity, np.int64)
        self._take_over(timesteps=int(self._data["timestep"].max()))

    def __len__(self) -> int:
        """Steps that can be sampled now."""
        return self._steps - self._first

    def begin(self, observation: Observation) -> None:
        """The first timestep of an episode; one still in progress is cut off.

        Raises:
            MerlError: the observation does not fit the space.
        """
        self._write(observation, position=0, action=None, reward=0.0, discount=1.0)
        for name, pictures in self._compressed.items():
            key = next(key for key, field in self.keys.items() if field == name)
            pictures.backgrounds.begun(observation[key])
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
        source = self._timesteps
        self._write(
            transition.observation,
            position=int(self._data["position"][self._slot(source)]) + 1,
            action=transition.action,
            reward=float(transition.reward),
            discount=float(transition.discount),
        )
        self.sources[self._steps % self.capacity] = source
        self._steps += 1
        self._forget()
        self._open = not transition.last

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        now: FrameTransforms | None = None,
        then: FrameTransforms | None = None,
    ) -> Batch:
        """Draw steps uniformly, with replacement.

        The same content and the same state of `rng` give the same batch.

        Args:
            batch_size: B.
            rng: draws.
            now: how the frames of o_t are copied out, where not as they are.
            then: likewise of o_{t+n}.

        Returns:
            Tensors on the CPU that are the caller's own; shapes as in `merl.core.Batch`.

        Raises:
            ValueError: no step is held yet.
        """
        if not len(self):
            raise ValueError("the replay is empty: add a step before sampling")
        steps = rng.integers(self._first, self._steps, size=batch_size)
        indices = self._sampler.pick(
            torch.from_numpy(self.sources[steps % self.capacity] - self.ring_index.origin),
            newest=torch.tensor([self._timesteps - self.ring_index.origin]),
            base=torch.tensor([0]),
            slots=torch.tensor([self.ring_index.length]),
        )
        self._ahead.begin()
        if self._files and self._ahead.is_wanted:
            self._read_ahead(indices)
        batch = Batch(
            observation=self._observation(indices.now, now or {}),
            action=self._sampler.action(indices),
            reward=indices.reward,
            discount=indices.discount,
            next_observation=self._observation(indices.then, then or {}),
        )
        self._ahead.end()
        return batch

    @property
    def compressed(self) -> bool:
        """Whether pictures are kept compressed."""
        return bool(self._compressed)

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """The ring's arrays by field, (slots, ...), to be read; of compressed pictures none."""
        return self._data

    def counts(self) -> tuple[int, int, int]:
        """The first step that can be sampled, how many steps there were, the newest timestep."""
        return self._first, self._steps, self._timesteps

    def flush(self) -> None:
        """Have everything written reach the disk; returns when it has."""
        for file in self._files.values():
            file.flush()

    def settle(self) -> None:
        """A checkpoint of the present state is on the disk: no older one is to be gone back to."""
        self._settled = self._timesteps
        if self._journal is not None:
            self._journal.empty()

    def state_dict(self) -> dict[str, Any]:
        """The cursor and its counts as plain numbers; the timesteps stay where they are."""
        return {
            "timesteps": self._timesteps,
            "steps": self._steps,
            "open": self._open,
            "starts": {n: pictures.backgrounds.starts for n, pictures in self._compressed.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go back to what `state_dict` said; what was written since then is forgotten.

        What was overwritten since then is put back, if that was the last state to be settled. If
        the timestep of the state itself is overwritten and cannot be put back (the disk was full,
        or the state is an older one), the ring stays as it is, with a warning: the steps that it
        holds are of the same run.

        Raises:
            MerlError: the ring does not hold what the state names, and nothing newer.
        """
        timesteps = int(state["timesteps"])
        journal = self._journal
        there = timesteps == 0 or self._data["timestep"][self._slot(timesteps)] == timesteps
        if not there and (journal is None or not journal.holds(timesteps)):
            if self._timesteps > timesteps:
                _LOG.warning(
                    "the replay has overwritten what it held at the checkpoint, and keeps the %s "
                    "newer steps that it has: training continues, but not bit for bit as before",
                    f"{len(self):,}",
                )
                if journal is not None:
                    journal.empty()
                self._take_over(self._timesteps)
                self._settled = 0
                return
            raise MerlError(
                f"the replay does not hold timestep {timesteps:,}, at which the checkpoint was "
                "taken: it belongs to another run; start a new run"
            )
        for name, starts in state.get("starts", {}).items():
            self._compressed[name].backgrounds.go_back(int(starts))
        if journal is not None:
            journal.undo(timesteps)
        self._take_over(timesteps, int(state["steps"]), bool(state["open"]))
        self._settled = timesteps

    def _slot(self, timestep: int) -> int:
        """Where the ring holds a timestep."""
        return self.ring_index.of(timestep - 1)

    def _write(
        self,
        observation: Observation,
        *,
        position: int,
        action: NDArray[Any] | None,
        reward: float,
        discount: float,
    ) -> None:
        """Write the next timestep; all is checked before anything is changed."""
        data = self._data
        values = {name: observation.get(key) for key, name in self.keys.items()}
        values["action"] = np.zeros_like(data["action"][0]) if action is None else action
        for name, value in values.items():
            field = self._values[name]
            check_value(name, value, field.dtype, field.shape)
        timestep = self._timesteps + 1
        slot = self._slot(timestep)
        kept = {n: p.encode(np.asarray(values.pop(n))) for n, p in self._compressed.items()}
        self._make_room(timestep, kept)
        for name, value in values.items():
            data[name][slot] = value
        for name, picture in kept.items():
            self._compressed[name].write(slot, picture)
        data["position"][slot] = position
        data["reward"][slot] = reward
        data["discount"][slot] = discount
        data["timestep"][slot] = timestep
        self._timesteps = timestep
        self._forget()

    def _make_room(self, timestep: int, kept: Mapping[str, bytes]) -> None:
        """Let go of the oldest timesteps, as many as timestep number `timestep` will overwrite."""
        ends = {name: self._compressed[name].end_of(picture) for name, picture in kept.items()}
        while self._oldest < timestep:
            slot = self._slot(self._oldest)
            if self._oldest > timestep - self.ring_index.length:
                if not any(self._compressed[n].overwritten(slot, end) for n, end in ends.items()):
                    break
                self._tell_of_less()
            if self._journal is not None and self._oldest <= self._settled:
                self._journal.keep(slot, by=timestep)
            # From here on it is no timestep, should the process die while it is overwritten.
            self._data["timestep"][slot] = 0
            self._oldest += 1

    def _tell_of_less(self) -> None:
        """Pictures fill their bytes before the capacity is reached."""
        if not self._told:
            self._told = True
            _LOG.warning(
                "pictures take more bytes than --replay.compress reserves: the replay keeps about "
                "%s of its %s steps; a run with --replay.no-compress keeps all",
                f"{len(self):,}",
                f"{self.capacity:,}",
            )

    def _forget(self) -> None:
        """Let go of the oldest steps: beyond the capacity, or with a frame that is overwritten."""
        while self._first < self._steps:
            source = int(self.sources[self._first % self.capacity])
            position = int(self._data["position"][self._slot(source)])
            oldest = source - min(position, self.config.frame_stack - 1)
            if self._steps - self._first <= self.capacity and oldest >= self._oldest:
                break
            self._first += 1

    def _take_over(
        self, timesteps: int, steps: int | None = None, in_progress: bool = False
    ) -> None:
        """Go on after timestep number `timesteps`: find the steps that the ring holds up to there.

        Args:
            timesteps: timesteps ever written.
            steps: steps ever taken; unknown, they are counted from the oldest that is held.
            in_progress: the episode that the last timestep belongs to goes on.
        """
        stamps = self._data["timestep"]
        stamps[stamps > timesteps] = 0  # else they would pass for what follows, if opened once more
        numbers = np.arange(max(0, timesteps - self.ring_index.length) + 1, timesteps + 1)
        slots = self.ring_index.of(numbers - 1)
        missing = numbers[stamps[slots] != numbers]  # overwritten since, or only half written
        self._oldest = int(missing[-1] if missing.size else timesteps - len(numbers)) + 1
        for pictures in self._compressed.values():
            pictures.go_on_after(self._slot(timesteps) if timesteps else None)
        leads = (numbers[:-1] >= self._oldest) & (self._data["position"][slots[1:]] > 0)
        sources = numbers[:-1][leads][-self.capacity :]
        self._timesteps, self._open = timesteps, in_progress
        self._steps = len(sources) if steps is None else steps
        self._first = self._steps - len(sources)
        self.sources[np.arange(self._steps - len(sources), self._steps) % self.capacity] = sources
        self._forget()

    def _read_ahead(self, indices: SampleIndices) -> None:
        """Ask for the pictures of a batch: a sample's lie in one piece but for where the ring ends.

        They are on the disk alone after a resumption, and wherever others use the memory.
        """
        now, then = indices.now.numpy(), indices.then.numpy()
        near = self.config.n_step <= self.config.frame_stack  # o_t and o_{t+n} touch
        for first, last in [(now, then)] if near else [(now, now), (then, then)]:
            for name, pictures in self._images.items():
                self._ahead.ask(self._files[name], *pictures.stretch(first[:, 0], last[:, -1]))

    def _observation(self, slots: torch.Tensor, copies: FrameTransforms) -> dict[str, torch.Tensor]:
        """Images (B, K, H, W, C) at slots (B, K), vectors (B, n) at the newest of them."""
        return {
            key: torch.from_numpy(
                copied(self._images[name], slots.numpy(), copies.get(key, as_it_is))
            )
            if name in self._compressed or key in copies
            else self._sampler.observed(name, slots)
            for key, name in self.keys.items()
        }
