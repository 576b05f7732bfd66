"""The places of a run's actors: each has a ring of the replay."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from merl.core import MerlError, counted
from merl.core.files import read_json, replace_file, reporting
from merl.link.protocol import Channel
from merl.runs.run_folder import ACTORS_FILE


@dataclass
class Place:
    """One actor's ring of the replay.

    Attributes:
        received: number of the newest timestep that arrived.
        saved: number of the newest timestep in a checkpoint.
        channel: the actor's newest connection.
        session: held by the thread that serves it.
    """

    received: int = 0
    saved: int = 0
    channel: Channel | None = None
    session: threading.Lock = field(default_factory=threading.Lock)


def place_of(actor: str, run: Path, count: int) -> int:
    """Return the place of an actor; a new one takes a free place.

    Raises:
        MerlError: all places are taken by others, or their list is damaged or cannot be read or
            written.
    """
    file = run / ACTORS_FILE
    names = _names(file, count)
    if actor in names:
        return names.index(actor)
    if None not in names:
        if len(names) >= count:
            raise MerlError(
                f"all places of the run are taken (--num-envs {count}): start the actor with the "
                f"--spool that it had; if that is lost, write null for it in {file}"
            )
        names.append(None)
    place = names.index(None)
    names[place] = actor
    with reporting(f"{file} cannot be written"):
        replace_file(file, json.dumps(names).encode())
    return place


def _names(file: Path, most: int) -> list[Any]:
    """Return the actor of each place that was taken; None if it is free again."""
    try:
        with reporting(f"{file} cannot be read"):
            names = read_json(file) if file.exists() else []
        if not isinstance(names, list) or len(names) > most:
            raise TypeError(f"it is no list of at most {counted(most, 'actor')}")
    except (ValueError, TypeError) as error:
        raise MerlError(
            f"{file} is damaged ({error}): restore it from a copy, or write a list with null for "
            "each actor"
        ) from None
    return names
