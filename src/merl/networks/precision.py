"""Precision that a layer computes in."""

from __future__ import annotations

import torch
from torch import Tensor


def compute_dtype(weight: Tensor) -> torch.dtype:
    """Return the precision of autocast if it is enabled, else that of the layer's weight."""
    device = weight.device.type
    enabled = torch.is_autocast_enabled(device)
    return torch.get_autocast_dtype(device) if enabled else weight.dtype
