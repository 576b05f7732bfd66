"""Shared parts of the benches: turns, medians with their range, facts about the machine."""

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
    """Time variants ("sides") in turns; return the seconds of each side in each round.

    The sides take turns within one run, so that other load on the machine affects all of them.
    Each side does its work once before it is timed, so that a turn reuses memory of its own side,
    not of the previous one.

    Args:
        sides: {name: work}.
        repeats: number of rounds.
        others: sides that run with the default memory settings of the C library; the rest keeps
            freed memory, as training does.
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
    """Return the seconds that `times` calls of `work` take."""
    start = time.perf_counter()
    for _ in range(times):
        work()
    return time.perf_counter() - start


def spread(values: list[float]) -> dict[str, float]:
    """Return median, minimum and maximum."""
    return {"median": median(values), "low": min(values), "high": max(values)}


def shown(spread: dict[str, float]) -> str:
    """Format a median and its range: "12.3 (11 to 14)"."""
    middle, low, high = (
        f"{spread[key]:,.0f}" if spread[key] >= 100 else f"{spread[key]:.3g}"
        for key in ("median", "low", "high")
    )
    return f"{middle} ({low} to {high})"


def circumstances() -> dict[str, Any]:
    """Return versions, commit, machine, threads and load of a measurement."""
    return {
        "merl": merl.__version__,
        "commit": commit(),
        "machine": machine(),
        "versions": package_versions("stable-baselines3"),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
    }
