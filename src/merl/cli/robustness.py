"""The command merl robustness."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from merl.cli.console import make_console, say
from merl.cli.parsing import PolicyOptions, parse
from merl.cli.running import open_policy
from merl.core.fields import Range
from merl.core.files import reporting
from merl.evaluation.robustness import robustness as evaluations
from merl.report.robustness import Row, draw_rows, write_rows


@dataclass(frozen=True)
class RobustnessOptions(PolicyOptions):
    """Evaluate a trained policy while its senses, its actions or the scene are disturbed."""

    episodes: Annotated[int, Range(1)] = 50
    """Number of episodes for each disturbance."""
    out: Path | None = None
    """Folder for robustness.csv and robustness.png; by default robustness/ and the run's name."""


def robustness(args: list[str]) -> int:
    """Disturb a policy: merl robustness RUN [--episodes N] [--out DIR] ..."""
    options = parse(RobustnessOptions, "merl robustness", args)
    console = make_console()
    policy = open_policy(options)
    out = (options.out or Path("robustness", options.run.resolve().name)).absolute()
    with reporting(f"--out {out} cannot be created"):
        out.mkdir(parents=True, exist_ok=True)
    console.print(f"{options.run} at step {policy.step:,}")
    rows: list[Row] = []
    for how, it in evaluations(policy, options.episodes, trust=options.trust):
        row = Row.of(how.sense, how.name, len(it.episodes), it.returns, it.success_end)
        rows.append(row)
        console.print(f"{row.sense:8} {row.disturbance:14} {row.text}")
        write_rows(rows, out / "robustness.csv")
    figure = draw_rows(rows, f"{policy.config.task} under disturbances", out / "robustness.png")
    say(console, f"{figure}")
    return 0
