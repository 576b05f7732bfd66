"""What a run came to: random, trained and best known return side by side, the curve, the video."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from merl.cli.parsing import program
from merl.core import MerlError, Observation
from merl.report.figures import learning_curve
from merl.training.config import TrainConfig
from merl.training.evaluation import Evaluation, evaluate, make_run_env
from merl.training.trainer import Outcome

BEST_KNOWN = {"reach_duplo": ("DrQ-v2, 2.98M frames, 10 seeds (published)", 224.6)}
"""The best return that is known of each task, and whose it is."""


def summarize(outcome: Outcome, console: Console) -> None:
    """Print the table, draw the curve, say plainly what was learnt, and how to go on."""
    run, trained = outcome.run, outcome.evaluation
    if trained is None:
        return
    chance = random_evaluation(run.config)
    console.print()
    console.print(_table(run.config, chance, trained))
    references = {"random": chance.returns.mean}
    if run.config.task in BEST_KNOWN:
        references["best known"] = BEST_KNOWN[run.config.task][1]
    try:
        curve = learning_curve(run.path, run.path / "curve.png", references=references)
        console.print(f"learning curve: {curve}", highlight=False, soft_wrap=True)
    except MerlError as error:
        console.print(f"the curve was not drawn: {error}", highlight=False)
    videos = sorted(run.videos.glob("*.mp4")) if run.videos.is_dir() else []
    if videos:
        console.print(f"video: {videos[-1]}", highlight=False, soft_wrap=True)
    console.print(_verdict(chance, trained), highlight=False)
    console.print(_way_on(outcome), highlight=False, soft_wrap=True)
    console.print(
        f"(its replay, {run.replay}, is only needed to go on, and may be deleted otherwise)",
        highlight=False,
        soft_wrap=True,
        style="dim",
    )


def random_evaluation(config: TrainConfig, episodes: int = 20) -> Evaluation:
    """Uniformly random actions from the evaluation's starts; nothing is rendered for them."""
    env = make_run_env(config, observations=("proprio",))
    shape = env.action_space.shape
    assert shape is not None
    try:
        return evaluate(_random_policy(shape), env, episodes)
    finally:
        env.close()


def _random_policy(shape: tuple[int, ...]) -> Callable[[Observation], NDArray[np.float32]]:
    rng = np.random.default_rng(0)

    def act(observation: Observation) -> NDArray[np.float32]:
        return rng.uniform(-1.0, 1.0, shape).astype(np.float32)

    return act


def _table(config: TrainConfig, chance: Evaluation, trained: Evaluation) -> Table:
    table = Table("", "return", "success at the end", "success at any time", title=config.task)
    table.add_row("random actions", *_cells(chance))
    table.add_row("trained", *_cells(trained), style="bold")
    if config.task in BEST_KNOWN:
        whose, value = BEST_KNOWN[config.task]
        table.add_row("best known", f"{value:.1f}", "", "")
        table.caption = (
            f"trained: {len(trained.episodes)} episodes; 95 % intervals; best known: {whose}"
        )
    return table


def _cells(evaluation: Evaluation) -> list[str]:
    returns = evaluation.returns
    cells = [f"{returns.mean:.1f} [{returns.low:.1f}, {returns.high:.1f}]"]
    for rate in (evaluation.success_end, evaluation.success_any):
        cells.append("" if rate is None else f"{rate.mean:.0%} [{rate.low:.0%}, {rate.high:.0%}]")
    return cells


def _verdict(chance: Evaluation, trained: Evaluation) -> str:
    """Whether anything was learnt, as far as the intervals allow to say."""
    if trained.returns.low > chance.returns.high:
        return "It has begun to learn: its return lies clearly above that of random actions."
    return "It is too early to say that it has learnt: its return is not clearly above random."


def _way_on(outcome: Outcome) -> str:
    run, step = outcome.run, outcome.progress.step
    if step < run.config.steps:
        return f"go on with: {program()} resume {run.path}"
    return f"go on with: {program()} resume {run.path} --steps {2 * run.config.steps}"
