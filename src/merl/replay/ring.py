"""Ring of the timesteps of one environment.

One slot holds one *timestep*: an observation, and the action, reward and discount that led to it.
An episode of T steps takes T + 1 consecutive timesteps; the first of them has no action. Timesteps
are numbered 1, 2, 3, ...; timestep i is in slot (i - 1) mod slots.

    timestep        7      8      9     10     11     12
    position      0      1      2      3      0      1      in its episode; 0 is the first
    step              *      *      *             *         o_t -> o_{t+1}, the unit of sampling
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError, Observation, Transition, counted
from merl.replay.checksums import Checksums, Covered, RingData
from merl.replay.compression import ByteRing, CompressedFrames
from merl.replay.damage import Damage, leave_out
from merl.replay.journal import Journal
from merl.replay.spec import ReplaySpec, field_name
from merl.replay.storage import Storage

CHUNK = 4096
"""Number of timesteps that are copied at once."""
_LOG = logging.getLogger(__name__)
Number = TypeVar("Number", int, NDArray[np.int64])


class EpisodeRing:
    """Ring of environment steps.

    A new episode truncates one that has not ended; the truncated one bootstraps, as at a time
    limit.

    Args:
        number: number of the ring; its slots in the arrays follow those of rings 0 to number - 1.
        spec: what is stored.
        storage: the arrays of all rings; existing timesteps are kept.
        frames: the compressed frames by key.
        journal: records what is overwritten; None: nothing does.

    Attributes:
        number: number of the ring.
        timesteps: number of timesteps ever written, which is the number of the newest one.
        steps: number of steps ever written.
        first: the oldest step that can be sampled; steps are numbered 0, 1, 2, ...
        sources: step i starts at timestep sources[i mod capacity].
        in_progress: whether an episode is in progress.
    """

    def __init__(
        self,
        number: int,
        spec: ReplaySpec,
        storage: Storage,
        frames: Mapping[str, CompressedFrames],
        journal: Journal | None,
    ) -> None:
        self.number, self._spec, self._capacity = number, spec, spec.ring_capacity
        self._slots, self._base = storage.slots, number * storage.slots
        self._all = RingData(spec, storage.arrays, number, storage.slots)
        self._checksums = Checksums(self._all)
        self._frames, self._journal = frames, journal
        self._data = {
            name: array[self._base : self._base + self._slots]
            for name, array in storage.arrays.items()
        }
        self._bytes: dict[str, ByteRing] = {}
        for key, each in frames.items():
            size = self._data.pop(field_name(key)).nbytes
            self._bytes[key] = ByteRing(each, number * size, size)
        self.timesteps = self.steps = self.first = 0
        self.in_progress = False
        self._oldest = 1  # the oldest timestep in the ring
        self._confirmed = 0  # the newest timestep of the last checkpoint
        self._warned = False  # that the ring holds fewer steps than its capacity
        self.sources = np.zeros(self._capacity, np.int64)
        self._rebuild(self._newest())

    def __len__(self) -> int:
        """Return the number of steps that can be sampled."""
        return self.steps - self.first

    def draw(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Return the first timesteps of `count` steps, drawn uniformly with replacement."""
        steps = rng.integers(self.first, self.steps, size=count)
        return self.sources[steps % self._capacity]

    def begin(self, observation: Observation) -> None:
        """Write the first timestep of an episode; see `ReplayBuffer.begin`."""
        action = np.zeros(self._spec.action_shape, np.float32)
        self._write(observation, action, position=0, reward=0.0, discount=1.0)
        for key, frames in self._frames.items():
            frames.backgrounds.add(observation[key])
        self.in_progress = True

    def add(self, transition: Transition) -> None:
        """Write one step of the episode in progress; see `ReplayBuffer.add`."""
        if not self.in_progress:
            raise ValueError("no episode is in progress: call begin() with its first observation")
        if transition.discount != 1.0 and not (transition.discount == 0.0 and transition.last):
            raise ValueError(
                f"discount {transition.discount} with last={transition.last} is invalid: use 0 "
                "with last=True at a true end, and 1 everywhere else"
            )
        source = self.timesteps
        self._write(
            transition.observation,
            transition.action,
            position=int(self._data["position"][self._slot(source)]) + 1,
            reward=float(transition.reward),
            discount=float(transition.discount),
        )
        self.sources[self.steps % self._capacity] = source
        self.steps += 1
        self._forget()
        self.in_progress = not transition.last

    def confirm_checkpoint(self) -> bool:
        """Confirm that a checkpoint of this state is on disk; return whether it is a new state."""
        changed, self._confirmed = self._confirmed != self.timesteps, self.timesteps
        return changed

    def state_dict(self) -> dict[str, Any]:
        """Return the counts that locate the data, as plain numbers."""
        return {"timesteps": self.timesteps, "steps": self.steps, "open": self.in_progress}

    def covered(self) -> Covered:
        """Return which timesteps a checkpoint of this state covers, and their checksums."""
        sums = self._checksums.update(self._oldest, self.timesteps)
        return {"oldest": self._oldest, "newest": self.timesteps, "first": self.first, "sums": sums}

    def load_state_dict(
        self,
        state: Mapping[str, Any],
        covered: Covered | None = None,
        damage: Sequence[Damage] = (),
    ) -> bool:
        """Restore from `state_dict()`; see `ReplayBuffer.load_state_dict`.

        Args:
            state: the state.
            covered: from `covered()` of this state, if it is known.
            damage: the damage in the ring; its episodes are left out, with a warning.

        Returns:
            Whether the state is restored; else the ring keeps its newer timesteps.
        """
        timesteps = int(state["timesteps"])
        self._checksums = Checksums(self._all)
        if covered is not None and damage:
            self._leave_out(covered, damage)
        if timesteps == 0 or self._data["timestep"][self._slot(timesteps)] == timesteps:
            oldest = covered["oldest"] if covered else 1
            # The rest of an episode that was left out would begin with a damaged observation.
            is_open = bool(state["open"]) and not damage
            self._rebuild(timesteps, int(state["steps"]), is_open, oldest)
            self._confirmed = timesteps
            if covered is not None and not damage:
                self._continue(covered)
            return True
        newest = self._newest()
        if newest <= timesteps:
            raise MerlError(
                f"the replay does not hold timestep {timesteps:,} of the checkpoint: the replay "
                "belongs to another run; restore the complete run folder, or start a new run"
            )
        self._rebuild(newest)
        self._confirmed = 0
        _LOG.warning(
            "the replay has overwritten timesteps of the checkpoint and keeps its %s newer "
            "steps: training continues, but not bit-exactly",
            f"{len(self):,}",
        )
        return False

    def _leave_out(self, covered: Covered, damage: Sequence[Damage]) -> None:
        episodes, timesteps = leave_out(self._all, covered, damage)
        _LOG.warning(
            "%s of environment %s (%s) are left out of the replay, because of damage: training "
            "continues, but not bit-exactly",
            counted(episodes, "episode"),
            self.number,
            counted(timesteps, "timestep"),
        )

    def _continue(self, covered: Covered) -> None:
        """Continue with checksums that were found to be right."""
        self._checksums.adopt(covered)
        if self.first > covered["first"]:
            _LOG.warning(
                "the replay has overwritten %s of the checkpoint: training continues without them, "
                "and not bit-exactly",
                counted(self.first - covered["first"], "step"),
            )

    def copy_from(self, other: EpisodeRing) -> None:
        """Copy the timesteps of a shorter ring."""
        for begin in range(other._oldest, other.timesteps + 1, CHUNK):
            numbers = np.arange(begin, min(begin + CHUNK, other.timesteps + 1))
            for name, array in self._data.items():
                array[self._slot(numbers)] = other._data[name][other._slot(numbers)]
        for timestep in range(other._oldest, other.timesteps + 1):
            for key, ring in self._bytes.items():
                ring.write(self._row(timestep), other._frames[key].read(other._row(timestep)))
        self._rebuild(other.timesteps, other.steps, other.in_progress)
        self._confirmed = other._confirmed

    def _slot(self, timestep: Number) -> Number:
        """Return the slot of a timestep, or of many, in this ring."""
        return (timestep - 1) % self._slots

    def _row(self, timestep: int) -> int:
        """Return the slot of a timestep in the arrays of all rings."""
        return self._base + self._slot(timestep)

    def _newest(self) -> int:
        return int(self._data["timestep"].max())

    def _write(
        self,
        observation: Observation,
        action: NDArray[Any],
        *,
        position: int,
        reward: float,
        discount: float,
    ) -> None:
        """Write the next timestep; check all values before any change."""
        values: dict[str, Any] = {"action": action}
        encoded = {}
        self._spec.fields["action"].check("action", action)
        for key, spec in self._spec.keys.items():
            name = field_name(key)
            values[name] = observation.get(key)
            spec.check(name, values[name])
            if key in self._frames:
                encoded[key] = self._frames[key].encode(np.asarray(values.pop(name)))
        timestep, data = self.timesteps + 1, self._data
        slot = self._slot(timestep)
        self._make_room(timestep, encoded)
        for key, frame in encoded.items():
            self._bytes[key].write(self._base + slot, frame)
        values |= {"position": position, "reward": reward, "discount": discount}
        for name, value in values.items():
            data[name][slot] = value
        data["timestep"][slot] = self.timesteps = timestep
        self._forget()

    def _make_room(self, timestep: int, encoded: Mapping[str, bytes]) -> None:
        """Release the oldest timesteps, which timestep number `timestep` will overwrite."""
        while self._oldest < timestep:
            row = self._row(self._oldest)
            if self._oldest > timestep - self._slots:
                if not any(self._bytes[key].overwrites(row, f) for key, f in encoded.items()):
                    break
                self._warn_of_fewer_steps()
            if self._journal is not None and self._oldest <= self._confirmed:
                self._keep(row, timestep)
            # Mark the slot as empty, in case the process dies while overwriting it.
            self._data["timestep"][self._slot(self._oldest)] = 0
            self._oldest += 1

    def _keep(self, row: int, timestep: int) -> None:
        """Record a slot in the journal before timestep number `timestep` overwrites it."""
        assert self._journal is not None
        sizes = {name: self._spec.fields[name].bytes for name in self._data}
        ranges = [(name, row * size, size) for name, size in sizes.items()]
        ranges += [(field_name(key), *frames.span(row)) for key, frames in self._frames.items()]
        self._journal.keep(self.number, timestep, ranges)

    def _warn_of_fewer_steps(self) -> None:
        """Warn, once, that frames fill the reserved bytes before the capacity is reached."""
        if not self._warned:
            self._warned = True
            _LOG.warning(
                "images take more bytes than --replay.compress reserves: the replay keeps about "
                "%s of its %s steps; to keep all, start a run with --replay.no-compress",
                f"{len(self):,}",
                f"{self._capacity:,}",
            )

    def _forget(self) -> None:
        """Release the oldest steps: those beyond the capacity or with an overwritten frame."""
        while self.first < self.steps:
            source = int(self.sources[self.first % self._capacity])
            position = int(self._data["position"][self._slot(source)])
            oldest = source - min(position, self._spec.config.frame_stack - 1)
            if self.steps - self.first <= self._capacity and oldest >= self._oldest:
                break
            self.first += 1

    def _rebuild(
        self,
        timesteps: int,
        steps: int | None = None,
        in_progress: bool = False,
        oldest: int = 1,
    ) -> None:
        """Set the ring to timestep number `timesteps`, and find the steps that it holds up to it.

        Args:
            timesteps: number of timesteps ever written.
            steps: number of steps ever written; None: number of steps in the ring.
            in_progress: whether the episode of the last timestep continues.
            oldest: the oldest timestep that the ring may hold.
        """
        stamps = self._data["timestep"]
        stamps[stamps > timesteps] = 0  # else a later opening would find them as newer timesteps
        numbers = np.arange(max(timesteps - self._slots + 1, oldest), timesteps + 1)
        slots = self._slot(numbers)
        missing = numbers[stamps[slots] != numbers]  # overwritten, or only half written
        self._oldest = int(missing[-1] if missing.size else timesteps - len(numbers)) + 1
        for ring in self._bytes.values():
            ring.continue_after(self._row(timesteps) if timesteps else None)
        leads = (numbers[:-1] >= self._oldest) & (self._data["position"][slots[1:]] > 0)
        sources = numbers[:-1][leads][-self._capacity :]
        self.timesteps, self.in_progress = timesteps, in_progress
        self.steps = len(sources) if steps is None else steps
        self.first = self.steps - len(sources)
        self.sources[np.arange(self.first, self.steps) % self._capacity] = sources
        self._forget()
