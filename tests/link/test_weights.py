"""An actor acts as the learner would, with a part of its weights."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from merl.agents import AGENTS, make_agent
from merl.core import MerlError
from merl.link import weights
from toy import DotEnv

SMALL: dict[str, Any] = {"latent_dim": 8, "hidden_dim": 16, "mlp_dim": 8}


def agent(name: str, seed: int, **changes: Any) -> Any:
    config = dataclasses.replace(AGENTS[name].config, keys=None, **SMALL | changes)
    env = DotEnv()
    spaces = env.observation_space, env.action_space
    device = torch.device("cpu")
    return make_agent(name, config, *spaces, frame_stack=3, seed=seed, device=device)


def observation() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    image = torch.randint(0, 256, (1, 3, 16, 16, 3), generator=generator, dtype=torch.uint8)
    return {"image": image, "joint": torch.randn(1, 2, generator=generator)}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("merl", {}),
        ("merl", {"fusion": "decoupled", "actor_average": 0.1}),
        ("drqv2", {}),
        ("sac", {"modalities": ("image", "vector")}),
    ],
)
def test_an_actor_acts_as_the_learner(name: str, changes: dict[str, Any]) -> None:
    learner, actor = agent(name, 0, **changes), agent(name, 1, **changes)
    form, data = weights.pack(learner)
    own = {k: v.clone() for k, v in actor.networks.critic.state_dict().items()}
    weights.load(actor, form, bytearray(data))
    seen = {key: observation()[key] for key in learner.senses}
    for each in (learner, actor):
        each.acting.manual_seed(5)
        each.acting_noise = None
    actions = [each.act(seen, explore=True, step=7) for each in (learner, actor)]
    assert torch.equal(*actions)
    assert all(torch.equal(own[k], v) for k, v in actor.networks.critic.state_dict().items())
    assert len(data) < sum(4 * p.numel() for p in learner.networks.parameters())


def test_an_actor_that_chooses_by_the_critic_has_the_critic() -> None:
    changes = {"start_from": Path("cloned"), "frozen_encoders": ("image", "joint")}
    learner, actor = agent("ibrl", 0, **changes), agent("ibrl", 1, **changes)
    form, data = weights.pack(learner)
    weights.load(actor, form, bytearray(data))
    theirs = actor.networks.state_dict()
    assert all(v.equal(theirs[k]) for k, v in learner.networks.state_dict().items())


def test_weights_of_other_networks_are_refused() -> None:
    form, data = weights.pack(agent("merl", 0))
    with pytest.raises(MerlError, match="other networks: restart the actor"):
        weights.load(agent("merl", 0, hidden_dim=17), form, bytearray(data))
