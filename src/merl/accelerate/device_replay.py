"""A copy of the rings on the learner's device, from which batches are drawn there.

A run is resumed from the rings on the host, not from the copy. `follow` copies new entries, one or
two slots per step. Sampling reads only the copy and never waits for the host, so that it can be
part of a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import torch
from torch import Tensor

from merl.core import Batch
from merl.replay.buffer import ReplayBuffer
from merl.replay.sampling import Sampler

CHUNK = 4096
"""Maximum number of slots that are copied at once."""


def bytes_on_device(replay: ReplayBuffer) -> int:
    """Return the bytes that the copy takes."""
    return sum(array.nbytes for array in replay.arrays.values())


class DeviceReplay:
    """Copy, on a device, of a replay.

    Args:
        replay: the replay on the host, without compression.
        device: device of the copy.
    """

    def __init__(self, replay: ReplayBuffer, device: torch.device) -> None:
        self._replay, self._device = replay, device
        self._fields = {
            name: torch.empty_like(torch.from_numpy(array), device=device)
            for name, array in replay.arrays.items()
        }
        rings = len(replay.rings)
        self._sources = torch.zeros(
            rings * replay.spec.ring_capacity, dtype=torch.int64, device=device
        )
        # For each ring: its first step that can be sampled, its steps so far, and its newest
        # timestep.
        self._counts = torch.zeros((rings, 3), dtype=torch.int64, device=device)
        self._host_counts = torch.zeros_like(self._counts, device="cpu")
        self._sampler = Sampler(self._fields, replay.spec, replay.slots)

    def follow(self) -> None:
        """Copy what was added to the rings since the last call."""
        replay, had = self._replay, self._host_counts
        counts = torch.tensor([(ring.first, ring.steps, ring.timesteps) for ring in replay.rings])
        if torch.equal(counts, had):
            return
        self._host_counts = counts
        arrays = {name: torch.from_numpy(array) for name, array in replay.arrays.items()}
        for number, ring in enumerate(replay.rings):
            _, had_steps, had_timesteps = had[number].tolist()
            for begin, end in _parts(had_timesteps, ring.timesteps, replay.slots):
                base = number * replay.slots
                for name, array in arrays.items():
                    self._copy(array[base + begin : base + end], self._fields[name], base + begin)
            for begin, end in _parts(had_steps, ring.steps, replay.spec.ring_capacity):
                sources = torch.from_numpy(ring.sources[begin:end])
                self._copy(sources, self._sources, number * replay.spec.ring_capacity + begin)
        self._copy(counts, self._counts, 0)

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw steps uniformly, with replacement, from what `follow` has copied.

        Args:
            batch_size: B; the copy must hold at least one step.
            generator: random generator on the device.

        Returns:
            Tensors on the device; shapes as in `merl.core.Batch`.
        """
        first, steps, _ = self._counts.unbind(dim=1)
        through = (steps - first).cumsum(dim=0)  # steps of this ring and of those before it
        share = torch.rand(
            batch_size, dtype=torch.float64, generator=generator, device=self._device
        )
        drawn = torch.minimum((share * through[-1]).long(), through[-1] - 1)
        ring = torch.searchsorted(through, drawn, right=True)
        return self.at(ring, steps[ring] - through[ring] + drawn)

    def at(self, ring: Tensor, step: Tensor) -> Batch:
        """Return the samples that start at steps `step` of rings `ring`, each int64 (B,)."""
        capacity = self._replay.spec.ring_capacity
        source = self._sources[ring * capacity + step % capacity]
        indices = self._sampler.pick(ring, source, self._counts[ring, 2])
        now, then = (
            {key: self._sampler.observed(key, slots) for key in self._replay.spec.keys}
            for slots in (indices.now, indices.then)
        )
        return Batch(now, self._sampler.action(indices), indices.reward, indices.discount, then)

    def _copy(self, part: Tensor, whole: Tensor, at: int) -> None:
        """Copy rows to the device; from pinned memory, so that the host does not wait."""
        if self._device.type == "cuda":
            part = part.pin_memory()
        whole[at : at + len(part)].copy_(part, non_blocking=True)


def _parts(had: int, has: int, length: int) -> Iterator[tuple[int, int]]:
    """Yield begin and end of the parts with entries `had` to `has` - 1, at most `length`."""
    begin = max(had, has - length)
    marks = {begin, has, *range(begin, has, CHUNK)}
    marks |= set(range(-(-begin // length) * length, has, length))
    for start, stop in pairwise(sorted(marks)):
        at = start % length
        yield at, at + stop - start
