"""merl evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from merl.cli.parsing import parse, write_json
from merl.core import MerlError
from merl.envs.config import RendererName
from merl.training.console import describe
from merl.training.evaluation import EVALUATION_SEED, load_policy
from merl.training.evaluation import evaluate as evaluate_policy


def evaluate(args: list[str]) -> int:
    """Evaluate a run: merl evaluate RUN [--episodes N] [--video FILE] ..."""

    def command(
        run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
        episodes: int = 10,
        video: Path | None = None,
        checkpoint: str = "latest",
        renderer: RendererName | None = None,
        json: Path | None = None,
    ) -> dict[str, Any]:
        """Run a trained policy without noise, from the evaluation's fixed starts.

        Args:
            run: The run's folder.
            episodes: How many episodes.
            video: Film the first episode into this file (MP4).
            checkpoint: latest, best, or a number of steps.
            renderer: What draws the pictures, if not what the agent was trained with.
            json: Also write every episode's seed, return and success into this file.
        """
        return locals()

    return _evaluate(**parse(command, "merl evaluate", args))


def _evaluate(
    run: Path,
    episodes: int,
    video: Path | None,
    checkpoint: str,
    renderer: RendererName | None,
    json: Path | None,
) -> int:
    if episodes < 1:
        raise MerlError(f"--episodes must be at least 1, not {episodes}")
    console = Console()
    policy = load_policy(run, checkpoint=checkpoint)
    changes = {} if renderer is None else {"renderer": renderer}
    env = policy.make_env(render_mode="rgb_array" if video else None, **changes)
    try:
        result = evaluate_policy(policy, env, episodes, reset=policy.reset, video=video)
    finally:
        env.close()
    console.print(f"{run} at step {policy.step:,}: {describe(result)}", highlight=False)
    if video is not None:
        console.print(f"video: {video}", highlight=False)
    if json is not None:
        rows = [
            {"seed": EVALUATION_SEED + i, **episode.metrics()}
            for i, episode in enumerate(result.episodes)
        ]
        write_json(json, {"run": str(run), "step": policy.step, "episodes": rows})
    return 0
