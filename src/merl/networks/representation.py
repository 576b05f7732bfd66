"""Encoders of an agent's observation, one per modality, shared by actor and critic."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor, nn

from merl.networks.augmentation import shift
from merl.networks.encoders import ConvEncoder, VectorEncoder
from merl.networks.names import module_name


class Encoders(nn.Module):
    """f_xi and g_zeta: an encoder per modality; updates shift the images first.

    Args:
        images: encoder of each image key.
        vectors: encoder of each vector key.
        pad: random shift, in pixels to each side; 0 disables it.

    Attributes:
        image_keys: keys of the images.
        vector_keys: keys of the vectors.
        features: the length of each modality's encoding, images first.
    """

    def __init__(
        self, images: Mapping[str, ConvEncoder], vectors: Mapping[str, VectorEncoder], pad: int
    ) -> None:
        super().__init__()
        self.image_keys, self.vector_keys = tuple(images), tuple(vectors)
        self.images = nn.ModuleDict({module_name(key): e for key, e in images.items()})
        self.vectors = nn.ModuleDict({module_name(key): e for key, e in vectors.items()})
        self.pad = pad
        self.features = {key: encoder.features for key, encoder in images.items()}
        self.features |= {key: encoder.features for key, encoder in vectors.items()}

    def observe(self, observation: Mapping[str, Tensor]) -> None:
        """Update the standardisation of the vector encoders that have one from a batch."""
        for key, encoder in zip(self.vector_keys, self.vectors.values(), strict=True):
            assert isinstance(encoder, VectorEncoder)
            encoder.observe(observation[key])

    def forward(
        self, observation: Mapping[str, Tensor], shifts: Mapping[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Encode each modality.

        Args:
            observation: images uint8 (B, K, H, W, C), vectors float (B, n); missing keys are not
                encoded.
            shifts: crop offset of each sample by image key, int64 (B, 2); None shifts no image.

        Returns:
            {key: (B, F_key)}, images first.
        """
        encoded: dict[str, Tensor] = {}
        for key, encoder in zip(self.image_keys, self.images.values(), strict=True):
            if key not in observation:
                continue
            stack = observation[key]
            moved = shift(stack, shifts[key], self.pad) if shifts else stack
            encoded[key] = encoder(moved)
        for key, encoder in zip(self.vector_keys, self.vectors.values(), strict=True):
            if key in observation:
                encoded[key] = encoder(observation[key])
        return encoded
