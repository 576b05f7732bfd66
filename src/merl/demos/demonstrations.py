"""Demonstrations: a folder with recorded episodes, from which runs learn.

demos.json          task, spaces, source, and a line for each episode
00000.npz, ...      an episode each: observations (T + 1, ...) by key, actions and intended actions
                    (T, A), rewards (T,)

The observations are stored as the environment returned them, without loss.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from merl.core import MerlError, Transition, counted
from merl.core.files import cause, open_file, read_json, reporting
from merl.core.user_code import in_one_line
from merl.demos.episode import Episode, check_episode
from merl.modalities import modalities_of
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
from merl.replay.mixing import INTENDED
from merl.runs.plain import box, describe, told

INDEX = "demos.json"
FORMAT = 1
KEY = "observation/"
"""Precedes the keys of an observation in an episode's archive."""


@dataclass(frozen=True)
class Line:
    """What the index says of an episode."""

    file: str
    steps: int
    returned: float
    success: bool | None


@dataclass(frozen=True)
class Demonstrations:
    """A folder of demonstrations.

    Attributes:
        path: the folder.
        task: the task in which they were recorded.
        source: who acted, e.g. "expert, noise 0.1".
        observation_space, action_space: spaces of the environment.
        lines: the episodes.
        options: options of the task, if it is one of merl's.
    """

    path: Path
    task: str
    source: str
    observation_space: spaces.Dict
    action_space: spaces.Box
    lines: tuple[Line, ...]
    options: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Demonstrations:
        """Open a folder of demonstrations.

        Raises:
            MerlError: it is not one, or its index cannot be read.
        """
        file = path / INDEX
        try:
            found = read_json(file)
            if found["format"] != FORMAT:
                raise MerlError(
                    f"{file} has format {found['format']}, and this version reads format {FORMAT}"
                )
            observation: dict[str, spaces.Space[Any]] = {
                key: box(space) for key, space in found["observation_space"].items()
            }
            lines = tuple(_line(line) for line in found["episodes"])
            options = found.get("options", {})
            if not isinstance(options, dict):
                raise TypeError("options")
            return cls(
                path,
                str(found["task"]),
                str(found["source"]),
                spaces.Dict(observation),
                box(found["action_space"]),
                lines,
                options,
            )
        except FileNotFoundError:
            raise MerlError(
                f"{path} holds no demonstrations: it has no {INDEX}; `merl demos record` makes "
                "them (if they were moved, resume their run with the command that began it, with "
                "--resume and their new --demos)"
            ) from None
        except OSError as error:
            raise MerlError(f"{file} cannot be read: {cause(error)}") from None
        except MerlError:
            raise
        except Exception as error:  # the file may come from anyone
            raise MerlError(f"{file} is damaged: {in_one_line(error)}") from None

    @property
    def steps(self) -> int:
        """Number of steps in all episodes."""
        return sum(line.steps for line in self.lines)

    def episodes(self) -> Iterator[Episode]:
        """Read the episodes, one after the other.

        Raises:
            MerlError: a file is missing, damaged, or does not fit the index.
        """
        for line in self.lines:
            yield self._read(line)

    def _read(self, line: Line) -> Episode:
        file = self.path / Path(line.file).name
        try:
            with open_file(file) as opened, np.load(opened, allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in arrays.files}
            observations = {key: found[KEY + key] for key in self.observation_space}
            actions, intended, rewards = found["action"], found["intended"], found["reward"]
            terminated, successes = bool(found["terminated"]), found.get("success")
        except Exception as error:  # of a damaged archive: of many types
            raise MerlError(
                f"{file} cannot be read: {in_one_line(error)}: record it again"
            ) from None
        episode = Episode(
            observations, actions, intended, rewards, terminated, line.success, successes
        )
        if len(episode) != line.steps:
            raise MerlError(f"{file} has {len(episode)} steps, and {INDEX} says {line.steps}")
        check_episode(str(file), episode, self.observation_space, self.action_space)
        return episode

    def digest(self) -> str:
        """Return the SHA-256 of the index and of all episodes."""
        digest = hashlib.sha256()
        for name in (INDEX, *(Path(line.file).name for line in self.lines)):
            with (
                reporting(f"{self.path / name} cannot be read"),
                open_file(self.path / name) as file,
            ):
                while part := file.read(1 << 20):
                    digest.update(part)
        return digest.hexdigest()

    def check_fits(self, observation_space: spaces.Dict, action_space: spaces.Box) -> None:
        """Check that an agent with these spaces can learn from the demonstrations.

        Raises:
            MerlError: a key is missing or has another shape or type, or the actions differ.
        """
        for key, space in observation_space.spaces.items():
            if key not in self.observation_space.spaces:
                have = ", ".join(self.observation_space.spaces)
                raise MerlError(
                    f"{self.path}: the demonstrations lack observation {key!r}, which the agent "
                    f"uses: they have {have}"
                )
            own, wanted = (told(describe(s)) for s in (self.observation_space[key], space))
            if own != wanted:
                raise MerlError(
                    f"{self.path}: observation {key!r} is {own} in the demonstrations and {wanted} "
                    "in the environment: record them with the same options"
                )
        if self.action_space.shape != action_space.shape:
            raise MerlError(
                f"{self.path}: an action has {counted(self.action_space.shape[0], 'number')} in "
                f"the demonstrations and {action_space.shape[0]} in the environment"
            )

    def load(
        self,
        config: ReplayConfig,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
    ) -> ReplayBuffer:
        """Return a replay buffer in memory that holds all episodes, with the given keys.

        The intended action of each step is stored as observation `merl.replay.mixing.INTENDED`.

        Args:
            config: how it is sampled.
            observation_space: the keys that the agent uses.
            action_space: the agent's actions.

        Raises:
            MerlError: they do not fit the spaces, are empty, or cannot be read.
        """
        self.check_fits(observation_space, action_space)
        if not self.steps:
            raise MerlError(f"{self.path} holds no episode")
        # A slot more for the start of each episode, which may be short.
        capacity = self.steps + len(self.lines)
        space = spaces.Dict({**observation_space.spaces, INTENDED: action_space})
        spec = ReplaySpec.of(config, space, action_space, capacity=capacity)
        replay = ReplayBuffer(spec)
        for episode in self.episodes():
            store(episode, replay, observation_space)
        return replay


def store(episode: Episode, replay: ReplayBuffer, space: spaces.Dict) -> None:
    """Write an episode, with the observation keys of `space`, into a replay buffer."""
    stored = {k: m.to_stored(episode.observations[k]) for k, m in modalities_of(space).items()}
    after = np.zeros_like(episode.intended[:1])  # there is no action after the last step
    stored[INTENDED] = np.concatenate([episode.intended, after])
    replay.begin({key: values[0] for key, values in stored.items()})
    for step in range(len(episode)):
        last = step == len(episode) - 1
        transition = Transition(
            episode.actions[step],
            float(episode.rewards[step]),
            0.0 if last and episode.terminated else 1.0,
            {key: values[step + 1] for key, values in stored.items()},
            last,
        )
        replay.add(transition)


def _line(values: Any) -> Line:
    """Return a line of the index.

    Raises:
        TypeError: a value has another type.
        ValueError: the return is not finite.
    """
    line = Line(**values)
    types = (line.file, str), (line.steps, int), (line.returned, int | float)
    if not all(isinstance(value, kind) for value, kind in types) or line.steps < 1:
        raise TypeError(f"the line {values}")
    if not math.isfinite(line.returned):
        raise ValueError(f"the line {values}")
    if not (line.success is None or isinstance(line.success, bool)):
        raise TypeError(f"the line {values}")
    return line
