"""merl: multimodal end-to-end reinforcement learning for robot arms.

The public names are loaded when first used, so that a room which needs neither torch nor MuJoCo
(`merl.report`) does not pay for them.
"""

# Before these lines nothing is imported that Python has not loaded itself: `python -m merl.cli`
# searches the working folder first, and that folder may be the run of a stranger.
import os
import sys

if sys.argv[:1] == ["-m"] and "merl.cli" in sys.orig_argv and not sys.flags.safe_path:
    try:
        if sys.path[0] == os.getcwd():  # noqa: PTH109 (pathlib is not loaded yet)
            del sys.path[0]
    except OSError:  # the working folder was removed, so it is not searched
        pass
    _source = __file__.removesuffix(f"{os.sep}merl{os.sep}__init__.py")
    if _source not in sys.path:
        sys.path.append(_source)  # merl lies in the working folder; worker processes need it

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["__version__", "load_policy", "make_env"]

from merl.envs.registration import register as _register

_register()

if TYPE_CHECKING:
    from merl.envs import make_env
    from merl.evaluation.evaluation import load_policy

_PUBLIC = {"make_env": "merl.envs", "load_policy": "merl.evaluation.evaluation"}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'merl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
