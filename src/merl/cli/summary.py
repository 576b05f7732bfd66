"""What a run came to: its return among what it is to be compared with, the curve, the video."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from merl.acting.run_env import make_run_env
from merl.config import TrainConfig
from merl.core import MerlError, counted
from merl.envs.wrappers import in_one_line
from merl.evaluation.evaluation import Act, Evaluation, evaluate
from merl.report.references import RANDOM, Reference, references
from merl.runs.run_folder import resume_line
from merl.training.trainer import Outcome

FLOORS = (RANDOM, "no motion")
"""The references that need no skill."""
ENOUGH = 5
"""Episodes of an evaluation, below which its interval says nothing."""


def summarize(outcome: Outcome, console: Console) -> None:
    """Print the table, draw the curve, say plainly what was learnt, and how to go on.

    The run is saved. What fails here costs one line, and the rest is still printed.
    """
    run, trained = outcome.run, outcome.evaluation
    from merl.report.figures import learning_curve  # here, for Matplotlib is slow to import

    beside = references(run.config.task, run.config.evaluated.env)
    if trained is not None and not beside and run.config.eval.references:
        with console.status(
            f"what {' and '.join(FLOORS)} are paid, to compare with", spinner="line"
        ):
            beside = _measured(run.config, console, trained.success_end is not None)
    if trained is not None:
        console.print()
        console.print(comparison(run.config.task, trained, beside))
    lines = {reference.name: reference.returns.mean for reference in beside}
    try:
        curve = learning_curve(run.path, run.path / "curve.png", references=lines)
        console.print(f"learning curve: {curve}", highlight=False, soft_wrap=True)
    except Exception as error:  # of matplotlib, too
        console.print(f"the curve was not drawn: {_reason(error)}", highlight=False)
    videos = sorted(run.videos.glob("*.mp4")) if run.videos.is_dir() else []
    if videos:
        console.print(f"video: {videos[-1]}", highlight=False, soft_wrap=True)
    if trained is not None:
        console.print(_verdict(beside, trained, outcome.progress.updates), highlight=False)
    elif outcome.saved:
        console.print(
            f"{run.path} is trained and saved, and not evaluated", highlight=False, soft_wrap=True
        )
    console.print(_way_on(outcome), highlight=False, soft_wrap=True)
    console.print(
        f"(its replay, {run.replay}, is only needed to go on, and may be deleted otherwise)",
        highlight=False,
        soft_wrap=True,
        style="dim",
    )


def floors(
    config: TrainConfig, episodes: int = 20, *, reports_success: bool = False
) -> tuple[Reference, ...]:
    """Random actions, and none (the middle of their range), from the evaluation's starts."""
    env = make_run_env(config.evaluated)
    rng = np.random.default_rng(0)
    shape = env.action_space.shape
    assert shape is not None
    policies: tuple[Act, Act] = (
        lambda _: rng.uniform(-1.0, 1.0, shape).astype(np.float32),
        lambda _: np.zeros(shape, np.float32),
    )
    try:
        limit = config.eval_steps
        results = [
            evaluate(act, env, episodes, max_steps=limit, reports_success=reports_success)
            for act in policies
        ]
    finally:
        env.close()
    return tuple(
        Reference(name, result.returns, result.success_end, counted(episodes, "episode"))
        for name, result in zip(FLOORS, results, strict=True)
    )


def comparison(task: str, trained: Evaluation, beside: Sequence[Reference]) -> Table:
    """What was trained among its references."""
    table = Table("", "return", "success at the end", "from", title=task)
    episodes = counted(len(trained.episodes), "episode")
    rows = [*beside, Reference("trained", trained.returns, trained.success_end, episodes)]
    for row in rows:
        returns = f"{row.returns.mean:.1f}"
        if row.returns.low < row.returns.high:
            returns += f" [{row.returns.low:.1f}, {row.returns.high:.1f}]"
        rate = row.success_end
        success = "" if rate is None else f"{rate.mean:.0%} [{rate.low:.0%}, {rate.high:.0%}]"
        style = "bold" if row is rows[-1] else None
        table.add_row(row.name, returns, success, row.source, style=style)
    table.caption = "in brackets: 95 % intervals"
    return table


def _measured(
    config: TrainConfig, console: Console, reports_success: bool
) -> tuple[Reference, ...]:
    """What can be measured of the references that need no skill; the run is over in any case."""
    try:
        return floors(config, reports_success=reports_success)
    except Exception as error:
        console.print(f"there is nothing to compare with: {_reason(error)}", highlight=False)
        return ()


def _reason(error: Exception) -> str:
    """An exception in one line."""
    return str(error) if isinstance(error, MerlError) else in_one_line(error)


def _verdict(beside: Sequence[Reference], trained: Evaluation, updates: int) -> str:
    """Whether anything was learnt, as far as the intervals allow to say.

    Doing nothing can be paid more than acting at random.
    """
    if updates == 0:
        return "Nothing was learnt: there was no update."
    lower = [row for row in beside if row.name in FLOORS]
    if not lower:
        return (
            "Whether it has learnt cannot be said: there is nothing to compare with "
            "(--eval.references takes 20 episodes each of random actions and of no motion)."
        )
    floor = max(lower, key=lambda row: row.returns.high)
    if trained.returns.low <= floor.returns.high:
        return (
            "It is too early to say that it has learnt: its return is not clearly above that of "
            f"{floor.name}."
        )
    if len(trained.episodes) < ENOUGH:
        episodes = counted(len(trained.episodes), "episode")
        return (
            f"Its return lies above that of {floor.name}, but {episodes} cannot show that it has "
            "learnt: evaluate more (--eval.episodes)."
        )
    return f"It has begun to learn: its return lies clearly above that of {floor.name}."


def _way_on(outcome: Outcome) -> str:
    run, step = outcome.run, outcome.progress.step
    if step < run.config.steps:
        return f"go on with: {resume_line(run.path)}"
    return f"go on with: {resume_line(run.path)} --steps {2 * run.config.steps}"
