"""The experts solve every task, and only read the simulation."""

import numpy as np
import pytest

from episodes import Episodes
from merl.tasks.arm_task import EPISODE_STEPS
from merl.tasks.expert import make_expert

AT_BOX = {"starts": ("around", "holding", "carrying")}
TASKS = [
    pytest.param("reach_duplo", {}, id="reach_duplo"),
    pytest.param("move_box", {}, id="move_box"),
    pytest.param("lift_box", {}, id="lift_box"),
    pytest.param("move_box", {"occluded": True}, id="move_box_occluded"),
    pytest.param("lift_box", {"occluded": True}, id="lift_box_occluded"),
    pytest.param("move_box", AT_BOX, id="move_box_at_box"),
    pytest.param("lift_box", AT_BOX, id="lift_box_at_box"),
]


class ExpertEpisodes(Episodes):
    """Episodes of a task that its expert solves."""

    def __init__(self, name, **form):
        super().__init__(name, **form)
        self.expert = make_expert(self.task, self.physics)
        self.low, self.high = self.physics.model.actuator_ctrlrange.T

    def start(self, seed):
        physics = super().start(seed)
        self.expert.reset()
        return physics

    def step(self, noise=None):
        before = self.physics.get_state()
        velocities = self.expert.act()
        np.testing.assert_array_equal(self.physics.get_state(), before)
        assert velocities.shape == (9,)
        assert (velocities >= self.low).all()
        assert (velocities <= self.high).all()
        if noise is not None:  # in the units of actions, as exploration noise is
            velocities = np.clip(velocities + noise * self.high, self.low, self.high)
        self.physics.set_control(velocities)
        self.physics.step(self.task.physics_steps_per_control_step)
        return velocities

    def is_solved(self, seed, deviation=0.0):
        self.start(seed)
        rng = np.random.default_rng(seed)
        for _ in range(EPISODE_STEPS):
            self.step(rng.normal(0.0, deviation, 9))
        return self.task.success(self.physics)


@pytest.mark.parametrize(("name", "form"), TASKS)
def test_expert_solves_the_task(name, form):
    assert ExpertEpisodes(name, **form).is_solved(0)


@pytest.mark.long
@pytest.mark.parametrize(("name", "form"), TASKS)
def test_expert_solves_95_of_100_starts(name, form):
    episodes = ExpertEpisodes(name, **form)
    assert sum(episodes.is_solved(seed) for seed in range(100)) >= 95


@pytest.mark.parametrize(("name", "form"), TASKS[:3])
def test_expert_recovers_from_noise(name, form):
    episodes = ExpertEpisodes(name, **form)
    assert sum(episodes.is_solved(seed, deviation=0.2) for seed in range(5)) >= 4


@pytest.mark.long
@pytest.mark.parametrize(("deviation", "least"), [(0.1, 90), (0.2, 80)])
@pytest.mark.parametrize(("name", "form"), TASKS[:3])
def test_expert_recovers_from_noise_in_most_of_100_starts(name, form, deviation, least):
    episodes = ExpertEpisodes(name, **form)
    assert sum(episodes.is_solved(seed, deviation) for seed in range(100)) >= least


@pytest.mark.parametrize("name", ["reach_duplo", "move_box", "lift_box"])
def test_expert_remembers_nothing(name):
    episodes = ExpertEpisodes(name)
    episodes.start(2)
    for _ in range(70):
        episodes.step()
    expected = episodes.expert.act()
    another = make_expert(episodes.task, episodes.physics)
    another.reset()
    np.testing.assert_array_equal(another.act(), expected)


def test_expert_repeats_its_velocities_for_the_same_start():
    episodes = ExpertEpisodes("lift_box")
    runs = []
    for _ in range(2):
        episodes.start(3)
        runs.append([episodes.step() for _ in range(20)])
    np.testing.assert_array_equal(*runs)


def test_expert_grasps_a_lost_box_again():
    episodes = ExpertEpisodes("lift_box")
    episodes.start(0)
    while episodes.task.prop_position(episodes.physics)[2] < 0.06:
        episodes.step()
    data = episodes.physics.data  # the box's free joint is the last
    data.qpos[-7:], data.qvel[-6:] = (-0.06, 0.03, 0.025, 1.0, 0.0, 0.0, 0.0), 0.0
    episodes.physics.forward()
    for _ in range(EPISODE_STEPS):
        episodes.step()
    assert episodes.task.success(episodes.physics)
