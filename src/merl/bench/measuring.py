"""What every bench does alike: sides that take turns, medians with their spread, the machine."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Hashable, Mapping
from statistics import median
from typing import Any, TypeVar

import torch

import merl
from merl.core.resources import keep_freed_memory
from merl.runs.provenance import commit, machine, package_versions

Work = Callable[[], object]


Side = TypeVar("Side", bound=Hashable)


def take_turns(
    sides: Mapping[Side, Work], repeats: int, others: Collection[Side] = ()
) -> dict[Side, list[float]]:
    """Seconds of each side in each round.

    The sides take turns within one run, so that a machine that is busy for a while is busy for all
    of them. Each does its work once before it is timed: a turn finds the memory of its own last
    one, not that of the side before.

    Args:
        sides: work by name.
        repeats: how many rounds.
        others: sides that are not ours, which the C library treats as it does by itself; training
            asks it to keep freed memory.
    """
    taken: dict[Side, list[float]] = {side: [] for side in sides}
    try:
        for _ in range(repeats):
            for side, work in sides.items():
                keep_freed_memory(side not in others)
                work()
                taken[side].append(seconds(work))
    finally:
        keep_freed_memory(False)
    return taken


def seconds(work: Work, times: int = 1) -> float:
    """Of doing it so many times."""
    start = time.perf_counter()
    for _ in range(times):
        work()
    return time.perf_counter() - start


def spread(values: list[float]) -> dict[str, float]:
    """Median, least and most."""
    return {"median": median(values), "low": min(values), "high": max(values)}


def shown(spread: dict[str, float]) -> str:
    """The median and, in brackets, from where to where."""
    middle, low, high = (
        f"{spread[key]:,.0f}" if spread[key] >= 100 else f"{spread[key]:.3g}"
        for key in ("median", "low", "high")
    )
    return f"{middle} ({low} to {high})"


def circumstances() -> dict[str, Any]:
    """Under which a figure was measured."""
    return {
        "merl": merl.__version__,
        "commit": commit(),
        "machine": machine(),
        "versions": package_versions("stable-baselines3"),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
    }
