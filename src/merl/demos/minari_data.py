"""Datasets of Minari: a folder with episodes in HDF5 or Arrow, which the package itself reads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.packages import require
from merl.demos.source import Feature, RawEpisode, at_each_step

WHAT = "a dataset of Minari"
SINGLE = "state"
"""merl's name of an observation that is a single box."""


class MinariData:
    """A dataset of Minari; see `merl.demos.source.Source`.

    Args:
        path: the folder of the dataset, which contains `data`.

    Raises:
        MerlError: it cannot be read, or its spaces are not those of an agent.
    """

    def __init__(self, path: Path) -> None:
        require("minari", WHAT)
        from minari import MinariDataset

        self.path, self.format = path, "Minari"
        self._data = MinariDataset(path / "data")
        observed, action = self._data.observation_space, self._data.action_space
        self.count = int(self._data.total_episodes)
        if not isinstance(observed, spaces.Dict):
            observed = spaces.Dict({SINGLE: observed})
        if not isinstance(action, spaces.Box) or len(action.shape) != 1:
            raise MerlError(f"{path}: actions are {action}, and an agent has a box of one axis")
        self.action_size = action.shape[0]
        self.features: Mapping[str, Feature] = {
            str(key): Feature(
                space.shape, str(space.dtype), space.dtype == np.uint8 and len(space.shape) == 3
            )
            for key, space in observed.spaces.items()
            if isinstance(space, spaces.Box)
        }
        self.rate: float | None = None  # a dataset does not tell it

    def episodes(self, keys: tuple[str, ...]) -> Iterator[RawEpisode]:
        """Read the episodes with these features; see `Source`."""
        for episode in self._data.iterate_episodes():
            observed = episode.observations
            observed = observed if isinstance(observed, dict) else {SINGLE: observed}
            infos: Any = episode.infos or {}
            terminated = bool(episode.terminations[-1])
            solved = _solved(infos.get("success"), len(episode.actions))
            yield RawEpisode(
                f"episode {episode.id}",
                {key: np.asarray(observed[key]) for key in keys},
                np.asarray(episode.actions),
                _like(infos.get("intended_action"), episode.actions),
                np.asarray(episode.rewards),
                terminated,
                None if solved is None else bool(solved[-1]),
                None if solved is None else at_each_step(solved, terminated=terminated),
            )


def write_minari(demos: Demonstrations, out: Path) -> None:
    """Write demonstrations as a dataset of Minari, without loss.

    Args:
        demos: the demonstrations.
        out: the folder, which exists and is empty.
    """
    require("minari", WHAT)
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    folder = out.absolute() / "data"  # the package measures sizes wrongly in a relative folder
    folder.mkdir()
    # Minari's JPEG encoding would lose pixels.
    storage = MinariStorage.new(
        folder, demos.observation_space, demos.action_space, jpeg_encoding=False
    )
    for index, episode in enumerate(demos.episodes()):
        steps = len(episode)
        last = np.arange(steps) == steps - 1
        infos: dict[str, Any] = {"intended_action": _after_reset(episode.intended)}
        if episode.success is not None:
            known = episode.successes
            infos["success"] = _after_reset(last & episode.success if known is None else known)
        storage.update_episodes(
            [
                EpisodeBuffer(
                    id=index,
                    observations=dict(episode.observations),
                    actions=episode.actions,
                    rewards=episode.rewards.tolist(),
                    terminations=(last & episode.terminated).tolist(),
                    truncations=(last & (not episode.terminated)).tolist(),
                    infos=infos,
                )
            ]
        )
    name = demos.task.replace(":", "-").replace("_", "-")
    storage.update_metadata(
        {"dataset_id": f"merl/{name}/demos-v0", "minari_version": minari.__version__}
    )


def _after_reset(value: NDArray[Any]) -> NDArray[Any]:
    """Return values with one more at the front: Minari's infos begin with that of the reset."""
    return np.concatenate([np.zeros_like(value[:1]), value])


def _solved(value: Any, steps: int) -> NDArray[np.bool_] | None:
    """Return whether the episode was solved after each step; None if it is not told."""
    flags = np.zeros(0) if value is None else np.asarray(value).reshape(-1)
    return flags[-steps:].astype(bool) if len(flags) in (steps, steps + 1) else None


def _like(value: Any, actions: Any) -> NDArray[Any] | None:
    """Return the intended actions of `write_minari`, or None."""
    if value is None:
        return None
    found = np.asarray(value)[1:]
    return found if found.shape == np.shape(actions) else None
