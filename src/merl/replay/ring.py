"""Ring of slots, timesteps and steps; sampling makes the frame stacks and the n-step returns.

One slot holds one *timestep*: an observation, and the action, reward and discount that led to it.
An episode of T steps takes T + 1 consecutive timesteps; the first of them has no action. Timesteps
are numbered 1, 2, 3, ...; timestep i is entry i - 1 of the slots (`ring_index.py`).

    timestep        7      8      9     10     11     12
    position      0      1      2      3      0      1      in its episode; 0 is the first
    step              *      *      *             *         o_t -> o_{t+1}, the unit of sampling

If the process is killed, no written data is lost. If the machine loses power, data since the last
`flush` is lost, and old timesteps that this data had begun to overwrite may be corrupt. To save a
checkpoint, call `flush`, store `state_dict`, and call `settle` once the checkpoint is on disk. From
then on, overwritten timesteps go into a journal, from which `load_state_dict` restores them.
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

from merl.core import Batch, FrameTransforms, MerlError, Observation, Transition
from merl.modalities import modalities_of
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
    """Ring of environment steps, from which batches are sampled.

    Every step in the ring is sampled with the same probability, including the steps of the episode
    in progress. Stacks and returns do not cross episode boundaries: at the start the stack repeats
    the first frame, at the end the return is shorter. A new episode truncates one that has not
    ended; the truncated one bootstraps, as at a time limit.

    Attributes:
        config: contents of the ring and how it is sampled.
        capacity: maximum number of steps.
        ring_index: map from timesteps to slots; a timestep's entry is its number minus one.
        keys: the field of each observation key.
        sources: step i starts at timestep sources[i mod capacity].
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
        """Create the ring, or open the existing ring in `directory` with all its data.

        Args:
            config: contents of the ring and how it is sampled.
            observation_space: the keys to store: images (uint8, H x W x C) and vectors (float, n).
            action_space: a vector.
            directory: folder of the memory-mapped ring; None: the ring is in memory.
            capacity: maximum number of steps, instead of the config's. An existing ring grows to
                it.

        Raises:
            MerlError: a space cannot be stored, the capacity does not fit, or the directory holds
                another replay or cannot be written. No new file remains.
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
        self._values = {**fields_of(observation_space, action_space)}  # fields of written values
        self._ahead = ReadAhead()
        self._images: dict[str, Pictures] = {
            name: self._compressed[name] if name in self._compressed else RawPictures(arrays[name])
            for key, name in self.keys.items()
            if modalities_of(observation_space)[key].stacked
        }
        self._journal: Journal | None = None
        if directory is not None:
            self._journal = Journal(directory, self._data, layout.slots, self._compressed)
        self.ring_index = layout.slots
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        self._sampler = Sampler(tensors, config)
        self._timesteps = self._steps = 0  # numbers ever written
        self._first = 0  # the oldest step that can be sampled
        self._oldest = 1  # the oldest timestep in the ring
        self._open = False  # an episode is in progress
        self._settled = 0  # the newest timestep of the last checkpoint
        self._warned = False  # that the ring holds fewer steps than its capacity
        self.sources = np.zeros(self.capacity, np.int64)
        self._rebuild(timesteps=int(self._data["timestep"].max()))

    def __len__(self) -> int:
        """Return the number of steps that can be sampled."""
        return self._steps - self._first

    def begin(self, observation: Observation) -> None:
        """Write the first timestep of an episode; truncate one that is still in progress.

        Raises:
            MerlError: the observation does not fit the space.
        """
        self._write(observation, position=0, action=None, reward=0.0, discount=1.0)
        for name, pictures in self._compressed.items():
            key = next(key for key, field in self.keys.items() if field == name)
            pictures.backgrounds.begun(observation[key])
        self._open = True

    def add(self, transition: Transition) -> None:
        """Write one step of the episode in progress.

        Raises:
            MerlError: the action or the observation does not fit its space.
            ValueError: no episode is in progress, or the discount contradicts `last`.
        """
        if not self._open:
            raise ValueError("no episode is in progress: call begin() with its first observation")
        if transition.discount != 1.0 and not (transition.discount == 0.0 and transition.last):
            raise ValueError(
                f"discount {transition.discount} with last={transition.last} is invalid: use 0 "
                "with last=True at a true end, and 1 everywhere else"
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
        """Draw steps uniformly with replacement.

        The same content and the same state of `rng` give the same batch.

        Args:
            batch_size: B.
            rng: random generator.
            now: frame transforms of o_t by image key; frames of other keys are copied unchanged.
            then: frame transforms of o_{t+n}.

        Returns:
            Tensors on the CPU, owned by the caller; shapes as in `merl.core.Batch`.

        Raises:
            ValueError: the ring holds no step.
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
        """Whether images are stored compressed."""
        return bool(self._compressed)

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays by field, (slots, ...), to read only; without compressed images."""
        return self._data

    def counts(self) -> tuple[int, int, int]:
        """Return the first step that can be sampled, the steps so far, and the newest timestep."""
        return self._first, self._steps, self._timesteps

    def flush(self) -> None:
        """Write all data to the disk, and return when it is there."""
        for file in self._files.values():
            file.flush()

    def settle(self) -> None:
        """Confirm that a checkpoint of this state is on disk: older states are not needed."""
        self._settled = self._timesteps
        if self._journal is not None:
            self._journal.empty()

    def state_dict(self) -> dict[str, Any]:
        """Return the counts that locate the data, as plain numbers; the data stays in the ring."""
        return {
            "timesteps": self._timesteps,
            "steps": self._steps,
            "open": self._open,
            "starts": {n: pictures.backgrounds.starts for n, pictures in self._compressed.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore from `state_dict()`, and discard everything written since then.

        Timesteps that were overwritten since then are restored, if the state is the last one that
        was settled. If the state's own timestep is overwritten and cannot be restored (the disk was
        full, or the state is older), the ring stays unchanged, with a warning: its steps are from
        the same run.

        Raises:
            MerlError: the ring holds neither the state's timestep nor a newer one.
        """
        timesteps = int(state["timesteps"])
        journal = self._journal
        is_held = timesteps == 0 or self._data["timestep"][self._slot(timesteps)] == timesteps
        if not is_held and (journal is None or not journal.holds(timesteps)):
            if self._timesteps > timesteps:
                _LOG.warning(
                    "the replay has overwritten timesteps of the checkpoint and keeps its %s newer "
                    "steps: training continues, but not bit-exactly",
                    f"{len(self):,}",
                )
                if journal is not None:
                    journal.empty()
                self._rebuild(self._timesteps)
                self._settled = 0
                return
            raise MerlError(
                f"the replay does not hold timestep {timesteps:,} of the checkpoint: the replay "
                "belongs to another run; restore the complete run folder, or start a new run"
            )
        for name, starts in state.get("starts", {}).items():
            self._compressed[name].backgrounds.go_back(int(starts))
        if journal is not None:
            journal.undo(timesteps)
        self._rebuild(timesteps, int(state["steps"]), bool(state["open"]))
        self._settled = timesteps

    def _slot(self, timestep: int) -> int:
        """Return the slot of a timestep."""
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
        """Write the next timestep; check all values before any change."""
        data = self._data
        values = {name: observation.get(key) for key, name in self.keys.items()}
        values["action"] = np.zeros_like(data["action"][0]) if action is None else action
        for name, value in values.items():
            field = self._values[name]
            check_value(name, value, field.dtype, field.shape)
        timestep = self._timesteps + 1
        slot = self._slot(timestep)
        encoded = {n: p.encode(np.asarray(values.pop(n))) for n, p in self._compressed.items()}
        self._make_room(timestep, encoded)
        for name, value in values.items():
            data[name][slot] = value
        for name, picture in encoded.items():
            self._compressed[name].write(slot, picture)
        data["position"][slot] = position
        data["reward"][slot] = reward
        data["discount"][slot] = discount
        data["timestep"][slot] = timestep
        self._timesteps = timestep
        self._forget()

    def _make_room(self, timestep: int, encoded: Mapping[str, bytes]) -> None:
        """Release the oldest timesteps, which timestep number `timestep` will overwrite."""
        ends = {name: self._compressed[name].end_of(picture) for name, picture in encoded.items()}
        while self._oldest < timestep:
            slot = self._slot(self._oldest)
            if self._oldest > timestep - self.ring_index.length:
                if not any(self._compressed[n].overwritten(slot, end) for n, end in ends.items()):
                    break
                self._warn_of_fewer_steps()
            if self._journal is not None and self._oldest <= self._settled:
                self._journal.keep(slot, by=timestep)
            # Mark the slot as empty, in case the process dies while overwriting it.
            self._data["timestep"][slot] = 0
            self._oldest += 1

    def _warn_of_fewer_steps(self) -> None:
        """Warn, once, that images fill the reserved bytes before the capacity is reached."""
        if not self._warned:
            self._warned = True
            _LOG.warning(
                "images take more bytes than --replay.compress reserves: the replay keeps about "
                "%s of its %s steps; to keep all, start a run with --replay.no-compress",
                f"{len(self):,}",
                f"{self.capacity:,}",
            )

    def _forget(self) -> None:
        """Release the oldest steps: those beyond the capacity or with an overwritten frame."""
        while self._first < self._steps:
            source = int(self.sources[self._first % self.capacity])
            position = int(self._data["position"][self._slot(source)])
            oldest = source - min(position, self.config.frame_stack - 1)
            if self._steps - self._first <= self.capacity and oldest >= self._oldest:
                break
            self._first += 1

    def _rebuild(self, timesteps: int, steps: int | None = None, in_progress: bool = False) -> None:
        """Set the ring to timestep number `timesteps`, and find the steps that it holds up to it.

        Args:
            timesteps: number of timesteps ever written.
            steps: number of steps ever written; None: number of steps in the ring.
            in_progress: whether the episode of the last timestep continues.
        """
        stamps = self._data["timestep"]
        stamps[stamps > timesteps] = 0  # else a later opening would find them as newer timesteps
        numbers = np.arange(max(0, timesteps - self.ring_index.length) + 1, timesteps + 1)
        slots = self.ring_index.of(numbers - 1)
        missing = numbers[stamps[slots] != numbers]  # overwritten, or only half written
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
        """Request the images of a batch; those of a sample are contiguous except at the ring's end.

        Images are only on disk after a run was resumed, or if other programs use the memory.
        """
        now, then = indices.now.numpy(), indices.then.numpy()
        near = self.config.n_step <= self.config.frame_stack  # stacks of o_t and o_{t+n} touch
        for first, last in [(now, then)] if near else [(now, now), (then, then)]:
            for name, pictures in self._images.items():
                self._ahead.ask(self._files[name], *pictures.stretch(first[:, 0], last[:, -1]))

    def _observation(self, slots: torch.Tensor, copies: FrameTransforms) -> dict[str, torch.Tensor]:
        """Return images (B, K, H, W, C) at slots (B, K), and vectors (B, n) at the newest slots."""
        return {
            key: torch.from_numpy(
                copied(self._images[name], slots.numpy(), copies.get(key, as_it_is))
            )
            if name in self._compressed or key in copies
            else self._sampler.observed(name, slots)
            for key, name in self.keys.items()
        }
