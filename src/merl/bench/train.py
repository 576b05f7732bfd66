"""The whole loop: acting, replay and updates, one after another or at the same time.

Every way to run it is a loop of its own with its own agent and replay; they take turns of some
steps each. What counts is the ratio to the strict loop within a round.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

import torch
from rich.table import Table

from merl.acting.environments import Environments, InProcessEnvs, WorkerEnvs
from merl.acting.rollout import FrameStack
from merl.acting.run_env import make_run_env, run_spaces
from merl.agents import make_agent
from merl.bench.measuring import Side, circumstances, shown, spread
from merl.config import TrainConfig
from merl.core import counted, is_image
from merl.core.resources import keep_freed_memory
from merl.experiments.presets import compose
from merl.replay import ReplayBuffer
from merl.training.loop import Collector, Progress, Randomness, train
from merl.training.setup import choose_device
from merl.training.timing import measure, use_threads
from merl.training.updating import make_update

STRICT = "strict: one environment, in turn with the learner"
WARM_UP = 100
"""Steps of every side before its first update."""
CAPACITY = 10_000
"""Steps that a replay keeps."""


def run(
    repeats: int = 5,
    steps: int | None = None,
    task: str = "reach_duplo",
    preset: str | None = None,
) -> dict[str, Any]:
    """Time the loop, with updates from the start; on a GPU where there is one.

    Args:
        repeats: how many rounds, in each of which every side has its turn.
        steps: environment steps of a turn; if not set, 400, on a GPU 2000.
        task: what is trained on.
        preset: whose values; if not set, laptop's, on a GPU paper's.

    Returns:
        Plain values: `steps_per_s` by side and `ratio` to the strict loop, each as `median`, `low`
        and `high` over the rounds; `precision`, `threads` and `updates_per_step`.
    """
    on_gpu = torch.cuda.is_available()
    steps = steps or (2000 if on_gpu else 400)
    preset = preset or ("paper" if on_gpu else "laptop")
    result: dict[str, Any] = {"repeats": repeats, "steps": steps, "task": task, "preset": preset}
    result |= circumstances()
    rates, config = steps_per_second(_sides(), task, preset, repeats, steps)
    result |= {
        "precision": config.agent.precision,
        "compiled": config.agent.torch_compile == "yes",
        "threads": config.threads,
        "updates_per_step": config.updates_per_step,
    }
    result["steps_per_s"] = {side: spread(values) for side, values in rates.items()}
    result["ratio"] = {
        side: spread([a / b for a, b in zip(values, rates[STRICT], strict=True)])
        for side, values in rates.items()
    }
    return result


def steps_per_second(
    sides: Mapping[Side, Mapping[str, Any]], task: str, preset: str, repeats: int, steps: int
) -> tuple[dict[Side, list[float]], TrainConfig]:
    """The rate of the loop in each round, and with which values it was run.

    Args:
        sides: by name, the fields of `TrainConfig` in which a way to run it differs.
        task: what is trained on.
        preset: whose values.
        repeats: how many rounds, in each of which every side has its turn.
        steps: environment steps of a turn.
    """
    config = dataclasses.replace(compose(preset, task), random_steps=WARM_UP, seed_steps=WARM_UP)
    with ExitStack() as stack:
        env = make_run_env(config)
        stack.callback(env.close)
        space, _ = run_spaces(config, env)
        best = measure(config, env, env, space, choose_device(config.device)).best
        agent = best.decided(config.agent)
        config = dataclasses.replace(config, agent=agent, threads=best.threads)
        use_threads(best.threads)
        keep_freed_memory()
        stack.callback(keep_freed_memory, False)
        loops = {
            side: _Loop(dataclasses.replace(config, **asked), stack)
            for side, asked in sides.items()
        }
        for loop in loops.values():
            loop.rate(WARM_UP + steps)
        rates: dict[Side, list[float]] = {side: [] for side in loops}
        for _ in range(repeats):
            for side, loop in loops.items():
                rates[side].append(loop.rate(steps))
    return rates, config


def table(result: dict[str, Any]) -> Table:
    """What `run` returned, for people."""
    rows = Table(
        title=f"{result['task']}, preset {result['preset']}, "
        f"{counted(result['updates_per_step'], 'update')} a step in "
        f"{result['precision']} on {counted(result['threads'], 'thread')}, "
        f"median of {result['repeats']} (least to most)"
    )
    for heading in ("", "steps/s", "to the strict loop"):
        rows.add_column(heading, justify="right" if heading else "left")
    for side, rate in result["steps_per_s"].items():
        rows.add_row(side, shown(rate), shown(result["ratio"][side]))
    return rows


def _sides() -> dict[str, dict[str, Any]]:
    """The ways to run the loop, by what they are called."""
    several = max(4, len(os.sched_getaffinity(0)) - 1)
    return {
        STRICT: {"synchronous": True, "num_envs": 1},
        "one environment, beside the learner": {"synchronous": False, "num_envs": 1},
        f"{several} environments, beside the learner": {
            "synchronous": False,
            "num_envs": several,
        },
    }


class _Loop:
    """One way to run it, that can be stopped and gone on with at every step."""

    def __init__(self, config: TrainConfig, stack: ExitStack) -> None:
        env = make_run_env(config)
        stack.callback(env.close)
        space, actions = run_spaces(config, env)
        environments: Environments = (
            WorkerEnvs(config, env) if config.has_workers else InProcessEnvs(env)
        )
        stack.callback(environments.close)
        device, frames = choose_device(config.device), config.replay.frame_stack
        images = tuple(key for key in space if is_image(space[key]))
        count = environments.count
        replay = ReplayBuffer(config.replay, space, actions, count=count, capacity=CAPACITY)
        stacks = [FrameStack(frames, images, device) for _ in range(count)]
        agent = make_agent(config.agent, space, actions, frame_stack=frames, seed=0, device=device)
        self._progress = Progress()
        collector = Collector(environments, replay, stacks)
        randomness = Randomness(config.seed)
        update = make_update(agent, replay, randomness, config, lambda _: None)
        self._moments = train(collector, agent, update, self._progress, randomness, config)

    def rate(self, steps: int) -> float:
        """Go on by so many steps, or a few more; returns steps per second."""
        first, begun = self._progress.step, time.perf_counter()
        while self._progress.step < first + steps:
            next(self._moments)
        return (self._progress.step - first) / (time.perf_counter() - begun)
