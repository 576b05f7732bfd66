"""robomimic's format: an HDF5 file, /data/demo_N with actions, rewards, dones, obs and next_obs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.packages import require
from merl.demos.source import Feature, RawEpisode

WHAT = "robomimic's format"
INTENDED, SUCCESSES = "intended_actions", "successes"
"""Datasets of merl's: by them an exported file is imported as it was."""


class RobomimicFile:
    """An HDF5 file of robomimic; see `merl.demos.source.Source`.

    Args:
        path: the file.

    Raises:
        MerlError: it cannot be read, or has another structure.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.format = path, "robomimic HDF5"
        self.rate: float | None = None
        with _opened(path) as file:
            data = _group(file, "data", path)
            self._names = sorted((str(name) for name in data), key=_number)
            if not self._names:
                raise MerlError(f"{path} holds no episode: /data is empty")
            first = _group(data, self._names[0], path)
            self.action_size = _array(first, "actions", path).shape[-1]
            self.features: Mapping[str, Feature] = {
                str(key): Feature(
                    value.shape[1:], str(value.dtype), value.ndim == 4 and value.dtype == np.uint8
                )
                for key, value in _group(first, "obs", path).items()
            }
            try:
                arguments = json.loads(data.attrs["env_args"])["env_kwargs"]
                self.rate = float(arguments["control_freq"])
            except (KeyError, TypeError, ValueError):
                pass  # robomimic's own files do not tell it
        self.count = len(self._names)

    def episodes(self, keys: tuple[str, ...]) -> Iterator[RawEpisode]:
        """Read the episodes with these features; see `Source`."""
        with _opened(self.path) as file:
            for name in self._names:
                demo = _group(file["data"], name, self.path)
                observed = _group(demo, "obs", self.path)
                values = {key: _array(observed, key, self.path) for key in keys}
                if "next_obs" in demo:
                    later = _group(demo, "next_obs", self.path)
                    values = {
                        key: np.concatenate([value, _array(later, key, self.path)[-1:]])
                        for key, value in values.items()
                    }
                actions = _array(demo, "actions", self.path)
                given = {
                    key: _array(demo, key, self.path) if key in demo else None
                    for key in ("rewards", INTENDED, SUCCESSES)
                }
                told = {
                    key: bool(demo.attrs[key]) if key in demo.attrs else None
                    for key in ("terminated", "success")
                }
                yield RawEpisode(
                    name,
                    values,
                    actions,
                    given[INTENDED],
                    given["rewards"],
                    successes=given[SUCCESSES],
                    **told,
                )


def write_robomimic(demos: Demonstrations, out: Path, rate: float | None) -> None:
    """Write demonstrations as one HDF5 file of robomimic; images are stored without loss.

    Args:
        demos: the demonstrations.
        out: the file.
        rate: timesteps in a second; None if it is not known.
    """
    require("h5py", WHAT)
    import h5py

    options = {} if rate is None else {"control_freq": rate}
    with h5py.File(out, "w") as file:
        data = file.create_group("data")
        # robomimic knows no environments of Gymnasium: 2 is its type "gym".
        told = {"env_name": demos.task, "type": 2, "env_kwargs": options}
        data.attrs["env_args"] = json.dumps(told)
        data.attrs["total"] = demos.steps
        for index, episode in enumerate(demos.episodes()):
            steps = len(episode)
            demo = data.create_group(f"demo_{index}")
            demo.attrs["num_samples"] = steps
            demo.attrs["terminated"] = episode.terminated
            if episode.success is not None:
                demo.attrs["success"] = episode.success
            demo["actions"], demo[INTENDED] = episode.actions, episode.intended
            demo["rewards"] = episode.rewards
            if episode.successes is not None:
                demo[SUCCESSES] = episode.successes
            demo["dones"] = (np.arange(steps) == steps - 1).astype(np.int64)
            for key, value in episode.observations.items():
                demo.create_dataset(f"obs/{key}", data=value[:-1], compression="gzip")
                demo.create_dataset(f"next_obs/{key}", data=value[1:], compression="gzip")


def _opened(path: Path) -> Any:
    require("h5py", WHAT)
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {error}") from None


def _group(parent: Any, name: str, path: Path) -> Any:
    found = parent.get(name)
    if not hasattr(found, "items"):
        raise MerlError(f"{path} is not in {WHAT}: it has no {parent.name.rstrip('/')}/{name}")
    return found


def _array(parent: Any, name: str, path: Path) -> NDArray[Any]:
    found = parent.get(name)
    if not hasattr(found, "dtype"):
        raise MerlError(f"{path} is not in {WHAT}: it has no {parent.name.rstrip('/')}/{name}")
    try:
        return np.asarray(found)
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {error}") from None


def _number(name: str) -> tuple[int, str]:
    """Return a key that sorts demo_10 after demo_9."""
    digits = name.rpartition("_")[2]
    return (int(digits) if digits.isdigit() else 0, name)
