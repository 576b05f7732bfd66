"""Time to sample a batch from the replay, raw and compressed, and the space that it needs.

A batch has 256 pairs of observations with three 84x84 images each, stacked and shifted, as bytes:
the input of the networks. The images show an arm that moves at random.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from rich.table import Table
from torch import Tensor

from merl.bench.measuring import Work, circumstances, seconds, shown, spread, take_turns
from merl.core import FrameTransforms, MerlError, Transition
from merl.core.resources import free_disk
from merl.envs import make_env
from merl.modalities import Image
from merl.networks.augmentation import RandomShift, draw_shifts
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec

EPISODE, PAD, MILLION = 250, 4, 1_000_000
RAW, COMPRESSED = "raw", "compressed (--replay.compress)"
STAGES = ("sample", "ready", "input")
BARS_MS = {RAW: 15.0, COMPRESSED: 35.0}
BARS_GB = {RAW: 22.0, COMPRESSED: 6.0}


def run(repeats: int = 15, steps: int = 10_000, batch_size: int = 256) -> dict[str, Any]:
    """Time a batch from a raw and from a compressed replay, on one thread.

    Args:
        repeats: number of rounds; in each round both replays give one batch.
        steps: steps that each replay holds; far more than fit into a processor cache.
        batch_size: B.

    Returns:
        Plain values, for raw and compressed: `sample_ms`; `ready_ms` (sampling and shifting);
        `input_ms` (sampling, shifting and the encoder's conversion to fp32, the input of the first
        convolution); `write_us`, for a step; each as `median`, `low` and `high`. Also
        `image_bytes`, the size of an image of this task; `gigabytes`, the space reserved for a
        million steps; and the values of `circumstances`.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _run(repeats, steps, batch_size)
    finally:
        torch.set_num_threads(threads)


def table(result: dict[str, Any]) -> Table:
    """Return the result of `run` as a table."""
    title = f"{result['batch_size']} pairs of 3 images 84x84 from {result['steps']:,} steps"
    rows = Table(title=f"{title}, one thread, median of {result['repeats']} (min to max)")
    for heading in ("", *BARS_MS):
        rows.add_column(heading, justify="right" if heading else "left")

    def add(name: str, key: str) -> None:
        rows.add_row(name, *(shown(result[key][side]) for side in BARS_MS))

    add("sample, ms", "sample_ms")
    add("sample and shift: ready for the networks, ms", "ready_ms")
    rows.add_row("    target", *(f"{bar:g}" for bar in BARS_MS.values()))
    add("the same, converted to fp32 as by the encoder, ms", "input_ms")
    add("write a step, us", "write_us")
    rows.add_row("an image, bytes", *(f"{result['image_bytes'][s]:,.0f}" for s in BARS_MS))
    rows.add_row(
        "space for a million steps, GB", *(f"{result['gigabytes'][s]:.3g}" for s in BARS_GB)
    )
    rows.add_row("    target", *(f"{bar:g}" for bar in BARS_GB.values()))
    return rows


def _run(repeats: int, steps: int, batch_size: int) -> dict[str, Any]:
    result: dict[str, Any] = {"repeats": repeats, "steps": steps, "batch_size": batch_size}
    result |= circumstances()
    space, actions, seen = _observations()
    specs = {}
    for side in BARS_MS:
        config = ReplayConfig(capacity=steps, batch_size=batch_size, compress=side == COMPRESSED)
        specs[side] = ReplaySpec.of(config, space, actions)
    million = {side: replace(specs[side], capacity=MILLION).bytes / 1e9 for side in BARS_GB}
    with tempfile.TemporaryDirectory() as folder:
        _check_room(Path(folder), sum(spec.bytes for spec in specs.values()))
        replays: dict[str, ReplayBuffer] = {}
        writing, sizes = {}, {}
        for side, spec in specs.items():
            directory = Path(folder) / str(len(replays))
            replays[side] = ReplayBuffer(spec, directory)
            writing[side] = _fill(replays[side], seen, actions, steps)
            sizes[side] = _mean_bytes(directory, space)
        taken = take_turns(
            {
                (stage, side): work
                for side, replay in replays.items()
                for stage, work in _stages(replay, batch_size).items()
            },
            repeats,
        )
    for stage in STAGES:
        result[f"{stage}_ms"] = {
            side: spread([1e3 * t for t in taken[stage, side]]) for side in BARS_MS
        }
    return result | {
        "write_us": {side: spread(times) for side, times in writing.items()},
        "image_bytes": sizes,
        "gigabytes": million,
    }


def _check_room(folder: Path, need: int) -> None:
    """Raise MerlError if `need` bytes do not fit into the folder for temporary files."""
    free = free_disk(folder)
    if need > free:
        raise MerlError(
            f"this bench takes {need / 1e9:.3g} GB in {folder.parent}, but {free / 1e9:.3g} GB are "
            "free: set TMPDIR to a larger folder"
        )


def _observations() -> tuple[spaces.Dict, spaces.Box, list[dict[str, Any]]]:
    """Return the spaces, and observations of some episodes with random actions."""
    env = make_env("reach_duplo", renderer="raster")
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, spaces.Dict)
    assert isinstance(actions, spaces.Box)
    seen = []
    for episode in range(8):
        observation, _ = env.reset(seed=episode)
        actions.seed(episode)
        for _ in range(5):
            action = actions.sample()
            for _ in range(10):
                seen.append(observation)
                observation, *_ = env.step(action)
    env.close()
    return space, actions, seen


def _fill(
    replay: ReplayBuffer, seen: list[dict[str, Any]], actions: spaces.Box, steps: int
) -> list[float]:
    """Write the observations repeatedly; return the microseconds per step of each episode."""
    action = actions.sample().astype(np.float32)
    taken: list[float] = []
    for begin in range(0, steps, EPISODE):
        replay.begin(seen[begin % len(seen)])

        def episode(begin: int = begin) -> None:
            for step in range(1, EPISODE + 1):
                observation = seen[(begin + step) % len(seen)]
                replay.add(Transition(action, 0.0, 1.0, observation, step == EPISODE))

        taken.append(1e6 * seconds(episode) / EPISODE)
    return taken


def _mean_bytes(directory: Path, space: spaces.Dict) -> float:
    """Return the mean size of an image in the replay folder, in bytes."""
    spans = list(directory.rglob("observation.image.span.bin"))
    if not spans:
        return float(np.prod(space["image"].shape or ()))
    lengths = np.fromfile(spans[0], "<i8").reshape(-1, 2)[:, 1]
    return float(lengths[lengths > 0].mean())


def _stages(replay: ReplayBuffer, batch_size: int) -> dict[str, Work]:
    """Return {stage: function that makes a batch up to this stage}, for each of `STAGES`."""
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)

    def sample(*copies: FrameTransforms) -> list[Tensor]:
        batch = replay.sample(batch_size, rng, *copies)
        return [batch.observation["image"], batch.next_observation["image"]]

    def ready() -> list[Tensor]:
        shifts = (draw_shifts(batch_size, PAD, generator) for _ in range(2))
        return sample(*({"image": RandomShift(each, PAD)} for each in shifts))

    image = Image(spaces.Box(0, 255, (84, 84, 3), np.uint8))

    def as_input() -> list[Tensor]:
        return [image.centred(stack, torch.float32) for stack in ready()]

    return dict(zip(STAGES, (sample, ready, as_input), strict=True))
