"""Train, resume and evaluate from Python; docs/howto/python.md has examples.

Example:
    outcome = merl.train("reach_duplo", steps=100_000, **{"agent.noise_std": 0.3})
    print(merl.evaluate(outcome.run.path, episodes=50).success_end)
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from merl.callbacks import Callback
from merl.config import CUSTOM, Device, Setting, Source, TrainConfig, override
from merl.core import MerlError
from merl.envs.user_env import MakeEnv, task_of
from merl.evaluation.evaluation import Evaluation
from merl.evaluation.policy import load_policy
from merl.experiments.cloning_first import clone_first
from merl.experiments.presets import compose, default_preset
from merl.rendering.config import RendererName
from merl.runs.resume import resume_request
from merl.runs.run import Run
from merl.training.live_view import LiveView
from merl.training.outcome import Outcome
from merl.training.resuming import resumption
from merl.training.trainer import Trainer


def train(
    task: str | TrainConfig | MakeEnv | None = None,
    *,
    env: MakeEnv | None = None,
    preset: str | None = None,
    agent: str | type | None = None,
    setting: Setting = "matched",
    callbacks: Iterable[Callback] = (),
    progress: bool = True,
    **overrides: Any,
) -> Outcome:
    """Train a new run.

    Ctrl-C, or the interrupt of a notebook's kernel, stops training: the run is saved, and the
    outcome is returned. One run at a time can be trained in a process.

    Args:
        task: one of merl's tasks, a Gymnasium id, or `module:function`; or a whole config; or a
            function that makes an environment.
        env: a function that makes an environment, without arguments or with `render_mode`, e.g.
            `lambda: gymnasium.make("Pendulum-v1")`. It is called once for training and once for
            evaluation. The run does not record a lambda, or a function of a notebook: give it to
            `resume` and `evaluate` again.
        preset: the values that others override (`merl.experiments.presets.PRESETS`); if not given,
            `paper` on a machine with CUDA, else `laptop`. Ignored if `task` is a config.
        agent: the agent's name, or your own class of agent (docs/howto/agent.md); if not given, the
            preset's. Ignored if `task` is a config.
        setting: `matched` (MERL's values) or `published` (those of the agent's authors). Ignored if
            `task` is a config.
        callbacks: called while it trains; not while `demos_pretrain` clones before.
        progress: whether to show a progress bar, in a terminal or a notebook; in other output,
            lines.
        overrides: values of `TrainConfig` by name, nested ones by their dotted name, as on the
            command line: `steps=1000, **{"agent.noise_std": 0.3}`. `run_dir` may be a string.

    Returns:
        The run's folder and config, its last evaluation, and how it ended.

    Raises:
        MerlError: a value cannot work; or see `Trainer.fit`.
    """
    if not isinstance(task, str | TrainConfig):
        task, env = None, env or task
    if (task is None) == (env is None) and not isinstance(task, TrainConfig):
        raise MerlError("train needs one of task and env: the name of a task, or a function")
    make = None
    if env is not None:
        name, make = task_of(env)
        overrides["task"] = name
    if isinstance(agent, type):
        agent = f"{agent.__module__}:{agent.__qualname__}"
    source = CUSTOM
    if not isinstance(task, TrainConfig):
        source = Source(preset or default_preset(), setting)
        task = compose(source.preset, task or name, agent, setting)
    if overrides.get("run_dir") is not None:
        overrides["run_dir"] = Path(overrides["run_dir"])
    first_part = clone_first(
        override(task, overrides),
        source,
        lambda first: _fit(first, (), progress, make=make, source=source),
        lambda run, first: _resume(run, first, (), progress, make),
        Outcome.was_stopped,
    )
    config, stopped = first_part
    if stopped is not None:
        return stopped
    return _fit(config, callbacks, progress, make=make, source=source)


def resume(
    run: Path | str,
    *,
    env: MakeEnv | None = None,
    steps: int | None = None,
    minutes: float | None = None,
    device: Device | None = None,
    callbacks: Iterable[Callback] = (),
    progress: bool = True,
    trust: bool = False,
    skip_damaged: bool = False,
) -> Outcome:
    """Resume a run from its last checkpoint.

    Args:
        run: the run's folder.
        env: a function that makes the run's environment; needed if `train` was given one that the
            run does not record.
        steps: train to this total number of steps; if not given, to the run's own.
        minutes: stop after this many minutes from now; if not given, there is no time limit.
        device: where the networks live from now on; if not given, where they were before.
        callbacks: called while it trains. The loggers of the run's config log again by themselves.
        progress: see `train`.
        trust: see `evaluate`.
        skip_damaged: if parts of the replay are damaged, leave out their episodes, with a warning,
            instead of raising an error.

    Returns:
        As `train`. The outcome of a run that has ended already has no evaluation.

    Raises:
        MerlError: the run cannot be resumed; or see `Trainer.fit`.
    """
    opened = Run.open(Path(run)).with_agent(trusted=trust)
    asked = resume_request(opened.config, steps, minutes, device)
    return _resume(
        opened, asked, callbacks, progress, env, trusted=trust, skip_damaged=skip_damaged
    )


def evaluate(
    run: Path | str,
    *,
    env: MakeEnv | None = None,
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
        env: see `resume`.
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
        env=env,
        episodes=episodes,
        video=None if video is None else Path(video).absolute(),
        renderer=renderer,
        max_episode_steps=max_episode_steps,
        trust=trust,
    )


def _resume(
    run: Run,
    asked: TrainConfig,
    callbacks: Iterable[Callback],
    progress: bool,
    make: MakeEnv | None,
    *,
    trusted: bool = False,
    skip_damaged: bool = False,
) -> Outcome:
    """Resume a run with a config; return the outcome of a run that has ended as it is."""
    imports = make is None
    with resumption(run, asked, ["device"], imports=imports, trusted=trusted) as found:
        if found.done is not None:
            return found.done
        options = {"resumed": (found.run, found.start), "skip_damaged": skip_damaged}
        return _fit(found.config, callbacks, progress, make=make, **options)


def _fit(
    config: TrainConfig, callbacks: Iterable[Callback], progress: bool, **options: Any
) -> Outcome:
    views = [LiveView()] if progress else []
    with Trainer(config, [*callbacks, *views], **options) as trainer:
        return trainer.fit()
