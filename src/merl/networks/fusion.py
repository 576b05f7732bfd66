"""Multimodal fusion of the encodings into one latent of dimension d (MERL 4.1, C.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn

from merl.networks.names import module_name

Squash = Literal["tanh", "simnorm"]
SIMNORM_GROUP = 8  # features that share one softmax, as in SimNorm (TD-MPC2)


class Fusion(nn.Module):
    """h_psi: Linear, LayerNorm and tanh for each modality, concatenated.

    Args:
        features: the length of each modality's encoding, by key, in the order of concatenation.
        share: length of each modality's part of the latent; with simnorm a multiple of eight.
        layer_norm: whether to normalise (Figure 3c of the paper tests without).
        squash: "tanh", or "simnorm" for a softmax over groups of eight.

    Attributes:
        latent_dim: d, the length of the latent.
        modalities: the keys, in the order of concatenation.
    """

    def __init__(
        self,
        features: Mapping[str, int],
        share: int,
        layer_norm: bool = True,
        squash: Squash = "tanh",
    ) -> None:
        super().__init__()
        self.squash = squash
        self.latent_dim = share * len(features)
        self.modalities = tuple(features)
        self.projections = nn.ModuleDict(
            {module_name(key): nn.Linear(n, share) for key, n in features.items()}
        )
        self.norms = nn.ModuleDict(
            {
                module_name(key): nn.LayerNorm(share) if layer_norm else nn.Identity()
                for key in features
            }
        )

    def forward(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Fuse encodings {key: (B, F_key)} to the latent (B, d), each entry in (-1, 1)."""
        latents = []
        layers = zip(self.modalities, self.projections.values(), self.norms.values(), strict=True)
        for key, projection, norm in layers:
            projected = projection(encoded[key]).to(projection.weight.dtype)
            latents.append(self._squash(norm(projected)))
        return torch.cat(latents, dim=-1)  # (B, d)

    def _squash(self, latent: Tensor) -> Tensor:
        if self.squash == "tanh":
            return torch.tanh(latent)
        groups = latent.reshape(len(latent), -1, SIMNORM_GROUP)
        return torch.softmax(groups, dim=-1).flatten(-2)


class Concatenation(nn.Module):
    """Concatenation of the encodings without fusion, for state-based agents.

    Args:
        features: the length of each modality's encoding, by key, in the order of concatenation.

    Attributes:
        latent_dim: the sum of the lengths.
        modalities: the keys, in the order of concatenation.
    """

    def __init__(self, features: Mapping[str, int]) -> None:
        super().__init__()
        self.latent_dim = sum(features.values())
        self.modalities = tuple(features)

    def forward(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Concatenate encodings {key: (B, F_key)} to (B, sum of F_key)."""
        return torch.cat([encoded[key] for key in self.modalities], dim=-1)
