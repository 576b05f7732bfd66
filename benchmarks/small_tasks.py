"""Small tasks with a known optimum: they show that an agent learns and which modalities it needs.

Each takes a few minutes on one core. `benchmarks/measure_small_tasks.py` runs them over seeds; the
tests require minimum returns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from merl.agents import AGENTS
from merl.config import EvaluationConfig, Source, TrainConfig
from merl.envs.config import EnvConfig
from merl.envs.user_env import make_user_env
from merl.evaluation.evaluation import EVALUATION_SEED, Evaluation
from merl.replay import ReplayConfig
from merl.training.trainer import Trainer

WHOLE, SPLIT, PENDULUM = "merl.envs.dot:whole", "merl.envs.dot:split", "Pendulum-v1"
Precision = Literal["fp32", "bf16"]


class Case(NamedTuple):
    """A task, an agent, and the number of steps that it trains."""

    task: str
    agent: str
    steps: int
    precision: Precision = "fp32"


CASES = (
    Case(WHOLE, "merl", 10_000),
    Case(WHOLE, "drqv2", 10_000),
    Case(SPLIT, "merl", 8000),
    Case(SPLIT, "merl", 8000, "bf16"),
    Case(SPLIT, "drqv2", 8000),
    Case(SPLIT, "proprio", 8000),
    Case(PENDULUM, "ddpg", 20_000),
    Case(PENDULUM, "sac", 20_000),
)
"""The cases of docs/explanation/small_tasks.md."""

_SMALL: dict[str, Any] = {"hidden_dim": 128}
_PENDULUM: dict[str, Any] = _SMALL | {"learning_rate": 1e-3}
_DOT: dict[str, Any] = _SMALL | {
    "learning_rate": 5e-4,
    "conv_channels": 16,
    "conv_strides": (2, 2, 1),
    "shift_pad": 1,
}
_DOT_DISCOUNT = 0.8
"""The mark is at most ten steps away; with a longer horizon the values only grow more slowly."""


def small_config(case: Case, *, seed: int, run_dir: Path, evaluations: int = 1) -> TrainConfig:
    """Return the config of a case, with `evaluations` evaluations during the run."""
    task, agent, steps, precision = case
    chosen = AGENTS[agent].config
    values, discount = (_PENDULUM, 0.99) if task == PENDULUM else (_DOT, _DOT_DISCOUNT)
    values = values | {"precision": precision}
    if agent == "drqv2":
        values |= {"noise_steps": steps // 2}
    return TrainConfig(
        task,
        agent_name=agent,
        seed=seed,
        steps=steps,
        run_dir=run_dir,
        device="cpu",
        threads=1,
        random_steps=1000,
        seed_steps=1000,
        save_every=1e6,
        env=EnvConfig(renderer="raster"),
        replay=ReplayConfig(batch_size=64, frame_stack=1, discount=discount),
        agent=dataclasses.replace(chosen, **values),
        eval=EvaluationConfig(every=steps // evaluations, episodes=20, video="none"),
    )


def learn(case: Case, *, seed: int, run_dir: Path, evaluations: int = 1) -> Evaluation:
    """Train, with evaluations of 20 episodes without noise; return the last evaluation."""
    config = small_config(case, seed=seed, run_dir=run_dir, evaluations=evaluations)
    with Trainer(config, source=Source("small")) as trainer:
        outcome = trainer.fit()
    assert outcome.evaluation is not None
    return outcome.evaluation


def returns_of(act: Callable[[Any], Any], task: str, episodes: int = 20) -> list[float]:
    """Return the return of each episode with actions `act(env)`, from the fixed start states."""
    env = make_user_env(task)
    returns = []
    for index in range(episodes):
        env.reset(seed=EVALUATION_SEED + index)
        total, over = 0.0, False
        while not over:
            _, reward, terminated, truncated, _ = env.step(act(env.unwrapped))
            total, over = total + float(reward), terminated or truncated
        returns.append(total)
    env.close()
    return returns


def optimum(task: str) -> float:
    """Return the mean return of moving straight to the mark."""
    return float(np.mean(returns_of(lambda env: env.best_action(), task)))
