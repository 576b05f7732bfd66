"""Orthogonal initialisation with zero biases (MERL C.1; gains as in DrQ-v2)."""

from __future__ import annotations

import math

import torch
from torch import nn

KEEPS_WEIGHTS = "keeps_weights"
"""Attribute of modules that keep their own initialisation."""


@torch.no_grad()
def orthogonal(module: nn.Module) -> None:
    """Initialise every linear layer with gain 1 and every convolution with gain sqrt(2)."""
    if hasattr(module, KEEPS_WEIGHTS):
        return
    if isinstance(module, nn.Linear | nn.Conv2d | nn.Conv1d):
        gain = 1.0 if isinstance(module, nn.Linear) else math.sqrt(2.0)
        # Draw into a contiguous tensor: a convolution's weights are in channels-last order.
        module.weight.copy_(nn.init.orthogonal_(torch.empty(module.weight.shape), gain))
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    for child in module.children():
        orthogonal(child)
