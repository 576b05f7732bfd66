"""Orthogonal weights and zero biases (C.1) in MERL's networks."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents.merl import MERLConfig
from merl.agents.networks import make_networks
from merl.networks.initialization import orthogonal


def is_orthogonal(weight: Tensor, gain: float) -> bool:
    """Return whether W W^T = gain^2 I, or W^T W if there are more rows than columns."""
    matrix = weight.detach().double().flatten(1)
    rows, columns = matrix.shape
    gram = matrix @ matrix.T if rows <= columns else matrix.T @ matrix
    return torch.allclose(gram, gain**2 * torch.eye(min(rows, columns)).double(), atol=1e-5)


@pytest.fixture
def networks() -> nn.Module:
    space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (24, 28, 3), np.uint8),
            "proprio": spaces.Box(-1, 1, (7,), np.float32),
        }
    )
    config = MERLConfig(
        latent_dim=64, hidden_dim=48, mlp_dim=20, encoders={"proprio": "mlp"}, head_layers=4
    )
    torch.manual_seed(0)
    return make_networks(config, space, 6, 3)


def test_every_layer_of_merl_is_initialised(networks: nn.Module) -> None:
    kinds = {nn.Linear: 0, nn.Conv2d: 0, nn.LayerNorm: 0}
    for layer in networks.modules():
        kind = next((kind for kind in kinds if isinstance(layer, kind)), None)
        if kind is None:
            continue
        kinds[kind] += 1
        if isinstance(layer, nn.LayerNorm):
            assert torch.equal(layer.weight, torch.ones_like(layer.weight))
        else:
            assert is_orthogonal(layer.weight, math.sqrt(2) if isinstance(layer, nn.Conv2d) else 1)
        assert not layer.bias.any()
    # Two of the MLP encoder, two fusions of two modalities, three heads of four layers.
    assert kinds == {nn.Linear: 2 + 4 + 12, nn.Conv2d: 4, nn.LayerNorm: 4 + 9}


def test_no_two_layers_are_equal(networks: nn.Module) -> None:
    weights = [p for p in networks.parameters() if p.ndim > 1]
    for i, a in enumerate(weights):
        assert not any(torch.equal(a, b) for b in weights[:i] if a.shape == b.shape)


def test_convolutions_stay_channels_last() -> None:
    convolution = nn.Conv2d(6, 8, 3).to(memory_format=torch.channels_last)
    orthogonal(convolution)
    assert convolution.weight.is_contiguous(memory_format=torch.channels_last)
    assert is_orthogonal(convolution.weight, math.sqrt(2))


def test_memory_order_does_not_change_the_weights() -> None:
    weights = []
    for order in (torch.contiguous_format, torch.channels_last):
        convolution = nn.Conv2d(6, 8, 3).to(memory_format=order)
        torch.manual_seed(0)
        orthogonal(convolution)
        weights.append(convolution.weight)
    assert torch.equal(*weights)
