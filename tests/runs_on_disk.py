"""Run folders for the tests of reports, with metrics that are easy to compute by hand."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np

COLUMNS = "step,time/seconds,train/return,eval/return,eval/success_end"


def write_run(
    folder: Path,
    returns: Sequence[float],
    success: Sequence[float],
    *,
    seed: int = 0,
    task: str = "reach_duplo",
    every: int = 1000,
    final: tuple[float, float] | None = None,
    **config: object,
) -> Path:
    """Write a run with an evaluation every `every` steps, which take 60 s."""
    folder.mkdir(parents=True)
    lines = [COLUMNS]
    for i, (value, rate) in enumerate(zip(returns, success, strict=True), 1):
        lines.append(f"{i * every},{60.0 * i},{value - 1},{value},{rate}")
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    env = {"occluded": False, "start": ["above"], "reward": "paper"}
    values = {"steps": every * len(returns), "run_dir": None, "seed": seed, "env": env}
    values |= {"eval": {"start": None, "episodes": 10}, "agent": {"tau": 0.01} | config}
    record = {"task": task, "agent": "merl", "preset": "laptop", "seed": seed, "config": values}
    (folder / "config.json").write_text(json.dumps(record))
    if final is not None:
        rows = [{"seed": i, "return": final[0], "success_end": final[1]} for i in range(2)]
        evaluation = {"step": every * len(returns), "episodes": rows}
        (folder / "evaluation.json").write_text(json.dumps(evaluation))
    return folder


def write_video(path: Path, frames: int = 12, side: int = 64) -> Path:
    """Write an MP4 that becomes brighter."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width = stream.height = side
        stream.pix_fmt = "yuv420p"
        for i in range(frames):
            image = np.full((side, side, 3), 20 + 15 * i, np.uint8)
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path
