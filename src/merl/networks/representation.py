"""Encoders of an agent's observation, one per key, shared by actor and critic."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from merl.modalities import Modality
from merl.networks.augmentation import shift
from merl.networks.encoders.vectors import Standardize
from merl.networks.names import module_name


class Encoders(nn.Module):
    """f_xi and g_zeta: an encoder per key; updates shift the frames of cameras first.

    Args:
        encoders: the encoder of each key.
        modalities: the modality of each key, in the order of the encodings.
        pad: random shift, in pixels to each side; 0 disables it.
        standardize: standardise vectors and histories first.

    Attributes:
        modalities: the modality of each key.
        features: the length of each key's encoding.
        shifted: keys whose frames are shifted.
    """

    def __init__(
        self,
        encoders: Mapping[str, nn.Module],
        modalities: Mapping[str, Modality],
        pad: int,
        standardize: bool,
    ) -> None:
        super().__init__()
        self.modalities, self.pad = dict(modalities), pad
        lengths: dict[str, Any] = {key: encoders[key].features for key in modalities}
        self.features: dict[str, int] = lengths
        self.shifted = tuple(key for key, m in modalities.items() if m.stacked and pad)
        self._names = {key: module_name(key) for key in modalities}
        self.by_key = nn.ModuleDict({self._names[key]: encoders[key] for key in modalities})
        scaled = [
            key for key, modality in modalities.items() if standardize and not modality.stacked
        ]
        self.scales = nn.ModuleDict(
            {self._names[key]: Standardize(modalities[key].shape[-1]) for key in scaled}
        )

    def observe(self, observation: Mapping[str, Tensor]) -> None:
        """Update the standardisation, and encoders with a method `observe`, from a batch."""
        for key, modality in self.modalities.items():
            name = self._names[key]
            for part in (self.scales, self.by_key):
                observe = getattr(part[name], "observe", None) if name in part else None
                if callable(observe):
                    observe(modality.to_input(observation[key]))

    def forward(
        self, observation: Mapping[str, Tensor], shifts: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Encode each key.

        Args:
            observation: stored observations, (B, *shape) or, of stacked frames, (B, K, *shape);
                missing keys are not encoded.
            shifts: crop offset of each sample by key, int64 (B, 2); None shifts no frames.

        Returns:
            {key: (B, F_key)}.
        """
        encoded: dict[str, Tensor] = {}
        for key, modality in self.modalities.items():
            if key not in observation:
                continue
            name, value = self._names[key], observation[key]
            if shifts and key in shifts:
                value = shift(value, shifts[key], self.pad)
            encoder = self.by_key[name]
            if not hasattr(encoder, "takes_stored"):
                value = modality.to_input(value)
            if name in self.scales:
                value = self.scales[name](value)
            encoded[key] = encoder(value)
        return encoded
