"""Multimodal fusion of the encodings into one latent of dimension d (MERL 4.1, C.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor, nn

from merl.networks.names import module_name

FusionLayer = Literal["tanh", "simnorm", "attention"]
GROUPS: dict[FusionLayer, int] = {"tanh": 1, "simnorm": 8, "attention": 4}
"""The part of each key must be a multiple of this: of the numbers that share one softmax in SimNorm
(TD-MPC2), and of the heads of attention."""


class Fusion(nn.Module):
    """h_psi: Linear, LayerNorm and tanh for each key, concatenated.

    Args:
        features: the length of each modality's encoding, by key, in the order of concatenation.
        share: length of each key's part of the latent, a multiple of `GROUPS[layer]`.
        layer_norm: whether to normalise (Figure 3c of the paper tests without).
        layer: "tanh", "simnorm" for a softmax over groups of eight, or "attention": each key is a
            token, which attends to all, with a residual connection and tanh.

    Attributes:
        latent_dim: d, the length of the latent.
        keys: the keys, in the order of concatenation.
    """

    def __init__(
        self,
        features: Mapping[str, int],
        share: int,
        layer_norm: bool = True,
        layer: FusionLayer = "tanh",
    ) -> None:
        super().__init__()
        self.layer = layer
        self.latent_dim = share * len(features)
        self.keys = tuple(features)
        self.projections = nn.ModuleDict(
            {module_name(key): nn.Linear(n, share) for key, n in features.items()}
        )
        self.norms = nn.ModuleDict(
            {
                module_name(key): nn.LayerNorm(share) if layer_norm else nn.Identity()
                for key in features
            }
        )
        self.attention: nn.MultiheadAttention | None = None
        if layer == "attention":
            self.attention = nn.MultiheadAttention(share, GROUPS[layer], batch_first=True)

    def forward(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Fuse encodings {key: (B, F_key)} to the latent (B, d), each entry in [-1, 1]."""
        latents = []
        layers = zip(self.keys, self.projections.values(), self.norms.values(), strict=True)
        for key, projection, norm in layers:
            projected = projection(encoded[key]).to(projection.weight.dtype)
            latents.append(norm(projected))
        if self.attention is not None:
            tokens = torch.stack(latents, dim=1)  # (B, M, d / M)
            attended, _ = self.attention(tokens, tokens, tokens, need_weights=False)
            latents = list((tokens + attended.to(tokens.dtype)).unbind(dim=1))
        return torch.cat([self._bounded(latent) for latent in latents], dim=-1)  # (B, d)

    def _bounded(self, latent: Tensor) -> Tensor:
        if self.layer != "simnorm":
            return torch.tanh(latent)
        groups = latent.reshape(len(latent), -1, GROUPS["simnorm"])
        return torch.softmax(groups, dim=-1).flatten(-2)


class Concatenation(nn.Module):
    """Concatenation of the encodings without fusion, for state-based agents.

    Args:
        features: the length of each modality's encoding, by key, in the order of concatenation.

    Attributes:
        latent_dim: the sum of the lengths.
        keys: the keys, in the order of concatenation.
    """

    def __init__(self, features: Mapping[str, int]) -> None:
        super().__init__()
        self.latent_dim = sum(features.values())
        self.keys = tuple(features)

    def forward(self, encoded: Mapping[str, Tensor]) -> Tensor:
        """Concatenate encodings {key: (B, F_key)} to (B, sum of F_key)."""
        return torch.cat([encoded[key] for key in self.keys], dim=-1)
