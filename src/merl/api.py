"""Train and evaluate from Python.

Example:
    outcome = merl.train("reach_duplo", steps=100_000, **{"agent.noise_std": 0.3})
    print(merl.evaluate(outcome.run.path, episodes=50).success_end)
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from merl.config import Setting, TrainConfig, override
from merl.envs.config import RendererName
from merl.evaluation.evaluation import Evaluation
from merl.evaluation.policy import load_policy
from merl.experiments.presets import compose, default_preset
from merl.training.callbacks import Callback
from merl.training.trainer import Outcome, Trainer


def train(
    task: str | TrainConfig,
    *,
    preset: str | None = None,
    agent: str | type | None = None,
    setting: Setting = "matched",
    callbacks: Iterable[Callback] = (),
    **overrides: Any,
) -> Outcome:
    """Train a new run.

    Args:
        task: one of merl's tasks, a Gymnasium id, or `module:function`; or a whole config.
        preset: the values that others override (`merl.experiments.presets.PRESETS`); if not given,
            `paper` on a machine with CUDA, else `laptop`. Ignored if `task` is a config.
        agent: the agent's name, or your own class of agent (docs/howto/agent.md); if not given, the
            preset's. Ignored if `task` is a config.
        setting: `matched` (MERL's values) or `published` (those of the agent's authors). Ignored if
            `task` is a config.
        callbacks: called while it trains.
        overrides: values of `TrainConfig` by name, nested ones by their dotted name, as on the
            command line: `steps=1000, **{"agent.noise_std": 0.3}`. `run_dir` may be a string.

    Returns:
        The run's folder and config, its last evaluation, and how it ended.

    Raises:
        MerlError: a value cannot work; or see `Trainer.fit`.
    """
    if isinstance(agent, type):
        agent = f"{agent.__module__}:{agent.__qualname__}"
    if isinstance(task, str):
        config = compose(preset or default_preset(), task, agent, setting)
    else:
        config = task
    if overrides.get("run_dir") is not None:
        overrides["run_dir"] = Path(overrides["run_dir"])
    with Trainer(override(config, overrides), callbacks) as trainer:
        return trainer.fit()


def evaluate(
    run: Path | str,
    *,
    episodes: int = 10,
    checkpoint: str = "latest",
    video: Path | str | None = None,
    renderer: RendererName | None = None,
    max_episode_steps: int | None = None,
    trust: bool = False,
) -> Evaluation:
    """Run a trained policy without noise, from the evaluation's fixed starts.

    Args:
        run: the run's folder.
        episodes: number of episodes, at least 1.
        checkpoint: `latest`, `best` (by evaluation return), or a number of steps.
        video: record the first episode into this MP4 file.
        renderer: draws the images; if not given, the renderer of the training.
        max_episode_steps: cut an episode after this many steps; if not given, as in the run.
        trust: import the environment and the agent that the run names although it was not trained
            on this machine, which runs the code of whoever made the run.

    Raises:
        MerlError: the run cannot be loaded, or its code is not trusted.
    """
    policy = load_policy(run, checkpoint=checkpoint, trust=trust)
    return policy.evaluate(
        episodes=episodes,
        video=None if video is None else Path(video).absolute(),
        renderer=renderer,
        max_episode_steps=max_episode_steps,
        trust=trust,
    )
