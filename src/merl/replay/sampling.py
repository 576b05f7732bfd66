"""What a sampled step is made of: its stack, its n-step return, and what it led to.

The same arithmetic on the arrays of the ring, wherever they lie: in memory, on the disk, or on a
GPU, where nothing of it asks the card for an answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from merl.replay.config import ReplayConfig


@dataclass(frozen=True)
class SampleIndices:
    """Where B sampled steps lie in the ring, and what they paid.

    Attributes:
        now: slots of o_t's frames, oldest first, int64 (B, K).
        then: slots of o_{t+m}'s, likewise.
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
    """Finds what belongs to a step, in one ring or in several that lie behind one another.

    Args:
        fields: the arrays by name, of several rings one behind the other; see `storage.fields_of`.
        config: stack, n and discount.
    """

    def __init__(self, fields: Mapping[str, Tensor], config: ReplayConfig) -> None:
        self._fields = fields
        device = fields["position"].device
        self._ahead = torch.arange(config.n_step, device=device)
        self._back = torch.arange(config.frame_stack - 1, -1, -1, device=device)
        powers = [config.discount**power for power in range(config.n_step + 1)]
        self._powers = torch.tensor(powers, dtype=torch.float64, device=device)

    def pick(self, source: Tensor, newest: Tensor, base: Tensor, slots: Tensor) -> SampleIndices:
        """Lay out the samples that start at timesteps `source`.

        Args:
            source: numbers of timesteps, int64 (B,), where number 1 lies in the first slot.
            newest: the newest timestep of their ring, int64 (B,) or (1,).
            base: the first slot of their ring, likewise.
            slots: of their ring, likewise.
        """
        fields, newest, timesteps = self._fields, newest[:, None], source[:, None]
        base, length = base[:, None], slots[:, None]

        def slot(timestep: Tensor) -> Tensor:
            return (timestep - 1) % length + base

        begun = timesteps - fields["position"][slot(timesteps)]  # the episode's first
        ahead = timesteps + 1 + self._ahead  # (B, n): what r_t, r_{t+1}, ... led to
        led_to = slot(ahead)
        same = ((ahead <= newest) & (fields["position"][led_to] > 0)).long().cumprod(dim=1)
        steps = same.sum(dim=1)  # (B,): m
        end = timesteps + steps[:, None]
        # Slots beyond the newest timestep may never have been written: no number times 0 is none.
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
        """What was seen at slots (B, K): (B, K, H, W, C); of vectors the newest, (B, n)."""
        field = self._fields[name]
        if field.dtype != torch.uint8:
            return field.index_select(0, slots[:, -1])
        if field.device.type == "cpu":  # where NumPy takes half the time (docs/bench.md)
            return torch.from_numpy(field.numpy().take(slots.numpy(), axis=0))
        return field.index_select(0, slots.flatten()).view(*slots.shape, *field.shape[1:])

    def action(self, indices: SampleIndices) -> Tensor:
        """a_t, float32 (B, A)."""
        return self._fields["action"].index_select(0, indices.action)
