from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from merl.accelerate.cuda_graph import UpdateFromHost, UpdateOnDevice
from merl.accelerate.device_replay import DeviceReplay
from merl.acting.environments import InProcessEnvs
from merl.acting.rollout import Episode, Fetched, FrameStack, mean_metrics
from merl.agents import make_agent
from merl.agents.ddpg import DDPG
from merl.agents.merl import MERLConfig
from merl.config import TrainConfig
from merl.core import UpdatePlan
from merl.modalities import Image, modalities_of
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
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
from merl.training.updating import plain_update, update_on_cpu
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


class SmallRun:
    """A small run of the loop, with all of its parts."""

    def __init__(self, config: TrainConfig = CONFIG, env: DotEnv | None = None) -> None:
        self.config = config
        self.env = env or DotEnv()
        self.randomness = Randomness(config.seed)
        space, actions = self.env.observation_space, self.env.action_space
        self.agent: DDPG = make_agent(
            "merl",
            config.agent,
            space,
            actions,
            frame_stack=3,
            seed=self.randomness.agent,
            device=CPU,
        )
        spec = ReplaySpec.of(config.replay, space, actions, capacity=config.steps)
        self.replay = ReplayBuffer(spec)
        self.progress = Progress()
        self.update: Update = update_on_cpu(self.agent, self.replay, self.randomness, config)
        self.collector = Collector(
            InProcessEnvs(self.env),
            self.replay,
            [FrameStack(modalities_of(self.env.observation_space), 3, CPU)],
        )

    def results(self) -> Iterator[StepResult]:
        return train(
            self.collector, self.agent, self.update, self.progress, self.randomness, self.config
        )

    def finish(self) -> list[StepResult]:
        return list(self.results())

    def weights(self) -> torch.Tensor:
        return torch.cat([p.detach().flatten() for p in self.agent.networks.parameters()])


@pytest.mark.parametrize("hundredths", [0, 25, 50, 100, 115, 200])
def test_the_number_of_updates_follows_updates_per_step_exactly(hundredths: int) -> None:
    run = SmallRun(dataclasses.replace(CONFIG, updates_per_step=hundredths / 100))
    for result in run.finish():
        assert result.updates == max(0, (result.step - 20) * hundredths // 100)
    assert result.step == 60


def stopped_after(number: int, run: SmallRun) -> StepResult:
    """Return the last result if a signal arrives during update `number`, counted from 0."""
    stop, update = False, run.update

    def update_with_signal(step: int) -> dict[str, torch.Tensor]:
        nonlocal stop
        stop = stop or run.progress.updates == number
        return update(step)

    arguments = (
        run.collector,
        run.agent,
        update_with_signal,
        run.progress,
        run.randomness,
        run.config,
    )
    for result in train(*arguments, lambda: stop):
        if stop:
            return result
    raise AssertionError("the run was not stopped")


MANY = dataclasses.replace(
    CONFIG,
    updates_per_step=7.0,
    agent=dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.0, noise_steps=60),
)


@cache
def weights_without_stop(repeat: int) -> torch.Tensor:
    run = SmallRun(dataclasses.replace(MANY, action_repeat=repeat))
    run.finish()
    return run.weights()


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
def test_a_stop_waits_for_at_most_one_update(step: int, repeat: int) -> None:
    """The resumed run makes the remaining updates; it ends as a run without a stop does."""
    settings = dataclasses.replace(MANY, action_repeat=repeat)
    step += -step % repeat
    run = SmallRun(settings)
    due = updates_due(step - 20, 7.0)
    stopped = stopped_after(due - 5, run)
    assert (stopped.step, stopped.updates, run.progress.updates) == (step, due - 4, due - 4)
    first, *_ = results = run.finish()
    assert (first.step, first.updates, first.episodes) == (step, due, ())
    assert "critic_loss" in first.learning
    assert results[-1].step == 60
    assert run.progress.updates == 7 * 40
    assert torch.equal(run.weights(), weights_without_stop(repeat))


def test_without_synchronous_a_stop_waits_for_the_whole_step() -> None:
    """The resumed run would make the remaining updates from a fuller replay."""
    run = SmallRun(dataclasses.replace(MANY, synchronous=False))
    stopped = stopped_after(65, run)
    assert stopped.updates == 70
    assert run.finish()[0].step == stopped.step + 1


def test_a_stop_during_the_remaining_updates_takes_no_step() -> None:
    run = SmallRun(MANY)
    assert stopped_after(65, run).updates == 66
    assert stopped_after(67, run).updates == 68
    assert run.progress.step == 30
    stopping = train(
        run.collector,
        run.agent,
        run.update,
        run.progress,
        run.randomness,
        MANY,
        lambda: True,
    )
    assert next(stopping).step == 30
    assert run.progress.updates == 68


def test_the_sampling_seed_of_a_gpu_depends_on_the_number_of_updates() -> None:
    seeds = [Randomness(seed).on_device(updates) for seed in (0, 1) for updates in (0, 1, 500)]
    assert len(set(seeds)) == 6
    assert Randomness(0).on_device(500) == seeds[2]


def test_updates_due_is_exact_for_decimal_ratios() -> None:
    """600 * 0.57 is 342, but slightly less in floating-point numbers."""
    for hundredths in range(300):
        for steps in (1, 20, 100, 600, 1_000_000):
            assert updates_due(steps, hundredths / 100) == steps * hundredths // 100
    assert updates_due(-5, 0.5) <= 0


def test_the_agent_receives_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """The noise depends on the step, in acting and in learning."""
    agent = dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.0, noise_steps=60)
    run = SmallRun(dataclasses.replace(CONFIG, agent=agent, action_repeat=2))
    act, plan = run.agent.act, run.agent.plan
    steps: list[int] = []
    deviations: list[float] = []

    def recorded_act(observation: Any, *, explore: bool, step: int) -> torch.Tensor:
        steps.append(step)
        return act(observation, explore=explore, step=step)

    def recorded_plan(step: int) -> UpdatePlan:
        steps.append(step)
        planned = plan(step)
        deviations.append(planned.noise_std)
        return planned

    monkeypatch.setattr(run.agent, "act", recorded_act)
    monkeypatch.setattr(run.agent, "plan", recorded_plan)
    run.finish()
    assert steps[:4] == [10, 12, 14, 16]  # one step of the loop is two environment steps
    assert max(steps) == 58
    assert deviations[-1] == pytest.approx(1 - 58 / 60)


def test_the_loop_yields_every_step_and_reports_each_episode() -> None:
    results = SmallRun().finish()
    assert [r.step for r in results] == list(range(1, 61))
    assert [r.step for r in results if r.episodes] == [10, 20, 30, 40, 50, 60]
    assert all(e.length == 10 for r in results for e in r.episodes)
    assert [r.step for r in results if r.learning] == list(range(21, 61))


@pytest.mark.parametrize("synchronous", [True, False])
@pytest.mark.parametrize("on_gpu", [True, False])
def test_on_a_gpu_updates_are_launched_before_waiting_for_the_actions(
    synchronous: bool, on_gpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = SmallRun(dataclasses.replace(CONFIG, synchronous=synchronous))
    order: list[str] = []
    update, act = run.update, run.collector.act

    def recorded_update(step: int) -> dict[str, torch.Tensor]:
        order.append("learn")
        return update(step)

    def recorded_act(actions: NDArray[np.float32]) -> None:
        order.append("act")
        act(actions)

    run.update = recorded_update
    monkeypatch.setattr(run.collector, "act", recorded_act)

    class RecordedFetch(Fetched):
        def __init__(self, tensor: torch.Tensor) -> None:
            super().__init__(tensor)
            self.under_way = on_gpu

        def wait(self) -> torch.Tensor:
            order.append("wait")
            return self._result

    monkeypatch.setattr(loop, "Fetched", RecordedFetch)
    expected = ["wait", "act", "learn"]
    if on_gpu and not synchronous:
        expected = ["learn", "wait", "act"]
    for result in run.results():
        if 30 <= result.step < 60:
            assert order == expected
        order.clear()
    assert result.updates == 40


def test_the_first_actions_are_uniformly_random_in_the_box() -> None:
    run = SmallRun(dataclasses.replace(CONFIG, steps=2000, random_steps=2000, seed_steps=2000))
    run.finish()
    actions = run.replay.sample(4000, np.random.default_rng(0)).action.numpy()
    assert actions.min() < -0.98
    assert actions.max() > 0.98
    assert abs(actions.mean()) < 0.1
    assert abs(actions.std() - 1 / np.sqrt(3)) < 0.05


@pytest.mark.parametrize(("terminates", "expected"), [(True, 0.0), (False, 0.99)])
def test_the_discount_is_zero_at_a_termination_but_not_at_a_time_limit(
    terminates: bool, expected: float
) -> None:
    run = SmallRun(env=DotEnv(ends_truly=terminates))
    run.finish()
    batch = run.replay.sample(2000, np.random.default_rng(0))
    last = batch.observation["joint"][:, 1] == 9  # the step before the end
    assert last.any()
    assert torch.allclose(batch.discount[last], torch.tensor(expected))


def test_the_seed_determines_the_weights() -> None:
    first, second = SmallRun(), SmallRun()
    other = SmallRun(dataclasses.replace(CONFIG, seed=1))
    for run in (first, second, other):
        run.finish()
    assert torch.equal(first.weights(), second.weights())
    assert not torch.equal(first.weights(), other.weights())


def test_the_frame_stack_for_acting_equals_that_of_the_replay() -> None:
    run = SmallRun(dataclasses.replace(CONFIG, steps=10, seed_steps=10))
    env = DotEnv()
    stack = FrameStack(modalities_of(env.observation_space), 3, CPU)
    run.finish()
    observation, _ = env.reset(seed=run.randomness.environment())
    stack.reset(observation)
    batch = run.replay.sample(300, np.random.default_rng(0))
    for step in range(10):
        row = int(torch.nonzero(batch.observation["joint"][:, 1] == step)[0])
        assert torch.equal(batch.observation["image"][row], stack.observation()["image"][0])
        observation, *_ = env.step(batch.action[row].numpy())
        stack.push(observation)


def test_randomness_restores_its_state() -> None:
    first, second = Randomness(3), Randomness(4)
    first.actions.random(5)
    second.load_state_dict(first.state_dict())
    assert first.actions.random() == second.actions.random()
    assert first.batches.random() == second.batches.random()


def test_environment_seeds_fit_a_signed_32_bit_integer() -> None:
    """Many simulators do not accept a larger seed."""
    seeds = [
        Randomness(seed).environment(index, restart)
        for seed in (*range(50), 2**63)
        for index, restart in ((0, 0), (0, 1), (1, 0), (7, 2))
    ]
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert len(set(seeds)) == len(seeds)


def test_an_episode_sums_its_steps() -> None:
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
    assert mean_metrics([silent, episode], reports_success=True)["success_any"] == 0.5


def test_the_success_share_counts_only_steps_with_a_report() -> None:
    episode = Episode()
    for info in ({}, {"success": True}, {}, {"success": False}, {"success": True}):
        episode.add(0.0, info)
    assert episode.metrics()["success_share"] == 2 / 3
    assert episode.metrics()["success_end"] == 1.0
    episode.add(0.0, {})  # the last step has no report
    assert (episode.metrics()["success_end"], episode.metrics()["success_any"]) == (0.0, 1.0)


def test_a_reused_frame_does_not_change_the_stack() -> None:
    """A camera driver may return the same array in every step."""
    buffer = np.zeros((2, 2, 1), np.uint8)
    modalities = {"camera": Image(spaces.Box(0, 255, (2, 2, 1), np.uint8))}
    stack = FrameStack(modalities, 3, CPU)
    stack.reset({"camera": buffer})
    for value in (1, 2):
        buffer[:] = value
        stack.push({"camera": buffer})
    assert stack.observation()["camera"][0, :, 0, 0, 0].tolist() == [0, 1, 2]


@pytest.mark.parametrize("pad", [0, 1])
def test_shifts_in_the_replay_and_in_the_agent_give_the_same_weights(pad: int) -> None:
    agent = dataclasses.replace(CONFIG.agent, shift_pad=pad)
    run, twin = (SmallRun(dataclasses.replace(CONFIG, agent=agent)) for _ in range(2))
    twin.update = plain_update(twin.agent, twin.replay, twin.randomness, run.config)
    run.finish()
    twin.finish()
    assert torch.equal(run.weights(), twin.weights())


NOISES = [
    CONFIG.agent,
    dataclasses.replace(CONFIG.agent, noise_std=1.0, noise_std_end=0.1, noise_steps=60),
]


@pytest.mark.parametrize("agent", NOISES, ids=["fixed", "scheduled"])
def test_updates_on_the_device_equal_those_from_the_host(agent: MERLConfig) -> None:
    """The code for a GPU runs on the CPU; the twin makes the usual update from each batch."""
    run = SmallRun(dataclasses.replace(CONFIG, agent=agent))
    twin = SmallRun(run.config).agent
    copy = DeviceReplay(run.replay, CPU)
    on_device = UpdateOnDevice(run.agent, copy, 8, seed=5)
    same = torch.Generator().manual_seed(5)

    def compared_update(step: int) -> dict[str, torch.Tensor]:
        metrics = on_device(step)
        expected = twin.update(copy.sample(8, same), step=step)
        for name, value in metrics.items():
            assert torch.equal(value, expected[name]), name
        return metrics

    run.update = compared_update
    results = [result for result in run.finish() if result.learning]
    assert len(results) == 40
    for one, other in zip(run.agent.networks.parameters(), twin.networks.parameters(), strict=True):
        assert torch.equal(one, other)


def test_an_update_from_the_host_takes_a_changing_number_of_demonstrations() -> None:
    run, twin = (SmallRun(CONFIG) for _ in range(2))
    run.finish()
    twin.finish()
    batch = run.replay.sample(8, np.random.default_rng(0))
    batches = [dataclasses.replace(batch, shown=batch.action[:n]) for n in (4, 4, 3, 1)]
    update = UpdateFromHost(run.agent, iter(batches).__next__)
    for step, each in enumerate(batches):
        metrics, expected = update(step), twin.agent.update(each, step=step)
        assert all(torch.equal(metrics[name], expected[name]) for name in expected)
    assert torch.equal(run.weights(), twin.weights())


@pytest.mark.parametrize("agent", NOISES, ids=["fixed", "scheduled"])
def test_updates_with_batches_copied_from_the_host_give_the_same_weights(agent: MERLConfig) -> None:
    """The code for a GPU without a copy of the replay runs on the CPU."""
    run, twin = (SmallRun(dataclasses.replace(CONFIG, agent=agent)) for _ in range(2))
    replay, batches = run.replay, run.randomness.batches
    run.update = UpdateFromHost(run.agent, lambda: replay.sample(8, batches))
    for each in (run, twin):
        assert each.finish()[-1].updates == 40
    assert torch.equal(run.weights(), twin.weights())
