"""Heads: the layers that C.1 counts, their norms, and two Qs that share nothing but the input."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from merl.networks.heads import Actor, HeadSize, TwinCritic, mlp


@pytest.mark.parametrize("layers", [1, 3, 6])
@pytest.mark.parametrize("layer_norm", [True, False])
def test_the_output_layer_is_counted(layers: int, layer_norm: bool) -> None:
    head = mlp(10, 4, HeadSize(layers, 16, layer_norm))
    kinds = [type(m) for m in head.modules()]
    linear = sum(isinstance(m, nn.Linear) for m in head.modules())
    assert linear == layers
    assert kinds.count(nn.LayerNorm) == (layers - 1 if layer_norm else 0)
    assert head(torch.randn(5, 10)).shape == (5, 4)


def test_the_actor_ranges_over_plus_and_minus_one() -> None:
    actions = Actor(10, 4, HeadSize(3, 32))(100 * torch.randn(500, 10))
    assert actions.abs().max() <= 1
    with torch.no_grad():
        (actor := Actor(10, 4, HeadSize(3, 32))).layers[-1].bias.fill_(3.0)
    assert (actor(torch.randn(500, 10)) > 0.9).all()


def test_the_twins_are_apart() -> None:
    critic = TwinCritic(10, 4, HeadSize(3, 32))
    latent, action = torch.randn(50, 10), torch.rand(50, 4)
    q1, q2 = critic(latent, action)
    assert q1.shape == q2.shape == (50,)
    assert not torch.equal(q1, q2)
    weights = list(critic.parameters())
    one, two = (torch.autograd.grad(q.sum(), weights, allow_unused=True) for q in (q1, q2))
    assert all((a is None) != (b is None) for a, b in zip(one, two, strict=True))
    (by_action,) = torch.autograd.grad(critic(latent, action.requires_grad_())[0].sum(), [action])
    assert by_action.any(dim=0).all()
