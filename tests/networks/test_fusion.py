"""Fusion: range of the latent, and each modality's part of it."""

from __future__ import annotations

import pytest
import torch

from merl.networks.fusion import Fusion

FEATURES = {"image": 50, "proprio": 7}


def encoded(features: dict[str, int], scale: float = 1.0, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {k: scale * torch.randn(64, n, generator=generator) for k, n in features.items()}


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_tanh_latent_covers_minus_one_to_one(scale: float) -> None:
    latent = Fusion(FEATURES, 16)(encoded(FEATURES, scale))
    assert latent.shape == (64, 32)
    assert latent.abs().max() < 1
    assert latent.min() < -0.5
    assert latent.max() > 0.5


def test_layer_norm_removes_the_scale_of_a_modality() -> None:
    fusion, inputs = Fusion(FEATURES, 16), encoded(FEATURES)
    scaled = inputs | {"image": 1000 * inputs["image"]}
    with torch.no_grad():
        fusion.projections["image"].bias.zero_()
    torch.testing.assert_close(fusion(scaled), fusion(inputs), rtol=0, atol=1e-3)
    bare = Fusion(FEATURES, 16, layer_norm=False)
    assert (bare(scaled) - bare(inputs)).abs().max() > 0.1


def test_each_modality_changes_only_its_part() -> None:
    features = {"image": 50, "proprio": 7, "touch": 3}
    fusion, inputs = Fusion(features, 16), encoded(features)
    before = fusion(inputs)
    for i, key in enumerate(features):
        changed = fusion(inputs | {key: inputs[key].flip(0)}) != before
        share = slice(16 * i, 16 * (i + 1))
        assert changed[:, share].float().mean() > 0.9
        assert changed.float().mean() < 0.34


def test_simnorm_groups_sum_to_one() -> None:
    latent = Fusion(FEATURES, 16, layer="simnorm")(encoded(FEATURES))
    assert latent.min() > 0
    torch.testing.assert_close(latent.unflatten(-1, (4, 8)).sum(-1), torch.ones(64, 4))
