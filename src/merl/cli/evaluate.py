"""The command merl evaluate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from merl.cli.console import make_console, say
from merl.cli.parsing import PolicyOptions, check_writable, parse, write_json
from merl.cli.running import open_policy
from merl.cli.summary import comparison
from merl.core import MerlError
from merl.core.fields import Range
from merl.evaluation.evaluation import EVALUATION_SEED
from merl.rendering.config import RendererName
from merl.report.references import references
from merl.training.live_view import describe


@dataclass(frozen=True)
class EvaluateOptions(PolicyOptions):
    """Run a trained policy without exploration noise, from the fixed start states."""

    episodes: Annotated[int, Range(1)] = 10
    """Number of episodes."""
    video: Path | None = None
    """Record a video of the first episode in this file (MP4)."""
    max_episode_steps: Annotated[int, Range(1)] | None = None
    """Steps after which an episode is cut off; by default the run's --eval.max-episode-steps."""
    renderer: RendererName | None = None
    """Renderer of the images; by default the one that the agent was trained with."""
    json: Path | None = None
    """Also write the seed, return and success of each episode to this file."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.video is not None and self.video.suffix.lower() not in ("", ".mp4"):
            raise MerlError(
                f"--video {self.video}: videos are MP4; use {self.video.with_suffix('.mp4')}"
            )


def evaluate(args: list[str]) -> int:
    """Evaluate a run: merl evaluate RUN [--episodes N] [--video FILE] ..."""
    options = parse(EvaluateOptions, "merl evaluate", args)
    check_writable(options.json)
    # Resolve paths before user code runs: it may change the working folder.
    json_file = options.json and options.json.absolute()
    video_file = options.video and options.video.absolute()
    console = make_console()
    policy = open_policy(options)
    result = policy.evaluate(
        episodes=options.episodes,
        video=video_file,
        renderer=options.renderer,
        max_episode_steps=options.max_episode_steps,
        trust=options.trust,
    )
    config = policy.config
    renderer = options.renderer or policy.config.env.renderer
    images = "" if policy.config.has_user_env else f", {renderer} images"
    line = f"{options.run} at step {policy.step:,}{images}: {describe(result)}"
    console.print(line)
    limit = options.max_episode_steps or config.eval.max_episode_steps
    known = references(config.task, config.evaluated.env, limit)
    if known:
        console.print(comparison(config.task, result, known))
    if options.video is not None:
        say(console, f"video: {options.video}")
    if json_file is not None:
        rows = [
            {
                "seed": EVALUATION_SEED + i,
                **episode.metrics(reports_success=result.success_end is not None),
            }
            for i, episode in enumerate(result.episodes)
        ]
        write_json(json_file, {"run": str(options.run), "step": policy.step, "episodes": rows})
    return 0
