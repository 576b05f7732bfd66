"""Writer of a folder of demonstrations."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from merl.core import MerlError
from merl.core.files import replace_file, reporting
from merl.demos.demonstrations import FORMAT, INDEX, KEY, Demonstrations, Line
from merl.demos.episode import Episode
from merl.runs.plain import describe


class Recorder:
    """Writer of a folder of demonstrations, which is complete after every episode.

    Args:
        path: the folder, which must not exist or be empty.
        task: the task.
        source: who acts.
        observation_space, action_space: spaces of the environment.
        options: options of the task, if it is one of merl's.
        append: add to the demonstrations that the folder holds, if it does.

    Raises:
        MerlError: the folder holds other files, or cannot be created.
    """

    def __init__(
        self,
        path: Path,
        task: str,
        source: str,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        options: Mapping[str, Any] | None = None,
        *,
        append: bool = False,
    ) -> None:
        if append and (path / INDEX).exists():
            self.demonstrations = Demonstrations.open(path)
            self.demonstrations.check_fits(observation_space, action_space)
            return
        if not append:  # else an episode without its line in the index is written again
            check_free(path)
        self.demonstrations = Demonstrations(
            path, task, source, observation_space, action_space, (), options or {}
        )

    def add(self, episode: Episode) -> None:
        """Write an episode.

        Raises:
            MerlError: it cannot be written.
        """
        demos = self.demonstrations
        name = f"{len(demos.lines):05}.npz"
        returned = float(np.sum(episode.rewards, dtype=np.float64))
        line = Line(name, len(episode), returned, episode.success)
        whole = replace(demos, lines=(*demos.lines, line))
        arrays: dict[str, Any] = {  # in the type of the space, as they are checked when read
            KEY + key: np.asarray(episode.observations[key], space.dtype)
            for key, space in demos.observation_space.spaces.items()
        }
        arrays |= {"action": episode.actions, "intended": episode.intended}
        arrays |= {"reward": episode.rewards, "terminated": np.array(episode.terminated)}
        if episode.successes is not None:
            arrays["success"] = episode.successes
        content = io.BytesIO()
        np.savez_compressed(content, **arrays)
        with reporting(f"{demos.path} cannot be written"):
            demos.path.mkdir(parents=True, exist_ok=True)
            replace_file(demos.path / name, content.getvalue())
            replace_file(demos.path / INDEX, (json.dumps(_index(whole), indent=1) + "\n").encode())
        self.demonstrations = whole


def check_free(path: Path) -> None:
    """Check that a folder can be written: it is empty, or can be created.

    Raises:
        MerlError: it holds files, or cannot be created.
    """
    with reporting(f"{path} cannot be created"):
        if not path.exists():
            path.mkdir(parents=True)
            path.rmdir()
        elif any(path.iterdir()):
            raise MerlError(f"{path} is not empty: name another folder")


def _index(demos: Demonstrations) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "task": demos.task,
        "source": demos.source,
        "options": dict(demos.options),
        "observation_space": {k: describe(s) for k, s in demos.observation_space.items()},
        "action_space": describe(demos.action_space),
        "episodes": [asdict(line) for line in demos.lines],
    }
