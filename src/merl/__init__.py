"""merl: multimodal end-to-end reinforcement learning for robot arms.

The public names are loaded on first use, so that a package that needs neither torch nor MuJoCo
(`merl.report`) does not import them.
"""

# Import nothing before these lines except what Python itself has loaded: `python -m merl.cli`
# searches the working folder first, and that folder may be an untrusted run folder.
import os
import sys

if sys.argv[:1] == ["-m"] and "merl.cli" in sys.orig_argv and not sys.flags.safe_path:
    try:
        if sys.path[0] == os.getcwd():  # noqa: PTH109 (pathlib is not loaded yet)
            del sys.path[0]
    except OSError:  # the working folder was deleted, so Python cannot search it
        pass
    _source = __file__.removesuffix(f"{os.sep}merl{os.sep}__init__.py")
    if _source not in sys.path:
        sys.path.append(_source)  # merl is in the working folder; worker processes need the path

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = [
    "Callback",
    "TrainConfig",
    "Trainer",
    "__version__",
    "evaluate",
    "load_policy",
    "loggers",
    "make_env",
    "resume",
    "train",
]

from merl.envs.registration import register as _register

_register()

if TYPE_CHECKING:
    from merl import loggers
    from merl.api import evaluate, resume, train
    from merl.callbacks import Callback
    from merl.config import TrainConfig
    from merl.envs import make_env
    from merl.evaluation.policy import load_policy
    from merl.training.trainer import Trainer

_PUBLIC = {
    "Callback": "merl.callbacks",
    "TrainConfig": "merl.config",
    "Trainer": "merl.training.trainer",
    "evaluate": "merl.api",
    "load_policy": "merl.evaluation.policy",
    "loggers": "merl.loggers",
    "make_env": "merl.envs",
    "resume": "merl.api",
    "train": "merl.api",
}


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        module = import_module(_PUBLIC[name])
        return getattr(module, name, module)
    raise AttributeError(f"module 'merl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
