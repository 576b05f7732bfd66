"""Sampling of steps: frame stack, n-step return and next observation.

The same arithmetic works on the arrays of the ring in memory, on disk and on a GPU, where it never
waits for a result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from merl.replay.config import ReplayConfig


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
    """Computation of samples, from one ring or from several rings one after the other.

    Args:
        fields: the arrays by name, with all rings one after the other; see `storage.fields_of`.
        config: frame stack, n and discount.
    """

    def __init__(self, fields: Mapping[str, Tensor], config: ReplayConfig) -> None:
        self._fields = fields
        device = fields["position"].device
        self._ahead = torch.arange(config.n_step, device=device)
        self._back = torch.arange(config.frame_stack - 1, -1, -1, device=device)
        powers = [config.discount**power for power in range(config.n_step + 1)]
        self._powers = torch.tensor(powers, dtype=torch.float64, device=device)

    def pick(self, source: Tensor, newest: Tensor, base: Tensor, slots: Tensor) -> SampleIndices:
        """Return slots and returns of the samples that start at timesteps `source`.

        Args:
            source: numbers of timesteps, int64 (B,); number 1 is in the first slot of its ring.
            newest: newest timestep of each sample's ring, int64 (B,) or (1,).
            base: first slot of each sample's ring, int64 (B,) or (1,).
            slots: number of slots of each sample's ring, int64 (B,) or (1,).
        """
        fields, newest, timesteps = self._fields, newest[:, None], source[:, None]
        base, length = base[:, None], slots[:, None]

        def slot(timestep: Tensor) -> Tensor:
            return (timestep - 1) % length + base

        begun = timesteps - fields["position"][slot(timesteps)]  # first timestep of the episode
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
            now=slot(torch.maximum(timesteps - self._back, begun)),
            then=slot(torch.maximum(end - self._back, begun)),
            action=led_to[:, 0],
            reward=rewards.sum(dim=1).float(),
            discount=(self._powers[steps] * last).float(),
        )

    def observed(self, name: str, slots: Tensor) -> Tensor:
        """Return the images at slots (B, K), (B, K, H, W, C), or the newest vectors, (B, n)."""
        field = self._fields[name]
        if field.dtype != torch.uint8:
            return field.index_select(0, slots[:, -1])
        if field.device.type == "cpu":  # there, NumPy takes half the time
            return torch.from_numpy(field.numpy().take(slots.numpy(), axis=0))
        return field.index_select(0, slots.flatten()).view(*slots.shape, *field.shape[1:])

    def action(self, indices: SampleIndices) -> Tensor:
        """Return a_t, float32 (B, A)."""
        return self._fields["action"].index_select(0, indices.action)
