"""The summary of a run: its return compared with references, its learning curve and its video."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from merl.acting.run_env import make_run_env
from merl.cli.console import say
from merl.config import TrainConfig
from merl.core import counted
from merl.core.files import entries
from merl.core.user_code import reason
from merl.evaluation.evaluation import Act, Evaluation, evaluate
from merl.report.references import RANDOM, Reference, references
from merl.runs.run_folder import resume_line
from merl.training.outcome import Outcome

FLOORS = (RANDOM, "no motion")
"""References that need no skill."""
EPISODES = 20
"""Episodes in which they are measured, if they are not known."""
ENOUGH = 5
"""Fewest evaluation episodes that can show that the agent has learnt."""


def summarize(outcome: Outcome, console: Console) -> None:
    """Print the table, draw the curve, print whether the agent has learnt and how to resume.

    The run is already saved. If a part of the summary fails, print one line and continue.
    """
    run, trained, config = outcome.run, outcome.evaluation, outcome.run.config
    from merl.report.figures import learning_curve  # Matplotlib imports slowly

    known = references(config.task, config.evaluated.env, config.eval.max_episode_steps)
    if trained is not None and not known and config.eval.references:
        with console.status(f"measuring returns of {' and '.join(FLOORS)}", spinner="line"):
            known = _floors(config, console, trained.success_end is not None)
    if trained is not None:
        console.print()
        console.print(comparison(config.task, trained, known))
    lines = {reference.name: reference.returns.mean for reference in known}
    try:
        curve = learning_curve(run.path, run.path / "curve.png", references=lines)
        say(console, f"learning curve: {curve}")
    except Exception as error:  # Matplotlib's errors too
        console.print(f"the curve was not drawn: {reason(error)}")
    videos: list[Path] = []
    with suppress(OSError):
        videos = [path for path in entries(run.videos) if path.suffix == ".mp4"]
    if videos:
        say(console, f"video: {videos[-1]}")
    if trained is not None:
        console.print(_verdict(known, trained, outcome.progress.updates))
    elif outcome.saved:
        say(console, f"{run.path} is trained and saved, and not evaluated")
    say(console, _resume_hint(outcome))
    replay = f"(its replay, {run.replay}, is only needed to resume; you may delete it otherwise)"
    say(console, replay, style="dim")


def _floors(config: TrainConfig, console: Console, reports_success: bool) -> tuple[Reference, ...]:
    """Measure `FLOORS` from the fixed starts; if that fails, print one line and return none.

    No motion is the middle of the actions' range.
    """
    rng, limit = np.random.default_rng(0), config.eval_steps
    try:
        with closing(make_run_env(config.evaluated)) as env:
            shape = env.action_space.shape or ()
            policies: tuple[Act, Act] = (
                lambda _: rng.uniform(-1.0, 1.0, shape).astype(np.float32),
                lambda _: np.zeros(shape, np.float32),
            )
            results = [
                evaluate(act, env, EPISODES, max_steps=limit, reports_success=reports_success)
                for act in policies
            ]
    except Exception as error:
        console.print(f"there is nothing to compare with: {reason(error)}")
        return ()
    return tuple(
        Reference(name, result.returns, result.success_end, counted(EPISODES, "episode"))
        for name, result in zip(FLOORS, results, strict=True)
    )


def comparison(task: str, trained: Evaluation, known: Sequence[Reference]) -> Table:
    """Return a table with the results of the references and of the trained agent."""
    table = Table("", "return", "success at the end", "source", title=task)
    episodes = counted(len(trained.episodes), "episode")
    rows = [*known, Reference("trained", trained.returns, trained.success_end, episodes)]
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


def _verdict(known: Sequence[Reference], trained: Evaluation, updates: int) -> str:
    """Return whether the agent has learnt anything, as far as the intervals show it.

    The comparison is with the better of `FLOORS`: no motion can have a higher return than random
    actions.
    """
    if updates == 0:
        return "Nothing was learnt: there was no update."
    lower = [row for row in known if row.name in FLOORS]
    if not lower:
        return (
            "It is unknown whether the agent has learnt: there is nothing to compare with "
            "(--eval.references takes 20 episodes each of random actions and of no motion)."
        )
    floor = max(lower, key=lambda row: row.returns.high)
    if trained.returns.low <= floor.returns.high:
        return (
            "It is too early to say that the agent has learnt: its return is not clearly above "
            f"that of {floor.name}."
        )
    if len(trained.episodes) < ENOUGH:
        episodes = counted(len(trained.episodes), "episode")
        return (
            f"The agent's return is above that of {floor.name}, but {episodes} cannot show that it "
            "has learnt: evaluate more (--eval.episodes)."
        )
    return f"The agent has begun to learn: its return is clearly above that of {floor.name}."


def _resume_hint(outcome: Outcome) -> str:
    run, step = outcome.run, outcome.progress.step
    if step < run.config.steps:
        return f"resume with: {resume_line(run.path)}"
    return f"resume with: {resume_line(run.path)} --steps {2 * run.config.steps}"
