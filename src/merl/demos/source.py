"""Recorded episodes in the format of another project, as merl reads them before conversion."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Feature:
    """One observation of a source.

    Attributes:
        shape: shape at one timestep; of an image (H, W, C).
        dtype: name of its NumPy type.
        image: whether it is an image.
        lossy: whether its frames were compressed with loss.
    """

    shape: tuple[int, ...]
    dtype: str
    image: bool = False
    lossy: bool = False

    def __str__(self) -> str:
        """Return type and shape."""
        return f"{self.dtype} {self.shape}"


@dataclass(frozen=True)
class RawEpisode:
    """An episode of a source.

    Attributes:
        name: its name in the source, for messages.
        observations: {feature: (T, ...) or (T + 1, ...)}; T + 1 if the source holds the observation
            after the last action.
        actions: (T, A), in the source's own units.
        intended: the actions without noise, in the same form; None if the source has none.
        rewards: (T,); None if the source has none.
        terminated: whether it ended by termination; None if the source does not say.
        success: whether it was solved at its end; None if the source does not say.
        successes: whether it was solved after each step, (T,); None if the source does not say.
    """

    name: str
    observations: Mapping[str, NDArray[Any]]
    actions: NDArray[Any]
    intended: NDArray[Any] | None = None
    rewards: NDArray[Any] | None = None
    terminated: bool | None = None
    success: bool | None = None
    successes: NDArray[Any] | None = None


def at_each_step(flags: NDArray[np.bool_], *, terminated: bool) -> NDArray[np.bool_] | None:
    """Return whether an episode was solved after each step; None if the flags tell only its end.

    Many sources set the flag at the last step alone, however long the task has been solved before.

    Args:
        flags: the source's flag at each step, (T,).
        terminated: whether the episode ended by termination.
    """
    only_last = bool(flags[-1]) and len(flags) > 1 and not flags[:-1].any()
    return None if only_last and not terminated else flags


class Source(Protocol):
    """A folder or file in the format of another project.

    Attributes:
        path: the folder or file.
        format: name of the format.
        features: its observations.
        action_size: A.
        rate: timesteps in a second; None if it is not known.
        count: number of its episodes.
    """

    path: Path
    format: str
    features: Mapping[str, Feature]
    action_size: int
    rate: float | None
    count: int

    def episodes(self, keys: tuple[str, ...]) -> Iterator[RawEpisode]:
        """Read the episodes with these features.

        Raises:
            MerlError: a file is missing or damaged.
        """
        ...
