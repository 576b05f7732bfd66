"""The weights that acting needs, as bytes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from merl.agents import imitates
from merl.agents.ddpg import DDPG
from merl.agents.networks import user_encoders
from merl.config import TrainConfig
from merl.core import Agent, MerlError


def check_can_act(config: TrainConfig) -> None:
    """Check that actors can have the agent of a run: no code of the user's is sent to them.

    Raises:
        MerlError: its agent or one of its encoders is the user's own class, or the agent only
            imitates.
    """
    if imitates(config.agent_name):
        raise MerlError(
            f"agent {config.agent_name} learns from demonstrations alone, and needs no actor: "
            "train it with `merl train`"
        )
    own = [name for name in (config.agent_name, *user_encoders(config.agent)) if ":" in name]
    if own:
        raise MerlError(
            f"an actor cannot have {own[0]}, which is a class of your own: use an agent and "
            "encoders of merl"
        )


def pack(agent: Agent) -> tuple[list[Any], bytes]:
    """Return name, type and shape of each weight that exploring needs, and their bytes."""
    weights = {name: tensor.detach().cpu().numpy() for name, tensor in _needed(agent).items()}
    form = [[name, value.dtype.str, list(value.shape)] for name, value in weights.items()]
    return form, b"".join(np.ascontiguousarray(value).tobytes() for value in weights.values())


def load(agent: Agent, form: list[Any], data: bytearray) -> None:
    """Load the result of `pack` into an actor's agent.

    Raises:
        MerlError: the weights are those of other networks.
    """
    weights, at = dict(_networks(agent).state_dict()), 0
    expected = {name: tuple(tensor.shape) for name, tensor in _needed(agent).items()}
    if {name: tuple(shape) for name, _, shape in form} != expected:
        raise MerlError("the learner's weights are of other networks: restart the actor")
    for name, kind, shape in form:
        dtype = np.dtype(kind)
        count = int(np.prod(shape, dtype=np.int64))
        value = np.frombuffer(data, dtype, count, at).reshape(shape)
        weights[name], at = torch.from_numpy(value), at + count * dtype.itemsize
    agent.load_policy({"networks": weights})


def _needed(agent: Agent) -> Mapping[str, Tensor]:
    """Return the weights that act with noise: the critic's only if it chooses between actions."""
    networks = _networks(agent)
    left_out = ["policy_average."]
    if networks.imitator is None:
        left_out.append("critic.")
        if networks.actor_fusion is not None:
            left_out.append("critic_fusion.")
    return {
        name: tensor
        for name, tensor in networks.state_dict().items()
        if not name.startswith(tuple(left_out))
    }


def _networks(agent: Agent) -> Any:
    assert isinstance(agent, DDPG)  # `check_can_act`
    return agent.networks
