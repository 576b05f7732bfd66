"""The agents: one learner (`ddpg`), and each agent a choice of values for it (`config`)."""

from __future__ import annotations

import torch
from gymnasium import spaces

from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.drqv2 import DrQV2Config
from merl.agents.merl import MERLConfig
from merl.agents.networks import make_networks
from merl.agents.sac import SAC, SACConfig
from merl.networks.heads import Actor, GaussianActor
from merl.networks.settings import torch_settings

AGENTS: dict[str, AgentConfig] = {
    "merl": MERLConfig(),
    "drqv2": DrQV2Config(),
    "ddpg": DDPGConfig(),
    "sac": SACConfig(),
    # What the paper's argument needs beside its four: the joints alone, and MERL on the state.
    "proprio": MERLConfig(images=()),
    "merl_state": MERLConfig(images=(), vectors=("state",)),
}
"""The agents by name."""


def make_agent(
    config: AgentConfig,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    *,
    frame_stack: int,
    seed: int,
    device: torch.device,
    threads: int | None = None,
) -> DDPG:
    """Make the agent of a config for these spaces.

    Args:
        config: what it is made of.
        observation_space: what the environment gives.
        action_space: what it takes, (A,).
        frame_stack: frames of an image that the agent sees at once.
        seed: of its weights, noise and shifts.
        device: where it lives.
        threads: processor threads of acting and updates; None: as torch is set.

    Raises:
        MerlError: the observation lacks what the agent consumes, or the config does not fit it.
    """
    actor = GaussianActor if isinstance(config, SACConfig) else Actor
    with torch_settings(device, threads):
        torch.manual_seed(seed)
        networks = make_networks(
            config, observation_space, action_space.shape[0], frame_stack, actor
        )
        if isinstance(config, SACConfig):
            return SAC(networks, config, seed=seed, device=device, threads=threads)
        return DDPG(networks, config, seed=seed, device=device, threads=threads)
