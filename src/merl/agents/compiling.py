"""Compilation, with torch.compile, of the networks that updates call."""

from __future__ import annotations

import torch
from torch import nn

from merl.agents.networks import Networks


def compile_parts(networks: Networks, critic_target: nn.ModuleDict, device: torch.device) -> None:
    """Compile an agent's networks in place.

    Args:
        networks: the agent's networks.
        critic_target: the agent's target networks.
        device: device of both.
    """
    parts: list[nn.Module] = [networks.critic_fusion, networks.critic, networks.actor]
    parts += [] if networks.actor_fusion is None else [networks.actor_fusion]
    parts += critic_target.values()
    if device.type == "cuda":  # there, shift, interleaving and casts become one kernel
        parts.append(networks.encoders)  # on a CPU, compiled convolutions are not faster
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    # Compute each gradient in its tensor's precision, as in eager mode, not in autocast's.
    functorch.backward_pass_autocast = "off"
    dynamo.recompile_limit = 64  # each precision and thread count that is timed needs its own
    for part in parts:
        part.compile(dynamic=False)
