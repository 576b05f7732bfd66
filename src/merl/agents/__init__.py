"""The agents: one learner (`ddpg`); each agent is a choice of values for it (`config`)."""

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
    # Two baselines of the paper's argument: proprioception alone, and MERL on the state.
    "proprio": MERLConfig(modalities=("vector", "sequence")),
    "merl_state": MERLConfig(keys=("state",)),
}
"""Default config of each agent, by name."""


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
    """Build the agent of a config for these spaces.

    Args:
        config: config of the agent.
        observation_space: observations of the environment.
        action_space: actions of the environment, (A,).
        frame_stack: number of frames in an image stack.
        seed: seed of weights, noise and shifts.
        device: device of the agent.
        threads: CPU threads of acting and updates; None keeps torch's setting.

    Raises:
        MerlError: the observation space lacks a key that the agent uses, or the config does not fit
            the space.
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
