"""Agent ibrl: the better of the actor's action and a cloned policy's."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces

from merl.agents import make_agent
from merl.agents.ibrl import IBRL, IBRLConfig, better
from merl.core import Batch, MerlError

SPACE = spaces.Dict(
    {
        "image": spaces.Box(0, 255, (32, 32, 3), np.uint8),
        "proprio": spaces.Box(-np.inf, np.inf, (5,), np.float32),
    }
)
CONFIG = IBRLConfig(
    start_from=Path("cloned"),
    frozen_encoders=("image", "proprio"),
    hidden_dim=32,
    latent_dim=16,
    conv_channels=4,
)
SIZE = 64


def make(config: IBRLConfig = CONFIG) -> IBRL:
    actions = spaces.Box(-1.0, 1.0, (3,), np.float32)
    cpu = torch.device("cpu")
    agent = make_agent("ibrl", config, SPACE, actions, frame_stack=2, seed=1, device=cpu)
    assert isinstance(agent, IBRL)
    return agent


@pytest.fixture(params=[2, 4], ids=lambda count: f"{count}-critics")
def agent(request: pytest.FixtureRequest) -> IBRL:
    """Return an agent whose actor and critics have moved since it began with the clone."""
    agent = make(replace(CONFIG, critics=request.param))
    torch.manual_seed(2)
    parts = agent.networks.actor, agent.networks.critic, agent.critic_target
    for weight in (weight for part in parts for weight in part.parameters()):
        weight.data += 0.3 * torch.randn_like(weight)
    return agent


def observations(seed: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (SIZE, 2, 32, 32, 3)
    return {
        "image": torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator),
        "proprio": torch.randn((SIZE, 5), generator=generator),
    }


def values(
    agent: IBRL, critic: Callable[..., tuple[torch.Tensor, ...]], pair: torch.Tensor | None
) -> Callable[..., torch.Tensor]:
    """Return the rule of two heads or of this pair; without a pair, of the mean of four."""

    def value(encoded: dict[str, torch.Tensor], action: torch.Tensor) -> torch.Tensor:
        each = torch.stack(critic(agent.networks.critic_fusion(encoded), action))
        if len(each) == 2:
            return each.amin(dim=0)
        return each.mean(dim=0) if pair is None else torch.minimum(each[pair[0]], each[pair[1]])

    return value


@torch.no_grad()
def test_acting_takes_the_action_of_the_higher_value(agent: IBRL) -> None:
    observation, networks = observations(3), agent.networks
    encoded = networks.encoders(observation)
    imitator = networks.imitator
    assert imitator is not None
    own = networks.actor(networks.actor_latent(encoded))
    cloned = imitator["actor"](imitator["fusion"](encoded))
    value = values(agent, networks.critic.values, None)
    is_cloned = value(encoded, cloned) > value(encoded, own)
    assert 4 < int(is_cloned.sum()) < SIZE - 4
    action = agent.act(observation, explore=False, step=0)
    for row in range(SIZE):
        torch.testing.assert_close(action[row], (cloned if is_cloned[row] else own)[row])
    explored = agent.act(observation, explore=True, step=0)
    noisy = [row for row in range(SIZE) if not torch.equal(explored[row], cloned[row])]
    assert noisy
    assert len(noisy) < SIZE
    assert not any(torch.equal(explored[row], own[row]) for row in noisy)


@torch.no_grad()
def test_the_critic_learns_the_value_of_the_better_action(agent: IBRL) -> None:
    generator = torch.Generator().manual_seed(4)
    reward, discount = torch.rand(SIZE, generator=generator), torch.full((SIZE,), 0.97)
    action = torch.rand((SIZE, 3), generator=generator) * 2 - 1
    batch = Batch(observations(5), action, reward, discount, observations(6))
    noise = agent.draw(SIZE, agent.plan(0))
    before = copy.deepcopy(agent)
    with torch.enable_grad():
        metrics = agent.update(batch, copy.deepcopy(noise), step=0)
    networks, imitator = before.networks, before.networks.imitator
    assert imitator is not None
    encoded = networks.encoders(batch.next_observation, noise.next_shifts)
    own = networks.actor(networks.actor_latent(encoded)) + noise.next_noise
    cloned = imitator["actor"](imitator["fusion"](encoded))
    value = values(before, before.critic_target["critic"].values, noise.pair)  # type: ignore[arg-type]
    best = torch.maximum(value(encoded, own.clamp(-1, 1)), value(encoded, cloned))
    assert metrics["target_q"].item() == pytest.approx((reward + 0.97 * best).mean().item(), 1e-5)
    # Neither the cloned policy nor the encoders move, but the actor and the critic do.
    after = agent.networks.state_dict()
    moved = {k.split(".")[0] for k, v in networks.state_dict().items() if not v.equal(after[k])}
    assert moved == {"actor", "actor_fusion", "critic", "critic_fusion"}


def test_the_own_action_is_taken_if_both_are_equal() -> None:
    own, cloned = torch.zeros(3, 1), torch.ones(3, 1)
    taken = better(own, cloned, torch.tensor([1.0, 0.0, 0.5]), torch.tensor([0.0, 1.0, 0.5]))
    assert taken.flatten().tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"start_from": None}, "clone with --demos DIR --demos-pretrain UPDATES, or name"),
        ({"frozen_encoders": ()}, "clone with --demos DIR --demos-pretrain UPDATES, or name"),
        ({"privileged": ("proprio",)}, r"must not need agent.privileged \('proprio',\): remove"),
    ],
)
def test_what_the_choice_cannot_work_with_is_refused(
    values: dict[str, object], message: str
) -> None:
    with pytest.raises(MerlError, match=message) as error:
        make(replace(CONFIG, **values))  # type: ignore[arg-type]
    assert len(str(error.value).splitlines()) == 1
