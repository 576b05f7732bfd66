"""How long an update of preset laptop takes with one value changed: python docs/measure_update.py.

Interleaved: each setting takes an update in turn; medians and the least, one thread, bf16.
"""

from __future__ import annotations

import dataclasses
import time
from statistics import median
from typing import Any

import gymnasium
import torch

from merl.agents import make_agent
from merl.envs import make_env
from merl.experiments.presets import compose
from merl.training.timing import random_batch

REPEATS = 30
J: dict[str, Any] = {"conv_strides": (3, 2, 1, 1), "hidden_dim": 256}
SETTINGS: dict[str, dict[str, Any]] = {
    "preset laptop": {},
    "width 256": {"hidden_dim": 256},
    "strides 3, 2, 1, 1": {"conv_strides": (3, 2, 1, 1)},
    "setting J": {**J},
    "J, strides 2, 2, 2, 1": {**J, "conv_strides": (2, 2, 2, 1)},
    "J, 16 channels": {**J, "conv_channels": 16},
    "J, batch 64": {**J, "batch_size": 64},
}


def main() -> None:
    """Measure and print."""
    torch.set_num_threads(1)
    env = make_env("reach_duplo", renderer="raster", image_size=48)
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, gymnasium.spaces.Dict)
    assert isinstance(actions, gymnasium.spaces.Box)
    prepared = {}
    for name, changes in SETTINGS.items():
        config = compose("laptop", "reach_duplo")
        size = {"batch_size": changes["batch_size"]} if "batch_size" in changes else {}
        replay = dataclasses.replace(config.replay, **size)
        others = {key: value for key, value in changes.items() if key != "batch_size"}
        agent = dataclasses.replace(config.agent, precision="bf16", **others)
        config = dataclasses.replace(config, replay=replay, agent=agent)
        learner = make_agent(
            agent, space, actions, frame_stack=3, seed=0, device=torch.device("cpu")
        )
        prepared[name] = learner, random_batch(config, space, actions)
    seconds: dict[str, list[float]] = {name: [] for name in prepared}
    for repeat in range(REPEATS + 2):
        for name, (learner, batch) in prepared.items():
            start = time.perf_counter()
            learner.update(batch)
            if repeat >= 2:
                seconds[name].append(time.perf_counter() - start)
    for name, taken in seconds.items():
        print(f"{name:35}{1000 * median(taken):6.1f} ms ({1000 * min(taken):.1f} at least)")
    env.close()


if __name__ == "__main__":
    main()
