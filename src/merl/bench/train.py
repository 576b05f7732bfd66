"""Speed of the whole training loop: acting, replay and updates, in turns or at the same time.

Each variant is a separate loop with its own agent and replay; the variants take turns of some steps
each. The result is the ratio to the strict loop within a round.
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

from merl.accelerate.speed_up import speed_up
from merl.acting.environments import Environments, InProcessEnvs
from merl.acting.rollout import FrameStack
from merl.acting.run_env import make_run_env, recipe, run_spaces, run_spec
from merl.acting.workers import WorkerEnvs
from merl.agents import make_agent
from merl.agents.config import AgentConfig
from merl.bench.measuring import Side, circumstances, shown, spread
from merl.config import TrainConfig
from merl.core import counted
from merl.core.resources import keep_freed_memory
from merl.experiments.presets import compose
from merl.replay import ReplayBuffer, ReplaySpec
from merl.training.loop import Collector, Progress, Randomness, train
from merl.training.setup import choose_device
from merl.training.timing import measure
from merl.training.updating import make_update

STRICT = "strict: one environment, in turn with the learner"
WARM_UP = 100
"""Steps of each variant before its first update."""
CAPACITY = 10_000
"""Steps that each replay holds."""


def run(
    repeats: int = 5,
    steps: int | None = None,
    task: str = "reach_duplo",
    preset: str | None = None,
) -> dict[str, Any]:
    """Time the training loop, on a GPU if there is one; every turn includes updates.

    Args:
        repeats: number of rounds; in each round every variant has one turn.
        steps: environment steps in a turn; by default 400, on a GPU 2000.
        task: the task to train on.
        preset: the preset of the values; by default laptop, on a GPU paper.

    Returns:
        Plain values: `steps_per_s` by variant and `ratio` to the strict loop, each as `median`,
        `low` and `high` over the rounds; `precision`, `threads` and `updates_per_step`.
    """
    on_gpu = torch.cuda.is_available()
    steps = steps or (2000 if on_gpu else 400)
    preset = preset or ("paper" if on_gpu else "laptop")
    result: dict[str, Any] = {"repeats": repeats, "steps": steps, "task": task, "preset": preset}
    result |= circumstances()
    several = max(4, compose(preset, task).num_envs, len(os.sched_getaffinity(0)) - 1)
    rates, config = steps_per_second(_sides(several), task, preset, repeats, steps)
    assert isinstance(config.agent, AgentConfig)
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
    """Return the steps per second of each variant in each round, and the config of the loop.

    Args:
        sides: {name of a variant: the fields of `TrainConfig` in which it differs}.
        task: the task to train on.
        preset: the preset of the values.
        repeats: number of rounds; in each round every variant has one turn.
        steps: environment steps in a turn.
    """
    config = dataclasses.replace(compose(preset, task), random_steps=WARM_UP, seed_steps=WARM_UP)
    with ExitStack() as stack:
        env = make_run_env(config)
        stack.callback(env.close)
        space, _ = run_spaces(config, env)
        best = measure(config, env, env, space, choose_device(config.device)).best
        agent = best.decided(config.agent)
        config = dataclasses.replace(config, agent=agent, threads=best.threads)
        torch.set_num_threads(best.threads)
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
    """Return the result of `run` as a table."""
    rows = Table(
        title=f"{result['task']}, preset {result['preset']}, "
        f"{counted(result['updates_per_step'], 'update')} per step in "
        f"{result['precision']} on {counted(result['threads'], 'thread')}, "
        f"median of {result['repeats']} (min to max)"
    )
    for heading in ("", "steps/s", "ratio to the strict loop"):
        rows.add_column(heading, justify="right" if heading else "left")
    for side, rate in result["steps_per_s"].items():
        rows.add_row(side, shown(rate), shown(result["ratio"][side]))
    return rows


def _sides(several: int) -> dict[str, dict[str, Any]]:
    """Return {name of a variant: its fields of `TrainConfig`}, up to several environments."""
    return {
        STRICT: {"synchronous": True, "num_envs": 1},
        "one environment, beside the learner": {"synchronous": False, "num_envs": 1},
        f"{several} environments, beside the learner": {
            "synchronous": False,
            "num_envs": several,
        },
    }


class _Loop:
    """A training loop that can be run for some steps at a time."""

    def __init__(self, config: TrainConfig, stack: ExitStack) -> None:
        env = make_run_env(config)
        stack.callback(env.close)
        space, actions = run_spaces(config, env)
        environments: Environments = (
            WorkerEnvs(recipe(config), env, config.num_envs, config.worker_timeout)
            if config.has_workers
            else InProcessEnvs(env)
        )
        stack.callback(environments.close)
        device, frames = choose_device(config.device), config.replay.frame_stack
        count = environments.count
        spec = ReplaySpec.of(config.replay, space, actions, capacity=CAPACITY, rings=count)
        replay = ReplayBuffer(spec)
        modalities = run_spec(config, env).modalities
        stacks = [FrameStack(modalities, frames, device) for _ in range(count)]
        agent = make_agent(
            config.agent_name,
            config.agent,
            space,
            actions,
            frame_stack=frames,
            seed=0,
            device=device,
        )
        speed_up(agent)
        self._progress = Progress()
        collector = Collector(environments, replay, stacks)
        randomness = Randomness(config.seed)
        update = make_update(agent, replay, randomness, config, device, lambda _: None)
        self._results = train(collector, agent, update, self._progress, randomness, config)

    def rate(self, steps: int) -> float:
        """Run at least `steps` further steps; return the steps per second."""
        first, start = self._progress.step, time.perf_counter()
        while self._progress.step < first + steps:
            next(self._results)
        return (self._progress.step - first) / (time.perf_counter() - start)
