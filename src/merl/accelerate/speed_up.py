"""Faster forms of an agent's networks: all heads of the critic at once, and torch.compile."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from merl.accelerate.joint_heads import join_heads
from merl.agents.ddpg import DDPG
from merl.core import Agent


def speed_up(agent: Agent) -> None:
    """Replace the networks' forward methods by faster ones, for updates on the agent's device.

    An agent that is not based on merl's learner is left unchanged.

    Args:
        agent: an agent that was just made; `config.torch_compile` "auto" means no here.
    """
    if not isinstance(agent, DDPG):
        return
    if agent.device.type == "cuda":
        for critic in (agent.networks.critic, agent.critic_target["critic"]):
            join_heads(critic)
    if agent.config.torch_compile == "yes":
        compile_networks(agent)


def compile_networks(agent: DDPG) -> None:
    """Compile the networks that updates call, in place."""
    networks = agent.networks
    parts: list[nn.Module] = [networks.critic_fusion, networks.critic, networks.actor]
    parts += [] if networks.actor_fusion is None else [networks.actor_fusion]
    parts += agent.critic_target.values()
    if agent.device.type == "cuda":  # there, shift, interleaving and casts become one kernel
        parts.append(networks.encoders)  # on a CPU, compiled convolutions are not faster
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    # Compute each gradient in its tensor's precision, as in eager mode, not in autocast's.
    functorch.backward_pass_autocast = "off"
    dynamo.recompile_limit = 64  # each precision and thread count that is timed needs its own
    for part in parts:
        compile_forward(part)


def compile_forward(part: nn.Module) -> None:
    """Compile a network for updates; acting runs eagerly.

    Each batch size of acting would need another compilation.
    """
    eager = part.forward
    compiled = torch.compile(eager, dynamic=False)

    def forward(*inputs: Any, **options: Any) -> Any:
        acts = torch.is_inference_mode_enabled()  # `DDPG.act` runs in inference mode
        return (eager if acts else compiled)(*inputs, **options)

    part.forward = forward
