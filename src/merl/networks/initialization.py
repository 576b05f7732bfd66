"""Orthogonal initialisation with zero biases (MERL C.1; gains as in DrQ-v2)."""

from __future__ import annotations

import math

import torch
from torch import nn


@torch.no_grad()
def orthogonal(module: nn.Module) -> None:
    """Initialise every linear layer with gain 1 and every convolution with gain sqrt(2)."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.Conv2d):
            gain = math.sqrt(2.0) if isinstance(layer, nn.Conv2d) else 1.0
            # Draw into a contiguous tensor: a convolution's weights are in channels-last order.
            layer.weight.copy_(nn.init.orthogonal_(torch.empty(layer.weight.shape), gain))
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
