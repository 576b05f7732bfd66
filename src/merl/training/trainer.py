"""A run from its first step, or from a checkpoint, to its end."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack

from merl.acting.environments import InProcessEnvs, WorkerEnvs
from merl.acting.run_env import own_bounds
from merl.core.signals import Interrupt
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer
from merl.runs.checkpoint import Checkpoint
from merl.runs.metrics import MetricsWriter
from merl.runs.run import Run
from merl.training.parts import Parts
from merl.training.stretch import Outcome, Stretch, View


def start(parts: Parts, view: View) -> Outcome:
    """Begin a new run; if it fails before its first step, nothing is left of it."""
    bounds = own_bounds(parts.env)
    space, actions, names = parts.space, parts.action_space, parts.left_open
    with Run.begin(parts.config, space, actions, bounds, names, home=parts.home) as run:
        try:
            return _train(parts, run, None, view)
        except BaseException:
            if parts.progress.step == 0:
                run.discard()
            raise


def resume(parts: Parts, run: Run, point: Checkpoint | None, view: View) -> Outcome:
    """Go on from a checkpoint of the run, or begin it; the caller holds its lock."""
    run = dataclasses.replace(run, config=parts.config)
    if point is None:
        run.record_resumption(0)
    return _train(parts, run, point, view)


def _train(parts: Parts, run: Run, point: Checkpoint | None, view: View) -> Outcome:
    config = parts.config
    with ExitStack() as stack:
        interrupt = stack.enter_context(Interrupt().listening())
        metrics = stack.enter_context(MetricsWriter(run.path, view.warn))
        with torch_settings(parts.device):
            replay = ReplayBuffer(
                config.replay,
                parts.space,
                parts.action_space,
                count=config.num_envs,
                directory=run.replay,
                capacity=config.capacity,
            )
        with interrupt.raising():
            environments = (
                WorkerEnvs(config, parts.env) if config.has_workers else InProcessEnvs(parts.env)
            )
        stack.callback(environments.close)
        stretch = Stretch(parts, run, replay, environments, metrics, view, interrupt)
        if point is not None:
            stretch.restore(point)
            run.record_resumption(point.step)
        outcome = stretch.train()
    return dataclasses.replace(outcome, unwritten=metrics.unwritten)
