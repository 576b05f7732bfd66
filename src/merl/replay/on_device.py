"""A copy of the rings on the device that learns, from which batches are drawn there.

The rings on the host stay what a run goes on from. What they take in is brought over when it is
asked for, a slot or two a step; sampling reads the copy alone, and asks nothing of the host, so
that it can be part of a CUDA graph.
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
"""Slots that are brought over at once, at most."""


def bytes_on_device(rings: Sequence[EpisodeRing]) -> int:
    """What the copy takes."""
    return sum(array.nbytes for ring in rings for array in ring.arrays().values())


class OnDevice:
    """Rings of the same environment, one behind the other, on a device.

    Args:
        rings: on the host; without compression.
        device: where the copy lies.
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
        # timestep, counted from the one in its first slot.
        self._counts = torch.zeros((len(rings), 3), dtype=torch.int64, device=device)
        self._told = torch.zeros_like(self._counts, device="cpu")
        self._there = [(0, 0)] * len(rings)  # timesteps and steps that were brought over
        self._sampler = Sampler(self._fields, first.config)

    def follow(self) -> None:
        """Bring over what the rings have taken in since the last time."""
        counts = torch.tensor(
            [
                (*counts, timesteps - ring.ring_index.origin)
                for ring in self._rings
                for *counts, timesteps in [ring.counts()]
            ]
        )
        if torch.equal(counts, self._told):
            return
        self._told = counts
        for index, (ring, (_, steps, timesteps)) in enumerate(
            zip(self._rings, counts.tolist(), strict=True)
        ):
            had_timesteps, had_steps = self._there[index]
            arrays = {name: torch.from_numpy(array) for name, array in ring.arrays().items()}
            for part in _parts(had_timesteps, timesteps, ring.ring_index.length):
                at = self._first_slots[index] + part.start
                for name, array in arrays.items():
                    self._bring(array[part], self._fields[name], at)
            for part in _parts(had_steps, steps, self._capacity):
                sources = torch.from_numpy(ring.sources[part] - ring.ring_index.origin)
                self._bring(sources, self._sources, index * self._capacity + part.start)
            self._there[index] = (timesteps, steps)
        self._bring(counts, self._counts, 0)

    def sample(self, batch_size: int, generator: torch.Generator) -> Batch:
        """Draw steps uniformly, with replacement, from what `follow` brought over.

        Args:
            batch_size: how many; at least one step must be held.
            generator: on the device.

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
        """The samples that start at these steps of these rings, each int64 (B,)."""
        source = self._sources[ring * self._capacity + step % self._capacity]
        newest = self._counts[ring, 2]
        indices = self._sampler.pick(source, newest, self._bases[ring], self._slots[ring])
        now, then = (
            {key: self._sampler.observed(name, slots) for key, name in self._keys.items()}
            for slots in (indices.now, indices.then)
        )
        return Batch(now, self._sampler.action(indices), indices.reward, indices.discount, then)

    def _bring(self, part: Tensor, whole: Tensor, at: int) -> None:
        """Copy rows over. From pinned memory the host does not wait for the card."""
        if self._device.type == "cuda":
            part = part.pin_memory()
        whole[at : at + len(part)].copy_(part, non_blocking=True)


def _parts(had: int, has: int, length: int) -> Iterator[slice]:
    """Where in a ring the entries number `had` to `has` - 1 lie, in pieces; the last `length`."""
    begin = max(had, has - length)
    marks = {begin, has, *range(begin, has, CHUNK)}
    marks |= set(range(-(-begin // length) * length, has, length))
    for start, stop in pairwise(sorted(marks)):
        at = start % length
        yield slice(at, at + stop - start)
