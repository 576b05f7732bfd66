"""A policy that was exported to one file: read it, and act with it."""

from __future__ import annotations

import logging
import runpy
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.instances import EnvRecipe
from merl.core import MerlError, Observation
from merl.core.files import read_json
from merl.core.user_code import in_one_line
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.evaluation.policy import checked
from merl.modalities import modalities_of
from merl.runs.plain import box, from_plain

Form = Literal["onnx", "torch", "numpy"]
SUFFIXES: dict[Form, str] = {"onnx": ".onnx", "torch": ".pt2", "numpy": ".py"}
FORMER = "_former"
"""Ending of the inputs with the former frames of a camera."""
NEXT = "_next"
"""Ending of the outputs with the former frames for the next step."""
Values = Mapping[str, NDArray[Any]]
Run = Callable[[Values], dict[str, NDArray[Any]]]
"""The exported function: from inputs by name to outputs by name."""


class ExportedPolicy:
    """An exported policy that acts on single observations; it keeps the former frames itself.

    Call `reset()` at the start of each episode, then call the policy with each observation.

    Args:
        path: the file, beside its card.

    Attributes:
        card: what the card says.
        modalities: the modality of each key that the policy uses.
        bounds: lower and upper bounds of the actions in the environment's own units.
        recipe: how the environment of its training was made.

    Raises:
        MerlError: the file or its card is missing or damaged, or one is of another policy.
    """

    def __init__(self, path: Path) -> None:
        self.card = _card(path)
        try:
            names, outputs = list(self.card["inputs"]), list(self.card["outputs"])
            low, high = (np.asarray(b, np.float32) for b in self.card["action_bounds"])
            told = {
                name: (np.dtype(each["dtype"]), tuple(each["shape"]))
                for name, each in self.card["inputs"].items()
            }
            observed = self.card["observations"].items()
            space = spaces.Dict({key: box(described) for key, described in observed})
            (size,) = self.card["outputs"]["action"]["shape"]
            if low.shape != (size,) or high.shape != (size,) or not (low < high).all():
                raise ValueError(f"action_bounds {self.card['action_bounds']}")
            env = from_plain(EnvConfig, self.card.get("env") or {})
            repeat = self.card.get("action_repeat", 1)
            if type(repeat) is not int or repeat < 1:
                raise ValueError(f"action_repeat {repeat!r}")
        except (KeyError, TypeError, ValueError, AttributeError, MerlError) as error:
            raise MerlError(f"{card_of(path)} is damaged: {error!r}") from None
        self.recipe = EnvRecipe(str(self.card.get("task")), env, UserEnvConfig(), repeat)
        self.modalities = modalities_of(space)
        self._former = {name: each for name, each in told.items() if name.endswith(FORMER)}
        self._low, self._high = low, high
        self.bounds = low.tolist(), high.tolist()
        self._frames: dict[str, NDArray[Any]] = {}
        try:
            self._run = load_exported(path, names, outputs)
            self({key: np.zeros(m.shape, m.space.dtype) for key, m in self.modalities.items()})
            self.reset()
        except MerlError:
            raise
        except Exception as error:  # from ONNX Runtime or torch
            raise MerlError(
                f"{path} cannot be run as its card says: {in_one_line(error)}: export it again"
            ) from None

    def reset(self) -> None:
        """Start a new episode: discard the former frames."""
        self._frames = {}

    def __call__(self, observation: Observation) -> NDArray[np.float32]:
        """Return the action for an observation, in [-1, 1], as `Policy` does.

        Raises:
            MerlError, NotFinite: see `Policy`.
        """
        values = {
            key: modality.to_stored(checked(key, modality, observation))
            for key, modality in self.modalities.items()
        }
        for name, (_, shape) in self._former.items():
            frame = values[name.removesuffix(FORMER)]
            values[name] = self._frames.get(name, np.broadcast_to(frame, shape).copy())
        found = self._run(values)
        for name in self._former:
            self._frames[name] = found[name.removesuffix(FORMER) + NEXT]
        action = 2.0 * (found["action"] - self._low) / (self._high - self._low) - 1.0
        clipped: NDArray[np.float32] = action.clip(-1.0, 1.0).astype(np.float32)
        return clipped


def card_of(path: Path) -> Path:
    """Return the file of a policy's card."""
    return path.with_name(f"{path.name}.json")


def _card(path: Path) -> dict[str, Any]:
    file = card_of(path)
    try:
        card = read_json(file)
    except FileNotFoundError:
        raise MerlError(f"{path} has no card {file.name} beside it: copy both files") from None
    except (OSError, ValueError) as error:
        raise MerlError(f"{file} cannot be read: {error}") from None
    if not path.is_file():
        raise MerlError(f"{path} does not exist")
    if not isinstance(card, dict):
        raise MerlError(f"{file} is damaged: it holds no object")
    return card


def load_exported(path: Path, names: list[str], outputs: list[str]) -> Run:
    """Load an exported policy; return it as a function from inputs by name to outputs by name."""
    if path.suffix == SUFFIXES["onnx"]:
        if find_spec("onnxruntime") is None:
            raise MerlError(f"{path} needs ONNX Runtime: pip install 'merl-rl[onnx]'")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        return lambda values: dict(
            zip(outputs, session.run(outputs, {name: values[name] for name in names}), strict=True)
        )
    if path.suffix == SUFFIXES["numpy"]:
        found: dict[str, Any] = runpy.run_path(str(path))
        weights = found["Policy"]().weights
        return lambda values: dict(found["compute"](weights, values))
    import torch

    logging.getLogger("torch.export").setLevel(logging.ERROR)  # its warnings are tracebacks
    module = torch.export.load(path).module()

    def run(values: Values) -> dict[str, NDArray[Any]]:
        with torch.inference_mode():
            found = module(*(torch.from_numpy(values[name]) for name in names))
        return {name: value.numpy() for name, value in zip(outputs, found, strict=True)}

    return run
