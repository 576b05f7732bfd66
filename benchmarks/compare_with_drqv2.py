"""Compare merl's update of DrQ-v2 with its authors'; PATH is a clone of facebookresearch/drqv2.

    python benchmarks/compare_with_drqv2.py PATH              # compare losses and weights
    python benchmarks/compare_with_drqv2.py PATH --repeats 9  # compare the speed

For losses and weights, both updates start with the same weights and get the same batches, crops and
noise, in float64. For the speed, the authors' update in full size and single precision takes turns
with merl's, in single precision and in bf16.
"""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import tyro
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "agents"))
from bridge import Case, double, draws_of, error, weather
from reference import Chance

from merl.agents.ddpg import DDPG
from merl.agents.drqv2 import DrQV2Config
from merl.bench.measuring import Work, circumstances, shown, spread, take_turns
from merl.bench.update import ACTIONS, learner_of, noise_batch
from merl.core import Batch

ACTION = 200_000  # index of an action; the noise falls over 500,000 actions
CONFIG = replace(DrQV2Config(), hidden_dim=64, precision="fp32", noise_steps=1_000_000)
CASE = Case("drqv2", CONFIG, {"image": (84, 84, 3)}, {}, batch=6, step=2 * ACTION)
SIDE, CHANNELS = 35, 32  # size of the encoder's last feature map


def main(path: tyro.conf.Positional[Path], repeats: int = 0) -> None:
    """Compare four updates; with `repeats`, compare the speed instead."""
    if repeats:
        time(path, repeats)
    else:
        compare(path)


def time(path: Path, repeats: int) -> None:
    """Time the authors' update in turns with merl's; print the speeds."""
    theirs, _ = authors_agent(path, hidden_dim=1024, actions=ACTIONS)
    batch, cpu = noise_batch(256), torch.device("cpu")
    image, next_image = (
        frames(seen["image"]).contiguous() for seen in (batch.observation, batch.next_observation)
    )
    given = image, batch.action, batch.reward[:, None], batch.discount[:, None], next_image
    sides: dict[str, Work] = {
        "its authors'": lambda: theirs.update(iter([given]), ACTION),
        "merl, fp32": partial(learner_of("drqv2", "fp32", cpu).update, batch),
        "merl, bf16": partial(learner_of("drqv2", "bf16", cpu).update, batch),
    }
    turns = take_turns(sides, repeats, others=["its authors'"])
    for side, seconds in turns.items():
        ratio = [a / b for a, b in zip(turns["its authors'"], seconds, strict=True)]
        speed = shown(spread([1 / one for one in seconds]))
        print(f"{side}: {speed} updates/s, {shown(spread(ratio))} times the authors'")
    print(circumstances()["machine"])


def compare(path: Path) -> None:
    """Make four updates with both agents; print losses and the distance of the weights."""
    theirs, utils = authors_agent(path, CONFIG.hidden_dim, actions=6)
    for part in (theirs.encoder, theirs.actor, theirs.critic, theirs.critic_target):
        part.double()
    ours = double(CASE.agent())
    weather(ours)
    with torch.no_grad():
        for _, mine, other in weights(ours, theirs):
            other.copy_(theirs_from(mine))
    for update in range(4):
        batch, chance = CASE.batch_of(update, torch.float64), CASE.chance_of(update)
        noise = draws_of(chance, CONFIG, torch.float64, CASE.step)
        found = ours.update(batch, noise, step=CASE.step)
        losses = authors_update(theirs, utils, batch, chance)
        for name in ("critic_loss", "actor_loss"):
            print(f"update {update + 1}, {name}: {float(found[name]):.9f} and {losses[name]:.9f}")
    worst: dict[str, float] = {}
    for part, mine, other in weights(ours, theirs):
        apart = error(theirs_from(mine).detach(), other.detach())
        worst[part] = max(worst.get(part, 0.0), apart)
    for part, apart in worst.items():
        print(f"weights of {part}: relative distance {apart:.1e}")


def authors_update(theirs: Any, utils: Any, batch: Batch, chance: Chance) -> dict[str, float]:
    """Make the authors' update with the given random numbers; return the losses."""
    crops = map(crop, (chance.shift["image"], chance.shift_next["image"]))
    noises = iter((chance.noise_next, chance.noise))
    given = (
        frames(batch.observation["image"]),
        batch.action,
        batch.reward[:, None],
        batch.discount[:, None],
        frames(batch.next_observation["image"]),
    )

    def normal(*_: Any, **__: Any) -> Tensor:
        noise: Tensor = next(noises)
        return noise.clone()

    with (
        mock.patch.object(torch, "randint", side_effect=crops),
        mock.patch.object(utils, "_standard_normal", normal),
        mock.patch.object(Tensor, "float", Tensor.double),
    ):
        losses: dict[str, float] = theirs.update(iter([given]), ACTION)
    return losses


def authors_agent(folder: Path, hidden_dim: int, actions: int) -> tuple[Any, types.ModuleType]:
    """Return the authors' agent and utilities; Hydra, which they import, becomes empty modules."""
    for name in ("hydra", "omegaconf"):
        sys.modules[name] = types.ModuleType(name)
    sys.modules["omegaconf"].OmegaConf = None  # type: ignore[attr-defined]
    sys.path.insert(0, str(folder))
    module, utils = importlib.import_module("drqv2"), importlib.import_module("utils")
    agent = module.DrQV2Agent(
        obs_shape=(9, 84, 84),
        action_shape=(actions,),
        device=torch.device("cpu"),
        lr=CONFIG.learning_rate,
        feature_dim=CONFIG.latent_dim,
        hidden_dim=hidden_dim,
        critic_target_tau=CONFIG.tau,
        num_expl_steps=0,
        update_every_steps=2,
        stddev_schedule="linear(1.0,0.1,500000)",
        stddev_clip=CONFIG.noise_clip,
        use_tb=True,
    )
    return agent, utils


def weights(ours: DDPG, theirs: Any) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Yield (part, merl's weight, the authors' weight) for every weight."""
    networks, average = ours.networks, ours.critic_target
    pairs: dict[str, tuple[Any, Any]] = {
        "the encoder": (networks.encoders, theirs.encoder),
        "the critic's trunk": (networks.critic_fusion, theirs.critic.trunk),
        "the actor's trunk": (networks.actor_fusion, theirs.actor.trunk),
        "the actor": (networks.actor, theirs.actor.policy),
        "Q1": (networks.critic.q1, theirs.critic.Q1),
        "Q2": (networks.critic.q2, theirs.critic.Q2),
        "the averaged trunk": (average["critic_fusion"], theirs.critic_target.trunk),
        "the averaged Q1": (average["critic"].q1, theirs.critic_target.Q1),
        "the averaged Q2": (average["critic"].q2, theirs.critic_target.Q2),
    }
    for part, (mine, other) in pairs.items():
        for one, two in zip(mine.parameters(), other.parameters(), strict=True):
            yield part, one, two


def theirs_from(weight: Tensor) -> Tensor:
    """Convert a weight to the authors' order: channels, rows, columns for a trunk's inputs."""
    if weight.shape[-1] != SIDE * SIDE * CHANNELS:
        return weight
    return weight.reshape(-1, SIDE, SIDE, CHANNELS).permute(0, 3, 1, 2).flatten(1)


def frames(stack: Tensor) -> Tensor:
    """Convert a stack (B, K, H, W, C) to the authors' form (B, K C, H, W)."""
    return stack.permute(0, 1, 4, 2, 3).flatten(1, 2)


def crop(shift: Tensor) -> Tensor:
    """Convert a crop's (row, column) to the authors' (column, row), (B, 1, 1, 2)."""
    return shift.flip(-1)[:, None, None].double()


if __name__ == "__main__":
    tyro.cli(main)
