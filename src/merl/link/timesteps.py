"""Timesteps as bytes of a fixed size, the same on the wire and in an actor's file."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.acting.rollout import Episode
from merl.core import Observation, Transition
from merl.replay.spec import field_name, key_spec

QUEUE_BYTES = 2**26
"""Bytes of timesteps of an actor that a learner holds before they are in its replay."""
_UNKNOWN = -1
"""Success of an episode that has not reported it."""


@dataclass(frozen=True)
class Timestep:
    """One timestep of an actor.

    Attributes:
        number: 1, 2, 3, ...: number of the timestep in the actor's ring.
        observation: the observation, as stored.
        transition: the step that led to it; None for the first timestep of an episode.
        episode: sums of the episode so far, without the reward terms.
    """

    number: int
    observation: Observation
    transition: Transition | None
    episode: Episode


class Layout:
    """Form of a timestep as bytes.

    Args:
        space: the observation keys of the run.
        action_space: its actions.

    Attributes:
        size: bytes of a timestep.
        window: largest number of timesteps that may be under way to the replay.
    """

    def __init__(self, space: spaces.Dict, action_space: spaces.Box) -> None:
        self._fields = {key: field_name(key) for key in space.spaces}
        stored = [key_spec(key, part) for key, part in space.spaces.items()]
        fields: list[Any] = [
            ("number", "<i8"),
            ("first", "?"),
            ("last", "?"),
            ("reward", "<f4"),
            ("discount", "<f4"),
            ("return", "<f8"),
            ("length", "<i8"),
            ("success", "<i1"),
            ("reports", "<i8"),
            ("successes", "<i8"),
            ("action", "<f4", action_space.shape),
            *(
                (name, spec.dtype, spec.shape)
                for name, spec in zip(self._fields.values(), stored, strict=True)
            ),
            ("check", "<u4"),
        ]
        self._type = np.dtype(fields)
        self.size = self._type.itemsize
        self.window = min(256, max(8, QUEUE_BYTES // self.size))

    def pack(self, timestep: Timestep) -> bytes:
        """Return a timestep as bytes, with a checksum."""
        row = np.zeros((), self._type)
        step, episode = timestep.transition, timestep.episode
        row["number"], row["first"] = timestep.number, step is None
        for key, name in self._fields.items():
            row[name] = timestep.observation[key]
        if step is not None:
            row["action"], row["reward"], row["discount"] = step.action, step.reward, step.discount
            row["last"] = step.last
        row["return"], row["length"] = episode.total_reward, episode.length
        row["success"] = _UNKNOWN if episode.success is None else episode.success
        row["reports"], row["successes"] = episode.reports, episode.successes
        row["check"] = zlib.crc32(row.tobytes()[: -row["check"].nbytes])
        return row.tobytes()

    def number(self, data: bytes | memoryview) -> int | None:
        """Return the number of a timestep; None if the bytes are not intact."""
        if len(data) != self.size:
            return None
        (row,) = np.frombuffer(data, self._type)
        intact = int(row["check"]) == zlib.crc32(data[: -row["check"].nbytes])
        return int(row["number"]) if intact else None

    def unpack(self, data: bytes | memoryview) -> Timestep:
        """Restore a timestep from intact bytes; its arrays are views of them."""
        (row,) = np.frombuffer(data, self._type)
        observation: dict[str, NDArray[Any]] = {
            key: row[name] for key, name in self._fields.items()
        }
        step = None
        if not row["first"]:
            reward, discount = float(row["reward"]), float(row["discount"])
            step = Transition(row["action"], reward, discount, observation, bool(row["last"]))
        success = None if row["success"] == _UNKNOWN else bool(row["success"])
        sums = float(row["return"]), int(row["length"]), success
        episode = Episode(*sums, int(row["reports"]), int(row["successes"]))
        return Timestep(int(row["number"]), observation, step, episode)
