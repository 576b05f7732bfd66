"""torch.compile for the networks that updates call."""

from __future__ import annotations

import torch
from torch import nn

from merl.agents.networks import Networks


def compile_parts(networks: Networks, critic_target: nn.ModuleDict, device: torch.device) -> None:
    """Have torch compile the networks, in place.

    Args:
        networks: an agent's.
        critic_target: its target.
        device: where they live.
    """
    parts: list[nn.Module] = [networks.critic_fusion, networks.critic, networks.actor]
    parts += [] if networks.actor_fusion is None else [networks.actor_fusion]
    parts += critic_target.values()
    if device.type == "cuda":  # shift, interleaving and casts become one kernel
        parts.append(networks.encoders)  # on a CPU convolutions are no faster for it
    from torch._dynamo import config as dynamo
    from torch._functorch import config as functorch

    # Each gradient in the precision of what it is of, as without, not all in autocast's.
    functorch.backward_pass_autocast = "off"
    dynamo.recompile_limit = 64  # precisions and threads are tried out: each needs its own
    for part in parts:
        part.compile(dynamic=False)
