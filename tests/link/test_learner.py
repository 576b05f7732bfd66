"""Two actors feed a learner, which evaluates in its own environment and ends for all."""

from __future__ import annotations

from pathlib import Path

from helpers import flat, wait_for
from merl.runs.checkpoint import Checkpoint
from merl.runs.metrics import read_rows
from merl.runs.run import Run
from two_sides import Sides


def test_two_actors_feed_a_learner_that_evaluates(tmp_path: Path) -> None:
    sides = Sides(tmp_path)
    learner = sides.start(
        "server",
        "learner",
        [
            *("learner", "merl.envs.dot:whole", "--preset", "smoke", "--num-envs", "2"),
            *("--steps", "600", "--seed-steps", "50", "--eval.every", "300"),
            *("--eval.video", "none", "--device", "cpu", "--threads", "1"),
            *("--agent.precision", "fp32", "--agent.torch-compile", "no", "--run-dir", "run"),
            *("--actors.listen", f"127.0.0.1:{sides.port}"),
        ],
    )
    wait_for(lambda: (sides.run / "config.json").exists())
    connect = ["actor", "--connect", f"127.0.0.1:{sides.port}"]
    fast = sides.start("fast", "fast", connect)
    paced = sides.start("paced", "paced", [*connect, "--hz", "40", "--random-steps", "30"])
    for process in (learner, fast, paced):
        process.join(120)
    for name, process in (("learner", learner), ("fast", fast), ("paced", paced)):
        assert process.exitcode == 0, sides.output(name)
    assert "the run is done" in sides.output("fast")
    assert "late" in sides.output("paced")
    _, rows = read_rows(sides.run / "metrics.csv")
    first, last = (int(row["step"]) for row in rows if "eval/return" in row)
    assert (last, first // 50) == (600, 6)  # at the end of an episode
    assert any("train/return" in row for row in rows)
    state = Checkpoint.find(Run.open(sides.run).checkpoints).state()
    sizes = [ring["steps"] for ring in state["replay"]["rings"]]
    assert sum(sizes) == 600
    assert min(sizes) > 20
    assert "other episodes" not in flat(sides.output("learner"))
