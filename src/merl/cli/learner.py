"""The command merl learner."""

from __future__ import annotations

from merl.cli.train import TrainOptions, train

LearnerOptions = TrainOptions
"""The options are those of `merl train`; only some defaults differ."""


def learner(args: list[str]) -> int:
    """Train with actors: merl learner TASK [--actors.listen HOST:PORT] [--num-envs N] ..."""
    return train(args, acts=False)
