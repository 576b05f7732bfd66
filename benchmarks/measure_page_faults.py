"""Measure the time that an update saves by keeping freed memory; one thread, bf16.

    python benchmarks/measure_page_faults.py

An update with glibc's defaults and one with `keep_freed_memory` take turns. The times are processor
time, which excludes other load on the machine.
"""

from __future__ import annotations

import resource
import time
from functools import partial
from statistics import median

import torch
from gymnasium import spaces

from merl.agents import make_agent
from merl.bench.measuring import Work
from merl.bench.update import as_sample, noise_batch, reference
from merl.config import override
from merl.core.resources import keep_freed_memory
from merl.envs import make_env
from merl.experiments.presets import compose
from merl.training.timing import random_batch

ROUNDS, UPDATES = 6, 3


def main() -> None:
    """Measure the update of two presets and of the reference."""
    torch.set_num_threads(1)
    for preset, task, size in (("laptop", "reach_duplo", 48), ("paper", "move_box", 84)):
        env = make_env(task, renderer="raster", image_size=size)
        space, actions = env.observation_space, env.action_space
        assert isinstance(space, spaces.Dict)
        assert isinstance(actions, spaces.Box)
        config = compose(preset, task)
        config = override(config, {"agent.precision": "bf16"})
        agent = make_agent(
            config.agent_name,
            config.agent,
            space,
            actions,
            frame_stack=3,
            seed=0,
            device=torch.device("cpu"),
        )
        batch = random_batch(config, space, actions)
        compare(preset, partial(agent.update, batch, step=0))
        env.close()
    compare("the reference", partial(reference().update, as_sample(noise_batch(256))))


def compare(name: str, update: Work) -> None:
    """Time updates with freed memory given back to the system, and kept; print medians."""
    taken: dict[bool, list[tuple[float, int]]] = {False: [], True: []}
    for _ in range(ROUNDS):
        for keep, results in taken.items():
            keep_freed_memory(keep)
            update()
            for _ in range(UPDATES):
                faults, start = _faults(), time.process_time()
                update()
                results.append((time.process_time() - start, _faults() - faults))
    for keep, results in taken.items():
        seconds, faults = (median(values) for values in zip(*results, strict=True))
        how = "kept" if keep else "given back"
        print(f"{name:14}{how:12}{1e3 * seconds:8.1f} ms{faults:10,.0f} page faults")


def _faults() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt


if __name__ == "__main__":
    main()
