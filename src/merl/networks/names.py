"""The name of a modality's module."""

from __future__ import annotations

from torch import nn


def module_name(key: str) -> str:
    """The key itself, unless torch would take it for something else (`arm.joints`, `type`)."""
    if key.isidentifier() and not hasattr(nn.ModuleDict(), key):
        return key
    return f"key_{key.encode().hex()}"
