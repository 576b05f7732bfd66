"""Replay of several environments, from which batches are sampled.

If the process is killed, no written data is lost. If the machine loses power, data since the last
`flush` is lost, and old timesteps that this data had begun to overwrite may be corrupt. To save a
checkpoint, call `flush`, store `state_dict`, and call `confirm_checkpoint` once the checkpoint is
on disk. From then on, overwritten timesteps go into a journal, from which `load_state_dict`
restores them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from merl.core import Batch, FrameTransforms, MerlError, Observation, Transition
from merl.replay.capacity import check_fits
from merl.replay.compression import CompressedFrames
from merl.replay.damage import JOURNAL, find_damage
from merl.replay.journal import Journal
from merl.replay.ring import EpisodeRing
from merl.replay.sampling import SampleIndices, Sampler
from merl.replay.spec import ReplaySpec, field_name, span_name
from merl.replay.stack_reader import RawFrames, ReadAhead, copy_stacks, copy_unchanged
from merl.replay.storage import Storage, in_memory, is_lost, new_files, open_files

_LOG = logging.getLogger(__name__)


class ReplayBuffer:
    """One ring for each environment, so that each episode is contiguous in its ring.

    Every step in any of the rings is sampled with the same probability, including the steps of
    episodes in progress. Stacks and returns do not cross episode boundaries: at the start the stack
    repeats the first frame, at the end the return is shorter.

    Args:
        spec: what the replay stores, and how it is sampled.
        directory: folder of the memory-mapped files; None: in memory. Existing files are opened
            with all their data. If they are too small for the capacity, `load_state_dict` replaces
            them by larger ones.

    Attributes:
        spec: what the replay stores, and how it is sampled.
        rings: the rings, in the order of the environments.

    Raises:
        MerlError: the capacity does not fit, or the directory holds another replay or cannot be
            written. No new file remains.
    """

    def __init__(self, spec: ReplaySpec, directory: Path | None = None) -> None:
        check_fits(spec, directory)
        self.spec, self._directory, self._ahead = spec, directory, ReadAhead()
        self._use(in_memory(spec) if directory is None else open_files(directory, spec))

    def _use(self, storage: Storage) -> None:
        """Use these arrays, with the timesteps that are in them."""
        self._storage, arrays, folder = storage, storage.arrays, self._directory
        self._compressed = {
            key: CompressedFrames(
                self.spec.keys[key],
                arrays[field_name(key)].reshape(-1),
                arrays[span_name(key)],
                None if folder is None else folder / f"{field_name(key)}.starts",
            )
            for key in self.spec.compressed
        }
        self._frames: Mapping[str, RawFrames | CompressedFrames] = {
            key: self._compressed.get(key) or RawFrames(spec, arrays[field_name(key)])
            for key, spec in self.spec.keys.items()
            if spec.stacked
        }
        self._journal = None if folder is None else Journal(folder / JOURNAL, arrays)
        self.rings = [
            EpisodeRing(number, self.spec, storage, self._compressed, self._journal)
            for number in range(self.spec.rings)
        ]
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        self._sampler = Sampler(tensors, self.spec, storage.slots)

    def __len__(self) -> int:
        """Return the number of steps that can be sampled."""
        return sum(len(ring) for ring in self.rings)

    @property
    def slots(self) -> int:
        """Return the number of slots of each ring."""
        return self._storage.slots

    @property
    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """Return the arrays by field, (rings * slots, ...), to read only."""
        return self._storage.arrays

    def begin(self, observation: Observation, environment: int = 0) -> None:
        """Write the first timestep of an episode; truncate one that is still in progress.

        Raises:
            MerlError: the observation does not fit the space.
        """
        self.rings[environment].begin(observation)

    def add(self, transition: Transition, environment: int = 0) -> None:
        """Write one step of the episode in progress.

        Raises:
            MerlError: the action or the observation does not fit its space.
            ValueError: no episode is in progress, or the discount contradicts `last`.
        """
        self.rings[environment].add(transition)

    def sample(
        self,
        batch_size: int,
        rng: np.random.Generator,
        now: FrameTransforms | None = None,
        then: FrameTransforms | None = None,
    ) -> Batch:
        """Draw steps uniformly with replacement; samples of one ring are adjacent.

        The same content and the same state of `rng` give the same batch.

        Args:
            batch_size: B.
            rng: random generator.
            now: frame transforms of o_t by image key; frames of other keys are copied unchanged.
            then: frame transforms of o_{t+n}.

        Returns:
            Tensors on the CPU, owned by the caller; shapes as in `merl.core.Batch`.

        Raises:
            ValueError: the replay holds no step.
        """
        if not len(self):
            raise ValueError("the replay is empty: add a step before sampling")
        indices = self._sampler.pick(*self._draw(batch_size, rng))
        self._ahead.begin()
        if self._storage.files and self._ahead.is_wanted:
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

    def flush(self) -> None:
        """Write all data to the disk, and return when it is there.

        If a file was removed, all are written again, with a warning.

        Raises:
            MerlError: they cannot be written again.
            OSError: the disk failed.
        """
        if self._directory is not None and is_lost(self._directory, self._storage):
            _LOG.warning("the replay in %s was removed: it is written again", self._directory)
            self._copy_to_new_files(self._directory)
        self._storage.flush()

    def confirm_checkpoint(self) -> None:
        """Confirm that a checkpoint of this state is on disk.

        Of older states only the one that was confirmed before it can still be restored.
        """
        changed = [ring.confirm_checkpoint() for ring in self.rings]
        if self._journal is not None and any(changed):
            self._journal.begin_anew()

    def state_dict(self) -> dict[str, Any]:
        """Return the counts that locate the data, as plain numbers; the data stays in the rings."""
        return {
            "rings": [ring.state_dict() for ring in self.rings],
            "open": any(ring.in_progress for ring in self.rings),
            "starts": {key: each.backgrounds.frames for key, each in self._compressed.items()},
        }

    def checksums(self) -> dict[str, Any]:
        """Return checksums of the data: with them in a state, `load_state_dict` finds damage."""
        backgrounds = {key: each.backgrounds for key, each in self._compressed.items()}
        return {
            "covered": [ring.covered() for ring in self.rings],
            "start_sums": {key: each.checksum(each.frames) for key, each in backgrounds.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any], *, skip_damaged: bool = False) -> None:
        """Restore from `state_dict()`, and discard everything written since then.

        If the state also has `checksums()`, data on disk is compared with them first.

        Timesteps that were overwritten since then are restored, if the state is that of the last
        confirmed checkpoint or of the one before it. If a ring has overwritten the state's own
        timestep and cannot restore it (the disk was full, or the state is older), it keeps its
        newer steps, with a warning: they are from the same run. Files that are too small for the
        capacity are replaced.

        Args:
            state: the state.
            skip_damaged: leave out the episodes of damaged data, with a warning.

        Raises:
            MerlError: data is damaged, and nothing was changed; or a ring holds neither the state's
                timestep nor a newer one, or larger files cannot be written.
        """
        damage = []
        if self._directory is not None:
            damage = find_damage(self._directory, self.spec, state)
        if damage and not skip_damaged:
            others = f", and {len(damage) - 1:,} other blocks are" if len(damage) > 1 else ""
            raise MerlError(
                f"{damage[0]}{others}: restore the file from a copy, or leave out the episodes of "
                "damaged blocks with --damaged skip"
            )
        pairs = list(zip(self.rings, state["rings"], strict=True))
        if self._journal is not None:
            self._journal.undo([int(ring_state["timesteps"]) for _, ring_state in pairs])
        exact = [
            ring.load_state_dict(
                ring_state, covered, [each for each in damage if each.ring == ring.number]
            )
            for (ring, ring_state), covered in zip(
                pairs, state.get("covered", [None] * len(pairs)), strict=True
            )
        ]
        if damage and not len(self):
            raise MerlError(
                f"the replay in {self._directory} holds no step without damage: restore the file "
                "from a copy, or start a new run from this one's policy (--agent.start-from RUN)"
            )
        if all(exact):
            for key, frames in state["starts"].items():
                self._compressed[key].backgrounds.truncate(int(frames))
        if self._directory is not None and self.slots < self.spec.slots:
            self._copy_to_new_files(self._directory)

    def _copy_to_new_files(self, directory: Path) -> None:
        """Replace the files by new ones, of the size for the capacity, with the same timesteps."""
        rings, compressed = self.rings, self._compressed
        with new_files(directory, self.spec) as storage:
            for frames in compressed.values():
                frames.backgrounds.write_again()
            self._use(storage)
            for ring, shorter in zip(self.rings, rings, strict=True):
                ring.copy_from(shorter)
        if self._journal is not None:
            self._journal.forget_former()

    def _draw(self, batch_size: int, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Return ring, first timestep, and the ring's newest timestep of each sample."""
        counts = [batch_size]
        if len(self.rings) > 1:
            shares = np.array([len(ring) for ring in self.rings]) / len(self)
            counts = rng.multinomial(batch_size, shares).tolist()
        drawn = {i: self.rings[i].draw(count, rng) for i, count in enumerate(counts) if count}
        ring = np.repeat(list(drawn), [len(source) for source in drawn.values()])
        newest = np.array([each.timesteps for each in self.rings])[ring]
        source = np.concatenate(list(drawn.values()))
        return torch.from_numpy(ring), torch.from_numpy(source), torch.from_numpy(newest)

    def _read_ahead(self, indices: SampleIndices) -> None:
        """Request the frames of a batch; those of a sample are contiguous except at the ring's end.

        Frames are only on disk after a run was resumed, or if other programs use the memory.
        """
        now, then = indices.now.numpy(), indices.then.numpy()
        config = self.spec.config
        near = config.n_step <= config.frame_stack  # stacks of o_t and o_{t+n} touch
        for first, last in [(now, then)] if near else [(now, now), (then, then)]:
            for key, frames in self._frames.items():
                file = self._storage.files[field_name(key)]
                self._ahead.request(file, *frames.byte_range(first[:, 0], last[:, -1]))

    def _observation(self, slots: Tensor, transforms: FrameTransforms) -> dict[str, Tensor]:
        """Return stacks (B, K, *shape) at slots (B, K), and other values at the newest slots."""
        return {
            key: torch.from_numpy(
                copy_stacks(self._frames[key], slots.numpy(), transforms.get(key, copy_unchanged))
            )
            if key in self._compressed or key in transforms
            else self._sampler.observed(key, slots)
            for key in self.spec.keys
        }
