"""Module names of modalities."""

from __future__ import annotations

from torch import nn


def module_name(key: str) -> str:
    """Return the key, or an encoded form where torch rejects it (`arm.joints`, `type`)."""
    if key.isidentifier() and not hasattr(nn.ModuleDict(), key):
        return key
    return f"key_{key.encode().hex()}"
