from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch

from merl.acting.environments import InProcessEnvs
from merl.acting.rollout import Episode, Fetched, FrameStack, mean_metrics
from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.config import TrainConfig
from merl.replay import ReplayBuffer, ReplayConfig
from merl.replay.on_device import OnDevice
from merl.training import loop
from merl.training.loop import (
    Collector,
    Progress,
    Randomness,
    StepResult,
    Update,
    train,
    updates_due,
)
from merl.training.updating import UpdateFromHost, UpdateOnDevice, update_from_host
from toy import DotEnv

CPU = torch.device("cpu")
CONFIG = TrainConfig(
    "dot",
    steps=60,
    random_steps=10,
    seed_steps=20,
    replay=ReplayConfig(batch_size=8),
    agent=MERLConfig(latent_dim=8, hidden_dim=16, shift_pad=1, precision="fp32"),
)


class Parts:
    """Everything that one run of the loop is made of."""

    def __init__(self, config: TrainConfig = CONFIG, env: DotEnv | None = None) -> None:
        self.config = config
        self.env = env or DotEnv()
        self.randomness = Randomness(config.seed)
        space, actions = self.env.observation_space, self.env.action_space
        self.agent: DDPG = make_agent(
            config.agent, space, actions, frame_stack=3, seed=self.randomness.agent, device=CPU
        )
        self.replay = ReplayBuffer(config.replay, space, actions, capacity=config.steps)
        self.progress = Progress()
        self.update: Update = update_from_host(self.agent, self.replay, self.randomness, config)
        self.collector = Collector(
            InProcessEnvs(self.env), self.replay, [FrameStack(3, ("image",), CPU)]
        )

    def moments(self) -> Iterator[StepResult]:
        return train(
            self.collector, self.agent, self.update, self.progress, self.randomness, self.config
        )

    def run(self) -> list[StepResult]:
        return list(self.moments())

    def weights(self) -> torch.Tensor:
        return torch.cat([p.detach().flatten() for p in self.agent.networks.parameters()])


@pytest.mark.parametrize("hundredths", [0, 25, 50, 100, 115, 200])
def test_updates_per_step_are_held_exactly(hundredths: int) -> None:
    parts = Parts(dataclasses.replace(CONFIG, updates_per_step=hundredths / 100))
    for moment in parts.run():
        assert moment.updates == max(0, (moment.step - 20) * hundredths // 100)
    assert moment.step == 60


def stopped_after(update: int, parts: Parts) -> StepResult:
    """The last thing that is told if a signal comes within that update."""
    stop, whole = False, parts.update

    def stopping() -> dict[str, torch.Tensor]:
        nonlocal stop
        stop = stop or parts.progress.updates == update
        return whole()

    arguments = (
        parts.collector,
        parts.agent,
        stopping,
        parts.progress,
        parts.randomness,
        parts.config,
    )
    for moment in train(*arguments, lambda: stop):
        if stop:
            return moment
    raise AssertionError("it ran to its end")


MANY = dataclasses.replace(
    CONFIG,
    updates_per_step=7.0,
    agent=dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.0, noise_steps=60),
)


@cache
def weights_of_a_whole_run(repeat: int) -> torch.Tensor:
    whole = Parts(dataclasses.replace(MANY, action_repeat=repeat))
    whole.run()
    return whole.weights()


@pytest.mark.parametrize(
    ("step", "repeat"),
    [
        (31, 1),
        (60, 1),
        (45, 3),
        *(pytest.param(*case, marks=pytest.mark.long)
          for case in ((30, 1), (45, 1), (30, 3), (31, 3), (60, 3))),
    ],
)  # fmt: skip
def test_a_stop_waits_for_no_more_than_one_update(step: int, repeat: int) -> None:
    """And what was left of a step is learnt as it would have been when the run goes on."""
    settings = dataclasses.replace(MANY, action_repeat=repeat)
    step += -step % repeat
    parts = Parts(settings)
    due = updates_due(step - 20, 7.0)
    told = stopped_after(due - 5, parts)
    assert (told.step, told.updates, parts.progress.updates) == (step, due - 4, due - 4)
    first, *_ = moments = parts.run()
    assert (first.step, first.updates, first.episodes) == (step, due, ())
    assert "critic_loss" in first.learning
    assert moments[-1].step == 60
    assert parts.progress.updates == 7 * 40
    assert torch.equal(parts.weights(), weights_of_a_whole_run(repeat))


def test_beside_the_environments_a_stop_waits_for_the_step() -> None:
    """What was left would be learnt later, from more than was there."""
    parts = Parts(dataclasses.replace(MANY, synchronous=False))
    told = stopped_after(65, parts)
    assert told.updates == 70
    assert parts.run()[0].step == told.step + 1


def test_who_is_stopped_in_what_was_left_takes_no_step() -> None:
    parts = Parts(MANY)
    assert stopped_after(65, parts).updates == 66
    assert stopped_after(67, parts).updates == 68
    assert parts.progress.step == 30
    stopping = train(
        parts.collector,
        parts.agent,
        parts.update,
        parts.progress,
        parts.randomness,
        MANY,
        lambda: True,
    )
    assert next(stopping).step == 30
    assert parts.progress.updates == 68


def test_what_is_sampled_on_a_gpu_depends_on_the_updates_made() -> None:
    seeds = [Randomness(seed).on_device(updates) for seed in (0, 1) for updates in (0, 1, 500)]
    assert len(set(seeds)) == 6
    assert Randomness(0).on_device(500) == seeds[2]


def test_a_ratio_is_taken_as_it_is_written() -> None:
    """600 times 0.57 is 342; of floats it is a little less."""
    for hundredths in range(300):
        for steps in (1, 20, 100, 600, 1_000_000):
            assert updates_due(steps, hundredths / 100) == steps * hundredths // 100
    assert updates_due(-5, 0.5) <= 0


def test_the_agent_is_told_the_step() -> None:
    """On which its noise depends, when acting and when learning."""
    agent = dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.0, noise_steps=60)
    parts = Parts(dataclasses.replace(CONFIG, agent=agent, action_repeat=2))
    act, learn, told = parts.agent.act, parts.agent.learn, []
    parts.agent.act = lambda *a, **k: (told.append(parts.agent.step), act(*a, **k))[1]  # type: ignore[method-assign]
    parts.agent.learn = lambda b, d: (told.append(parts.agent.step), learn(b, d))[1]  # type: ignore[method-assign]
    parts.run()
    assert told[:4] == [10, 12, 14, 16]  # a step of the loop is two of the environment
    assert max(told) == 58
    assert parts.agent.config.noise(parts.agent.step) == pytest.approx(1 - 58 / 60)


def test_yields_every_step_and_tells_of_each_episode() -> None:
    moments = Parts().run()
    assert [m.step for m in moments] == list(range(1, 61))
    assert [m.step for m in moments if m.episodes] == [10, 20, 30, 40, 50, 60]
    assert all(e.length == 10 for m in moments for e in m.episodes)
    assert [m.step for m in moments if m.learning] == list(range(21, 61))


@pytest.mark.parametrize("synchronous", [True, False])
@pytest.mark.parametrize("on_gpu", [True, False])
def test_a_gpu_is_told_what_to_learn_before_its_actions_are_waited_for(
    synchronous: bool, on_gpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = Parts(dataclasses.replace(CONFIG, synchronous=synchronous))
    order: list[str] = []
    update, act = parts.update, parts.collector.act
    parts.update = lambda: (order.append("learn"), update())[1]
    parts.collector.act = lambda actions: (order.append("act"), act(actions))[1]  # type: ignore[method-assign, func-returns-value]

    class OnItsWay(Fetched):
        def __init__(self, tensor: torch.Tensor) -> None:
            super().__init__(tensor)
            self.under_way = on_gpu

        def wait(self) -> torch.Tensor:
            order.append("wait")
            return self._there

    monkeypatch.setattr(loop, "Fetched", OnItsWay)
    expected = ["wait", "act", "learn"]
    if on_gpu and not synchronous:
        expected = ["learn", "wait", "act"]
    for moment in parts.moments():
        if 30 <= moment.step < 60:
            assert order == expected
        order.clear()
    assert moment.updates == 40


def test_random_actions_come_first_and_fill_the_box() -> None:
    parts = Parts(dataclasses.replace(CONFIG, steps=2000, random_steps=2000, seed_steps=2000))
    parts.run()
    actions = parts.replay.sample(4000, np.random.default_rng(0)).action.numpy()
    assert actions.min() < -0.98
    assert actions.max() > 0.98
    assert abs(actions.mean()) < 0.1
    assert abs(actions.std() - 1 / np.sqrt(3)) < 0.05


@pytest.mark.parametrize(("truly", "expected"), [(True, 0.0), (False, 0.99)])
def test_a_true_end_has_no_future_and_a_time_limit_has(truly: bool, expected: float) -> None:
    parts = Parts(env=DotEnv(ends_truly=truly))
    parts.run()
    batch = parts.replay.sample(2000, np.random.default_rng(0))
    last = batch.observation["joint"][:, 1] == 9  # the step before the end
    assert last.any()
    assert torch.allclose(batch.discount[last], torch.tensor(expected))


def test_same_seed_same_weights_and_another_seed_others() -> None:
    first, second = Parts(), Parts()
    other = Parts(dataclasses.replace(CONFIG, seed=1))
    for parts in (first, second, other):
        parts.run()
    assert torch.equal(first.weights(), second.weights())
    assert not torch.equal(first.weights(), other.weights())


def test_the_actors_stack_is_what_replay_samples() -> None:
    parts = Parts(dataclasses.replace(CONFIG, steps=10, seed_steps=10))
    env, stack = DotEnv(), FrameStack(3, ("image",), CPU)
    parts.run()
    observation, _ = env.reset(seed=parts.randomness.environment())
    stack.reset(observation)
    batch = parts.replay.sample(300, np.random.default_rng(0))
    for step in range(10):
        row = int(torch.nonzero(batch.observation["joint"][:, 1] == step)[0])
        assert torch.equal(batch.observation["image"][row], stack.observation()["image"][0])
        observation, *_ = env.step(batch.action[row].numpy())
        stack.push(observation)


def test_randomness_goes_on_from_its_state() -> None:
    first, second = Randomness(3), Randomness(4)
    first.actions.random(5)
    second.load_state_dict(first.state_dict())
    assert first.actions.random() == second.actions.random()
    assert first.batches.random() == second.batches.random()


def test_environment_seeds_fit_a_signed_32_bit_integer() -> None:
    """Many simulators take no larger seed; half of all run seeds gave a larger one."""
    seeds = [
        Randomness(seed).environment(index, restart)
        for seed in (*range(50), 2**63)
        for index, restart in ((0, 0), (0, 1), (1, 0), (7, 2))
    ]
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert len(set(seeds)) == len(seeds)


def test_an_episode_sums_what_its_steps_bring() -> None:
    episode = Episode()
    for success in (0.0, 1.0, 0.0):
        episode.add(0.5, {"success": success, "reward_terms": {"near": 0.25}})
    assert episode.metrics() == {
        "return": 1.5,
        "length": 3.0,
        "success_end": 0.0,
        "success_any": 1.0,
        "success_share": 1 / 3,
        "reward/near": 0.75,
    }
    silent = Episode()
    silent.add(1.0, {})
    assert silent.metrics() == {"return": 1.0, "length": 1.0}
    failed = {"success_end": 0.0, "success_any": 0.0, "success_share": 0.0}
    assert silent.metrics(reports_success=True) == silent.metrics() | failed
    assert mean_metrics([silent, silent], reports_success=True) == silent.metrics() | failed
    assert mean_metrics([silent, episode])["success_any"] == 0.5


def test_success_is_shared_among_the_steps_that_report_it() -> None:
    episode = Episode()
    for info in ({}, {"success": True}, {}, {"success": False}, {"success": True}):
        episode.add(0.0, info)
    assert episode.metrics()["success_share"] == 2 / 3
    assert episode.metrics()["success_end"] == 1.0
    episode.add(0.0, {})  # the last step does not say so
    assert (episode.metrics()["success_end"], episode.metrics()["success_any"]) == (0.0, 1.0)


def test_a_frame_that_is_refilled_does_not_change_the_stack() -> None:
    """A camera driver may hand out one and the same array again and again."""
    buffer = np.zeros((2, 2, 1), np.uint8)
    stack = FrameStack(3, ("camera",), CPU)
    stack.reset({"camera": buffer})
    for value in (1, 2):
        buffer[:] = value
        stack.push({"camera": buffer})
    assert stack.observation()["camera"][0, :, 0, 0, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize("pad", [0, 1])
def test_shifted_where_they_are_copied_pictures_are_learnt_from_alike(pad: int) -> None:
    agent = dataclasses.replace(CONFIG.agent, shift_pad=pad)
    parts, twin = (Parts(dataclasses.replace(CONFIG, agent=agent)) for _ in range(2))
    twin.update = lambda: twin.agent.update(twin.replay.sample(8, twin.randomness.batches))
    parts.run()
    twin.run()
    assert torch.equal(parts.weights(), twin.weights())


NOISES = [
    CONFIG.agent,
    dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.1, noise_steps=60),
]


@pytest.mark.parametrize("agent", NOISES, ids=["fixed", "scheduled"])
def test_on_the_device_the_same_is_learnt_from_the_same_batch(agent: MERLConfig) -> None:
    """What a GPU does, on the CPU: the twin learns from each batch on the host's way."""
    parts = Parts(dataclasses.replace(CONFIG, agent=agent))
    twin = Parts(parts.config).agent
    copy = OnDevice(parts.replay.rings, CPU)
    on_device = UpdateOnDevice(parts.agent, copy, 8, seed=5)
    same = torch.Generator().manual_seed(5)

    def both() -> dict[str, torch.Tensor]:
        found = on_device()
        twin.step = parts.agent.step
        expected = twin.update(copy.sample(8, same))
        for name, value in found.items():
            assert torch.equal(value, expected[name]), name
        return found

    parts.update = both
    told = [moment for moment in parts.run() if moment.learning]
    assert len(told) == 40
    for one, other in zip(
        parts.agent.networks.parameters(), twin.networks.parameters(), strict=True
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize("agent", NOISES, ids=["fixed", "scheduled"])
def test_from_a_batch_that_is_brought_over_the_same_is_learnt(agent: MERLConfig) -> None:
    """What a GPU does that does not hold the replay, on the CPU."""
    parts, twin = (Parts(dataclasses.replace(CONFIG, agent=agent)) for _ in range(2))
    replay, batches = parts.replay, parts.randomness.batches
    parts.update = UpdateFromHost(parts.agent, lambda: replay.sample(8, batches))
    for each in (parts, twin):
        assert each.run()[-1].updates == 40
    assert torch.equal(parts.weights(), twin.weights())


def test_a_step_reports_the_metrics_of_all_its_updates() -> None:
    """With the actor in every second update, one of three updates may be the last without it."""
    agent = dataclasses.replace(CONFIG.agent, actor_every=2)
    parts = Parts(dataclasses.replace(MANY, updates_per_step=3.0, agent=agent, steps=24))
    learning = [moment.learning for moment in parts.run() if moment.learning]
    assert len(learning) == 4
    assert all({"critic_loss", "actor_loss"} <= each.keys() for each in learning)
