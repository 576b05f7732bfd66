"""Heads: number of layers as in C.1, their norms, and two Qs that share only the input."""

from __future__ import annotations

from itertools import combinations

import pytest
import torch
from torch import nn

from merl.networks.critic import Critic
from merl.networks.heads import MLP, Actor, HeadSize, Norm


@pytest.mark.parametrize("layers", [1, 3, 6])
@pytest.mark.parametrize("norm", ["layer", "none"])
def test_layers_include_the_output_layer(layers: int, norm: Norm) -> None:
    head = MLP(10, 4, HeadSize(layers, 16, norm))
    kinds = [type(m) for m in head.modules()]
    linear = sum(isinstance(m, nn.Linear) for m in head.modules())
    assert linear == layers
    assert kinds.count(nn.LayerNorm) == (layers - 1 if norm == "layer" else 0)
    assert head(torch.randn(5, 10)).shape == (5, 4)


def test_actions_are_in_minus_one_to_one() -> None:
    actions = Actor(10, 4, HeadSize(3, 32))(100 * torch.randn(500, 10))
    assert actions.abs().max() <= 1
    with torch.no_grad():
        (actor := Actor(10, 4, HeadSize(3, 32))).layers[-1].bias.fill_(3.0)
    assert (actor(torch.randn(500, 10)) > 0.9).all()


def test_the_pair_of_a_target_is_drawn_from_all_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    assert Critic(10, 4, HeadSize(3, 8)).draw_pair(generator) is None
    critic = Critic(10, 4, HeadSize(3, 8), count=5)
    pairs = [tuple(sorted(critic.draw_pair(generator).tolist())) for _ in range(1000)]
    counts = [pairs.count(pair) for pair in combinations(range(5), 2)]
    assert sum(counts) == 1000
    assert min(counts) > 60  # each is drawn in a tenth: 100, with a deviation of 9.5


def test_twin_heads_share_no_weights() -> None:
    critic = Critic(10, 4, HeadSize(3, 32))
    latent, action = torch.randn(50, 10), torch.rand(50, 4)
    q1, q2 = critic(latent, action)
    assert q1.shape == q2.shape == (50,)
    assert not torch.equal(q1, q2)
    weights = list(critic.parameters())
    one, two = (torch.autograd.grad(q.sum(), weights, allow_unused=True) for q in (q1, q2))
    assert all((a is None) != (b is None) for a, b in zip(one, two, strict=True))
    (by_action,) = torch.autograd.grad(critic(latent, action.requires_grad_())[0].sum(), [action])
    assert by_action.any(dim=0).all()
