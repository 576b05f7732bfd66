"""Measure the cost of checkpoints.

    python benchmarks/measure_saving.py [--preset paper --task move_box]

Trains a run with the networks and images of its preset that saves at the end of every episode.
Prints the duration of a save, and its share of the time at the default `--save-every` of 300
seconds.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path
from statistics import median
from unittest.mock import patch

import tyro

from merl.experiments.presets import compose
from merl.training.saving import Saver
from merl.training.trainer import Trainer


def main(preset: str = "laptop", task: str = "reach_duplo", steps: int = 3000) -> None:
    """Train for `steps` steps, with an update every 50 steps; print the duration of a save."""
    taken: list[float] = []
    save = Saver.save

    def timed(saver: Saver) -> bool:
        start = time.perf_counter()
        done = save(saver)
        taken.append(time.perf_counter() - start)
        return done

    with patch.object(Saver, "save", timed), tempfile.TemporaryDirectory(dir=".") as folder:
        config = dataclasses.replace(
            compose(preset, task),
            steps=steps,
            run_dir=Path(folder) / "run",
            save_every=0.0,
            seed_steps=100,
            updates_per_step=0.02,
            threads=1,
            num_envs=1,
            synchronous=True,
        )
        config = dataclasses.replace(
            config, eval=dataclasses.replace(config.eval, every=steps, episodes=2, video="none")
        )
        with Trainer(config) as trainer:
            trainer.fit()
        newest = max((config.run_dir / "checkpoints").iterdir()) if config.run_dir else Path()
        size = sum(file.stat().st_size for file in newest.iterdir())
    every = compose(preset, task).save_every
    print(
        f"{preset}, {task}: {len(taken)} saves of {size / 1e6:.0f} MB and 250 steps, median "
        f"{median(taken):.2f} s, most {max(taken):.2f} s: {100 * median(taken) / every:.2f} % of "
        f"{every:g} s"
    )


if __name__ == "__main__":
    tyro.cli(main)
