"""merl: multimodal end-to-end reinforcement learning for robot arms.

The public names are loaded when first used, so that a room which needs neither torch nor MuJoCo
(`merl.report`) does not pay for them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["__version__", "load_policy", "make_env"]

from merl.envs.registration import register as _register

_register()

if TYPE_CHECKING:
    from merl.envs import make_env
    from merl.training.evaluation import load_policy

_PUBLIC = {"make_env": "merl.envs", "load_policy": "merl.training.evaluation"}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'merl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
