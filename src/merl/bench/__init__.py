"""Benches: the speed of merl's parts compared with references."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich.console import RenderableType

from merl.bench import env, replay, train, update

BENCHES: dict[str, tuple[Callable[..., dict[str, Any]], Callable[[Any], RenderableType]]] = {
    "update": (update.run, update.table),
    "env": (env.run, env.table),
    "replay": (replay.run, replay.table),
    "train": (train.run, train.table),
}
"""{name: (function that measures, function that makes a table of the result)}."""
