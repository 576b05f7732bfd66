"""A copy of the rings on the learner's device, from which batches are drawn there.

A run is resumed from the rings on the host, not from the copy. `follow` copies new entries, one or
two slots per step. Sampling reads only the copy and never waits for the host, so that it can be
part of a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from merl.core import Batch
from merl.replay.ring import EpisodeRing
from merl.replay.sampling import Sampler

CHUNK = 4096
"""Maximum number of slots that are copied at once."""


def bytes_on_device(rings: Sequence[EpisodeRing]) -> int:
    """Return the bytes that the copy takes."""
    return sum(array.nbytes for ring in rings for array in ring.arrays().values())


class DeviceReplay:
    """Copy, on a device, of rings with the same spaces, one after the other.

    Args:
        rings: rings on the host, without compression.
        device: device of the copy.
    """

    def __init__(self, rings: Sequence[EpisodeRing], device: torch.device) -> None:
        first = rings[0]
        self._rings, self._device = rings, device
        self._keys, self._capacity = first.keys, first.capacity
        lengths = [ring.ring_index.length for ring in rings]
        self._first_slots = [sum(lengths[:index]) for index in range(len(rings))]
        self._bases = torch.tensor(self._first_slots, device=device)
        self._slots = torch.tensor(lengths, device=device)
        self._fields = {
            name: torch.empty(
                (sum(lengths), *array.shape[1:]),
                dtype=torch.from_numpy(array[:0]).dtype,
                device=device,
            )
            for name, array in first.arrays().items()
        }
        self._sources = torch.zeros(len(rings) * self._capacity, dtype=torch.int64, device=device)
        # For each ring: its first step that can be sampled, its steps so far, and its newest
        # timestep, numbered such that number 1 is in its first slot.
        self._counts = torch.zeros((len(rings), 3), dtype=torch.int64, device=device)
        self._host_counts = torch.zeros_like(self._counts, device="cpu")
        self._copied = [(0, 0)] * len(rings)  # timesteps and steps that were copied
        self._sampler = Sampler(self._fields, first.config)

    def follow(self) -> None:
        """Copy what was added to the rings since the last call."""
        counts = torch.tensor(
            [
                (*counts, timesteps - ring.ring_index.origin)
                for ring in self._rings
                for *counts, timesteps in [ring.counts()]
            ]
        )
        if torch.equal(counts, self._host_counts):
            return
        self._host_counts = counts
        for index, (ring, (_, steps, timesteps)) in enumerate(
            zip(self._rings, counts.tolist(), strict=True)
        ):
            had_timesteps, had_steps = self._copied[index]
            arrays = {name: torch.from_numpy(array) for name, array in ring.arrays().items()}
            for part in _parts(had_timesteps, timesteps, ring.ring_index.length):
                at = self._first_slots[index] + part.start
                for name, array in arrays.items():
                    self._copy(array[part], self._fields[name], at)
            for part in _parts(had_steps, steps, self._capacity):
                sources = torch.from_numpy(ring.sources[part] - ring.ring_index.origin)
                self._copy(sources, self._sources, index * self._capacity + part.start)
            self._copied[index] = (timesteps, steps)
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
        source = self._sources[ring * self._capacity + step % self._capacity]
        newest = self._counts[ring, 2]
        indices = self._sampler.pick(source, newest, self._bases[ring], self._slots[ring])
        now, then = (
            {key: self._sampler.observed(name, slots) for key, name in self._keys.items()}
            for slots in (indices.now, indices.then)
        )
        return Batch(now, self._sampler.action(indices), indices.reward, indices.discount, then)

    def _copy(self, part: Tensor, whole: Tensor, at: int) -> None:
        """Copy rows to the device; from pinned memory, so that the host does not wait."""
        if self._device.type == "cuda":
            part = part.pin_memory()
        whole[at : at + len(part)].copy_(part, non_blocking=True)


def _parts(had: int, has: int, length: int) -> Iterator[slice]:
    """Yield the ring's slices with entries `had` to `has` - 1, at most the last `length`."""
    begin = max(had, has - length)
    marks = {begin, has, *range(begin, has, CHUNK)}
    marks |= set(range(-(-begin // length) * length, has, length))
    for start, stop in pairwise(sorted(marks)):
        at = start % length
        yield slice(at, at + stop - start)
