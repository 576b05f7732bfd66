"""Means of metrics, and the schedule of saves."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from merl.training.meters import Averages, Interval


def test_a_metric_is_averaged_over_the_updates_that_have_it() -> None:
    averages = Averages()
    averages.add({"critic_loss": torch.tensor(1.0)})
    averages.add({"critic_loss": torch.tensor(3.0), "actor_loss": torch.tensor(5.0)})
    averages.add({})
    assert averages.take() == {"learn/critic_loss": 2.0, "learn/actor_loss": 5.0}
    averages.add({"critic_loss": torch.tensor(4.0)})
    assert averages.take() == {"learn/critic_loss": 4.0}


@pytest.mark.parametrize(
    ("episode", "most"),
    [(7.0, 294.0), (120.0, 240.0), (299.0, 299.0), (300.0, 300.0), (400.0, 400.0)],
)
def test_the_time_between_saves_is_as_long_as_allowed(episode: float, most: float) -> None:
    clock = [0.0]
    interval = Interval(300.0, lambda: clock[0])
    saves = [0.0]
    for _ in range(200):
        clock[0] += episode
        if interval.is_due():
            saves.append(clock[0])
            clock[0] += 0.5  # duration of a save
            interval.saved()
    apart = [after - before for before, after in pairwise(saves)]
    assert max(apart) == pytest.approx(most, abs=1.0)
    assert min(apart) >= most - 1.0


def test_an_interval_of_zero_is_always_due() -> None:
    clock = [0.0]
    interval = Interval(0.0, lambda: clock[0])
    clock[0] += 1e-3
    assert interval.is_due()


def test_a_very_long_episode_has_a_save_within() -> None:
    """Another save follows at its end, from which a run resumes exactly."""
    clock = [0.0]
    interval = Interval(300.0, lambda: clock[0])
    clock[0] = 400.0
    assert not interval.is_overdue()  # an episode of this duration is allowed
    assert interval.is_due()
    interval.saved()
    clock[0] += 1799.0
    assert not interval.is_overdue()
    clock[0] += 2.0
    assert interval.is_overdue()
    interval.saved(within=True)
    assert not interval.is_overdue()
    clock[0] += 1.0
    assert interval.is_due()
    interval.saved()
    clock[0] += 1.0
    assert not interval.is_due()


def test_without_ends_of_episodes_saves_are_two_intervals_apart() -> None:
    clock = [0.0]
    interval = Interval(300.0, lambda: clock[0])
    saves = []
    while clock[0] < 3600:
        clock[0] += 1.0
        if interval.is_overdue():
            interval.saved(within=True)
            saves.append(clock[0])
    assert saves == [601.0, 1202.0, 1803.0, 2404.0, 3005.0]
