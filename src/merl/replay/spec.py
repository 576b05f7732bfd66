"""What the replay stores of each timestep, made once from the spaces of an environment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any
from urllib.parse import quote

import gymnasium
import numpy as np

from merl.core import MerlError
from merl.modalities import modality_of
from merl.replay.config import ReplayConfig

SLOTS_OF_ANY_FRAME = 5
"""Slots whose reserved bytes can hold an incompressible frame, which LZ4 enlarges by 1/255."""


@dataclass(frozen=True)
class Field:
    """Type and shape of one entry of an array.

    Attributes:
        dtype: type, little-endian.
        shape: shape of an entry.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def bytes(self) -> int:
        """Bytes of an entry."""
        return self.dtype.itemsize * math.prod(self.shape)

    def check(self, name: str, value: Any) -> None:
        """Raise MerlError if the value has another shape or type; any float type is a float."""
        if value is None:
            raise MerlError(
                f"{name} is missing: return it with each observation, as its space says"
            )
        value = np.asarray(value)
        fits = value.dtype == self.dtype or value.dtype.kind == self.dtype.kind == "f"
        if value.shape != self.shape or not fits:
            raise MerlError(
                f"{name} is {value.dtype} {value.shape}, but its space says {self.dtype} "
                f"{self.shape}: correct the output of the environment or the agent"
            )


@dataclass(frozen=True)
class KeySpec(Field):
    """How one observation key is stored.

    Attributes:
        stacked: a sample holds the last K frames, (B, K, *shape); else the newest value alone,
            (B, *shape).
        compressible: whether `--replay.compress` applies; only for stacked integers.
    """

    stacked: bool = False
    compressible: bool = False

    def __post_init__(self) -> None:
        if self.compressible and not (self.stacked and self.dtype.kind in "iu"):
            raise ValueError(f"{self} cannot be compressed: only stacked integers can")


def key_spec(key: str, space: gymnasium.Space[Any]) -> KeySpec:
    """Return how a key is stored.

    Raises:
        MerlError: the space has no modality.
    """
    modality = modality_of(space)
    if modality is None:
        raise MerlError(
            f"observation {key!r} is {space}: replay stores the kinds of merl.modalities; convert "
            "the key in a wrapper, or remove it"
        )
    stacked = modality.stacked
    return KeySpec(modality.stored, modality.shape, stacked=stacked, compressible=stacked)


@dataclass(frozen=True)
class ReplaySpec:
    """What the replay stores, and its size.

    Attributes:
        config: contents of the replay and how it is sampled.
        keys: how each observation key is stored.
        action_shape: shape of an action.
        capacity: maximum number of steps in all rings together.
        rings: number of rings, one for each environment.
    """

    config: ReplayConfig
    keys: Mapping[str, KeySpec]
    action_shape: tuple[int, ...]
    capacity: int
    rings: int = 1

    @classmethod
    def of(
        cls,
        config: ReplayConfig,
        observation_space: gymnasium.spaces.Dict,
        action_space: gymnasium.spaces.Box,
        *,
        capacity: int | None = None,
        rings: int = 1,
    ) -> ReplaySpec:
        """Return the spec for the spaces of an environment.

        Args:
            config: contents of the replay and how it is sampled.
            observation_space: the keys to store, each of a kind in `merl.modalities`.
            action_space: a vector.
            capacity: maximum number of steps, instead of the config's.
            rings: number of environments.

        Raises:
            MerlError: a space cannot be stored.
        """
        keys = {key: key_spec(key, space) for key, space in observation_space.spaces.items()}
        if len(action_space.shape) != 1 or not math.prod(action_space.shape):
            raise MerlError(f"the action space is {action_space}: use a vector, Box(n)")
        whole = config.capacity if capacity is None else capacity
        return cls(config, keys, action_space.shape, whole, rings)

    @cached_property
    def compressed(self) -> tuple[str, ...]:
        """The keys that are stored compressed."""
        compress = self.config.compress
        return tuple(key for key, spec in self.keys.items() if compress and spec.compressible)

    @cached_property
    def fields(self) -> Mapping[str, Field]:
        """The arrays by name; an array has one entry for each timestep.

        A compressed key has two: its frames one after the other, for which each timestep reserves
        some bytes, and for each timestep the first byte of its frame and the number of bytes.
        """
        fields: dict[str, Field] = {field_name(key): spec for key, spec in self.keys.items()}
        for key in self.compressed:
            fields[field_name(key)] = Field(np.dtype("u1"), (reserved_bytes(self.keys[key]),))
            fields[span_name(key)] = Field(np.dtype("<i8"), (2,))
        number = np.dtype("<f4")
        return fields | {
            "action": Field(number, self.action_shape),
            "reward": Field(number, ()),
            "discount": Field(number, ()),
            "position": Field(np.dtype("<i4"), ()),  # of the timestep in its episode
            "timestep": Field(np.dtype("<i8"), ()),  # its number; 0: an empty slot
        }

    @property
    def ring_capacity(self) -> int:
        """Maximum number of steps in each ring."""
        return math.ceil(self.capacity / self.rings)

    @property
    def slots(self) -> int:
        """Number of slots of a ring, each for one timestep.

        They hold the capacity in episodes of at least 200 steps: an episode has one timestep more
        than steps, and the oldest step needs its whole stack. Shorter episodes fill the slots
        before the capacity is reached. There is always room for one step and the start of the next
        episode, even with incompressible frames.
        """
        least = self.config.frame_stack + 2
        if self.config.compress:
            least = SLOTS_OF_ANY_FRAME * (least + 1)  # no frame crosses the end of the bytes
        capacity = self.ring_capacity
        return max(capacity + capacity // 200 + self.config.frame_stack, least)

    @property
    def bytes(self) -> int:
        """Bytes that the replay takes, on disk or in memory."""
        return self.rings * self.slots * sum(field.bytes for field in self.fields.values())


@cache
def field_name(key: str) -> str:
    """Return the field of an observation key; also a file name, so a slash is quoted."""
    return f"observation.{quote(key, safe='')}"


def span_name(key: str) -> str:
    """Return the field with the positions of a key's compressed frames."""
    return f"{field_name(key)}.span"


def reserved_bytes(field: Field) -> int:
    """Return the bytes that are reserved for a compressed frame, on average.

    A quarter: the arm's images at 84x84 take 3.6 KB with `raster` and 3.5 KB with `gl`, of 21.2 KB.
    Smaller images compress less: at 24x24 they take a third, so that the ring holds fewer steps.
    """
    return field.bytes // 4 + 64
