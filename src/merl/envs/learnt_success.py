"""Success that a classifier sees in the camera's images, for a robot that cannot measure it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces

from merl.core import MerlError
from merl.core.user_code import in_one_line

if TYPE_CHECKING:
    from merl.networks.success_classifier import SuccessNetwork

SHAPES = "shapes"
"""Name of the images' shapes in the metadata of a classifier's file."""


def load_classifier(file: Path) -> tuple[SuccessNetwork, dict[str, tuple[int, ...]]]:
    """Read a classifier that `merl classifier` wrote; return it and the shapes of its images.

    Raises:
        MerlError: it cannot be read.
    """
    import torch
    from safetensors import safe_open

    from merl.networks.success_classifier import SuccessNetwork

    try:
        with safe_open(file, "pt") as opened:
            described = json.loads((opened.metadata() or {})[SHAPES])
            weights = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
        shapes = {str(key): tuple(map(int, shape)) for key, shape in described.items()}
        network = SuccessNetwork(shapes)
        with torch.no_grad():  # gives the lazy layers their sizes
            network({key: torch.zeros((1, *shape)) for key, shape in shapes.items()})
        network.load_state_dict(weights)
    except Exception as error:  # the file may come from anyone
        raise MerlError(
            f"{file} is not a classifier that can be read: {in_one_line(error)}"
        ) from None
    return network.eval(), shapes


class LearntSuccess(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment whose reward and success come from a classifier of its images.

    An episode ends with success once the classifier has seen it for `steps` steps in a row. The
    reward is 1 at that step and 0 at all others. `info` holds `success` and
    `success_probability`.

    Args:
        env: an environment with a Dict of observations.
        file: the classifier, from `merl classifier`.
        threshold: probability from which a step counts, in (0, 1).
        steps: number of consecutive steps that end the episode.

    Raises:
        MerlError: the file cannot be read, or the environment has other images.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        file: Path | str,
        *,
        threshold: float = 0.9,
        steps: int = 3,
    ) -> None:
        super().__init__(env)
        self._network, shapes = load_classifier(Path(file))
        self._threshold, self._steps, self._seen = threshold, steps, 0
        given = env.observation_space
        for key, shape in shapes.items():
            box = given.spaces.get(key) if isinstance(given, spaces.Dict) else None
            if box is None or box.shape != shape or box.dtype != np.uint8:
                has = "none" if box is None else f"{box.dtype} {box.shape}"
                raise MerlError(f"{file} needs image {key!r} of uint8 {shape}: this one is {has}")

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        self._seen = 0
        return self.env.reset(**options)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step; see `gymnasium.Env.step`."""
        observation, _, terminated, truncated, info = self.env.step(action)
        probability = self.probability(observation)
        self._seen = self._seen + 1 if probability >= self._threshold else 0
        success = self._seen >= self._steps
        told = {"success": float(success), "success_probability": probability}
        return observation, float(success), terminated or success, truncated, info | told

    def probability(self, observation: Any) -> float:
        """Return the probability that the task is solved in an observation."""
        import torch

        images = {
            key: torch.from_numpy(np.array(observation[key]))[None] for key in self._network.keys
        }
        with torch.inference_mode():
            return float(self._network(images).sigmoid())
