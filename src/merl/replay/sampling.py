"""Sampling of steps: frame stack, n-step return and next observation.

The same arithmetic works on the arrays of the ring in memory, on disk and on a GPU, where it never
waits for a result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from merl.replay.spec import ReplaySpec, field_name


@dataclass(frozen=True)
class SampleIndices:
    """Slots of B sampled steps in the ring, with their returns.

    Attributes:
        now: slots of the frames of o_t, oldest first, int64 (B, K).
        then: slots of the frames of o_{t+m}, oldest first, int64 (B, K).
        action: slot of the timestep that a_t led to, int64 (B,).
        reward: sum of gamma^i r_{t+i} for i < m, float32 (B,).
        discount: gamma^m, or 0 at a true end, float32 (B,).
    """

    now: Tensor
    then: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor


class Sampler:
    """Computation of samples from rings that are stored one after the other.

    Args:
        fields: the arrays by name; see `ReplaySpec.fields`.
        spec: what the replay stores, and how it is sampled.
        slots: number of slots of each ring.
    """

    def __init__(self, fields: Mapping[str, Tensor], spec: ReplaySpec, slots: int) -> None:
        self._fields, self._spec, self._slots = fields, spec, slots
        config = spec.config
        device = fields["position"].device
        self._ahead = torch.arange(config.n_step, device=device)
        self._back = torch.arange(config.frame_stack - 1, -1, -1, device=device)
        powers = [config.discount**power for power in range(config.n_step + 1)]
        self._powers = torch.tensor(powers, dtype=torch.float64, device=device)

    def pick(self, ring: Tensor, source: Tensor, newest: Tensor) -> SampleIndices:
        """Return slots and returns of the samples that start at timesteps `source`.

        Args:
            ring: number of each sample's ring, int64 (B,).
            source: numbers of timesteps, int64 (B,); number 1 is in the first slot of its ring.
            newest: newest timestep of each sample's ring, int64 (B,).
        """
        fields, newest, timesteps = self._fields, newest[:, None], source[:, None]
        base = ring[:, None] * self._slots

        def slot(timestep: Tensor) -> Tensor:
            return (timestep - 1) % self._slots + base

        start = timesteps - fields["position"][slot(timesteps)]  # first timestep of the episode
        ahead = timesteps + 1 + self._ahead  # (B, n): timesteps of r_t, r_{t+1}, ...
        led_to = slot(ahead)
        same = ((ahead <= newest) & (fields["position"][led_to] > 0)).long().cumprod(dim=1)
        steps = same.sum(dim=1)  # (B,): m
        end = timesteps + steps[:, None]
        # Slots beyond the newest timestep may hold NaN, and NaN times 0 is NaN.
        paid = torch.where(same.bool(), fields["reward"][led_to], 0.0)
        rewards = paid * self._powers[:-1]  # float64
        last = fields["discount"][slot(end)[:, 0]]
        return SampleIndices(
            now=slot(torch.maximum(timesteps - self._back, start)),
            then=slot(torch.maximum(end - self._back, start)),
            action=led_to[:, 0],
            reward=rewards.sum(dim=1).float(),
            discount=(self._powers[steps] * last).float(),
        )

    def observed(self, key: str, slots: Tensor) -> Tensor:
        """Return the frames of a stacked key at slots (B, K), or the newest values, (B, *shape).

        Rows are copied as bytes: torch cannot index all types, for example uint16.
        """
        field, spec = self._fields[field_name(key)], self._spec.keys[key]
        if not spec.stacked:
            slots = slots[:, -1]
        if field.device.type == "cpu":  # there, NumPy takes half the time
            return torch.from_numpy(field.numpy().take(slots.numpy(), axis=0))
        rows = field.view(len(field), -1).view(torch.uint8).index_select(0, slots.flatten())
        return rows.view(field.dtype).view(*slots.shape, *spec.shape)

    def action(self, indices: SampleIndices) -> Tensor:
        """Return a_t, float32 (B, A)."""
        return self._fields["action"].index_select(0, indices.action)
