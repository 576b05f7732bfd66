"""A person corrects actions while a run trains; these steps become demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray

import merl
from merl.core import CallbackFailed, MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.recorder import Recorder
from merl.evaluation.demonstrating import record_episodes
from merl.replay import ReplayBuffer
from merl.training.trainer import Trainer
from toy import DotEnv

TINY: dict[str, Any] = {"preset": "smoke", "random_steps": 0, "seed_steps": 20, "threads": 1}
TINY |= {"eval.every": 0, "progress": False, "updates_per_step": 0.5, "replay.batch_size": 8}
TINY |= {"agent.keys": ("joint",), "agent.hidden_dim": 8, "agent.latent_dim": 8}


class Person(merl.Callback):
    """Corrects the steps of the run that are named, to 0.5; keeps what it has seen."""

    def __init__(self, *steps: int) -> None:
        self.steps, self.step, self.batches = steps, 0, list[NDArray[np.float32]]()

    def on_start(self, trainer: Trainer) -> None:
        self.trainer, self.step = trainer, trainer.progress.step

    def correct(self, actions: NDArray[np.float32]) -> NDArray[np.float32] | None:
        step, self.step = self.step, self.step + 1
        return np.full_like(actions, 0.5) if step in self.steps else None

    def on_end(self, outcome: Any) -> None:
        self.executed = self.trainer.replay.arrays["action"].copy()


def record(folder: Path, task: str, env: DotEnv) -> Path:
    """Record two episodes in which nothing moves."""
    recorder = Recorder(folder, task, "a test", env.observation_space, env.action_space)
    for episode in record_episodes(lambda _: np.zeros(1), env, episodes=2, failures=True):
        recorder.add(episode)
    return folder


@pytest.fixture
def demos(tmp_path: Path) -> Path:
    return record(tmp_path / "demos", "toy:DotEnv", DotEnv())


def train(demos: Path | None, person: merl.Callback, steps: int = 40, **values: Any) -> Path:
    run, task = Path(values.pop("run", "run")), values.pop("task", "toy:DotEnv")
    given = TINY | values
    merl.train(task, demos=demos, steps=steps, run_dir=str(run), callbacks=[person], **given)
    return run


class Seeing(DotEnv):
    """The dot, seen by depth cameras of two types."""

    def __init__(self) -> None:
        super().__init__()
        depths = {
            "metres": spaces.Box(0.1, 2.0, (24, 24, 1), np.float32),
            "millimetres": spaces.Box(0, 5000, (24, 24, 1), np.uint16),
        }
        self.observation_space = spaces.Dict({"joint": self.observation_space["joint"], **depths})

    def _observe(self) -> dict[str, Any]:
        metres = np.linspace(0, 2.2, 576, dtype=np.float32).reshape(24, 24, 1) + np.float32(self.x)
        millimetres = np.rint(1000 * metres.clip(0, 5)).astype(np.uint16)
        joint = super()._observe()["joint"]
        return {"joint": joint, "metres": metres, "millimetres": millimetres}


@pytest.fixture(autouse=True)
def _in_the_folder_of_the_toy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    monkeypatch.chdir(tmp_path)


def test_corrected_steps_are_executed_and_become_demonstrations(demos: Path) -> None:
    """Steps 3 to 5 and 8 to 11; an episode has ten steps, so the second stretch is cut in two."""
    person = Person(3, 4, 5, 8, 9, 10, 11)
    run = train(demos, person)
    found = Demonstrations.open(run / "corrections")
    assert [line.steps for line in found.lines] == [3, 2, 2]
    assert found.task == "toy:DotEnv"
    for episode in found.episodes():
        assert (episode.actions == 0.5).all()
        assert (episode.intended == 0.5).all()
        moved = np.diff(episode.observations["joint"][:, 0])
        bounded = np.abs(episode.observations["joint"][1:, 0]) == 1
        np.testing.assert_allclose(moved[~bounded], 0.15, atol=1e-6)
    first = next(found.episodes())
    assert first.observations["joint"][:, 1].tolist() == [3, 4, 5, 6]  # the count of steps
    assert np.count_nonzero(person.executed == np.float32(0.5)) == 7


def test_actions_that_are_corrected_in_place_become_demonstrations(demos: Path) -> None:
    class Pushing(Person):
        def correct(self, actions: NDArray[np.float32]) -> NDArray[np.float32] | None:
            step, self.step = self.step, self.step + 1
            if step in self.steps:
                actions[:] = 0.5
            return actions

    run = train(demos, Pushing(3, 4, 5))
    assert [line.steps for line in Demonstrations.open(run / "corrections").lines] == [3]


def test_batches_draw_corrections_as_they_draw_demonstrations(demos: Path) -> None:
    class Watching(Person):
        def on_update(self, step: int, metrics: Any) -> None:
            corrections = self.trainer._corrections
            assert corrections is not None
            source = self.trainer.setup.batches_from(self.trainer.replay, corrections)
            shown = source.sample(64, np.random.default_rng(step)).shown
            assert shown is not None
            self.batches.append(shown.numpy())

    person = Watching(*range(20))
    train(demos, person, steps=30)
    shares = [float((batch == 0.5).mean()) for batch in person.batches]
    assert 0.35 < np.mean(shares) < 0.65  # 20 of 40 steps


def test_a_resumed_run_reads_and_adds_corrections(demos: Path) -> None:
    run = train(demos, Person(1, 2), steps=20)
    person = Person(25, 26, 27)
    merl.resume(run, steps=40, callbacks=[person], progress=False)
    assert [line.steps for line in Demonstrations.open(run / "corrections").lines] == [2, 3]

    class Stopping(Person):
        def on_start(self, trainer: Trainer) -> None:
            assert trainer._corrections is not None
            assert len(trainer._corrections.replay) == 5
            super().on_start(trainer)

    merl.resume(run, steps=60, callbacks=[Stopping()], progress=False)


def test_a_stretch_in_progress_is_kept_when_the_run_is_stopped(demos: Path) -> None:
    class Leaving(Person):
        def on_step(self, result: Any) -> bool | None:
            return False if result.step == 4 else None

    run = train(demos, Leaving(2, 3, 4, 5))
    assert [line.steps for line in Demonstrations.open(run / "corrections").lines] == [2]


def test_other_runs_learn_from_the_corrections(demos: Path) -> None:
    run = train(demos, Person(*range(9)))
    train(run / "corrections", merl.Callback(), run="second")


def test_corrections_need_demonstrations_to_add_to() -> None:
    with pytest.raises(MerlError, match=r"a callback corrects actions, .* none to add to: name"):
        train(None, Person(1))
    assert not Path("run").exists()


@pytest.mark.parametrize(
    "value", [np.zeros(1), np.full((1, 1), 1.5), np.full((1, 1), np.nan), [], "left", [[0], [1, 2]]]
)
def test_corrections_that_are_no_actions_are_refused(value: Any, demos: Path) -> None:
    class Wild(merl.Callback):
        def correct(self, actions: NDArray[np.float32]) -> NDArray[np.float32]:
            return value  # type: ignore[no-any-return]

    with pytest.raises(CallbackFailed, match=r"Wild\.correct raised ValueError"):
        train(demos, Wild())


def test_a_person_who_fails_is_named(demos: Path) -> None:
    class Failing(merl.Callback):
        def correct(self, actions: NDArray[np.float32]) -> None:
            raise RuntimeError("the gamepad is gone")

    with pytest.raises(CallbackFailed, match=r"Failing\.correct raised .*the gamepad is gone"):
        train(demos, Failing())


class Comparing(Person):
    """Keeps the depth frames of the corrections and of the run, by what was seen with them."""

    def on_end(self, outcome: Any) -> None:
        corrections = self.trainer._corrections
        assert corrections is not None
        self.corrected, self.own = frames(corrections.replay), frames(self.trainer.replay)


def frames(replay: ReplayBuffer) -> dict[tuple[Any, ...], NDArray[np.int16]]:
    """Return the frames by their key and the joint vector at that time."""
    arrays = replay.arrays
    joints = arrays["observation.joint"].tolist()
    return {
        (key, *joints[at]): arrays[f"observation.{key}"][at].copy()
        for key in ("metres", "millimetres")
        for at in np.flatnonzero(arrays["timestep"])
    }


def test_depth_of_corrections_is_that_of_the_runs_own_experience(tmp_path: Path) -> None:
    task, folder = f"{__name__}:Seeing", tmp_path / "demos"
    keys: dict[str, Any] = {"agent.keys": ("joint", "metres", "millimetres")}
    keys["agent.latent_dim"] = 24
    before, after = Comparing(3, 4, 5), Comparing(22, 23)
    run = train(record(folder, task, Seeing()), before, steps=20, task=task, **keys)
    merl.resume(run, steps=40, callbacks=[after], progress=False)
    for person, observations in ((before, 4), (after, 4 + 3)):
        assert len(person.corrected) == 2 * observations
        for at, frame in person.corrected.items():
            np.testing.assert_array_equal(frame, person.own[at])


@pytest.mark.parametrize(("capacity", "expected"), [(100, 40), (12, 12)])
def test_corrections_take_no_more_memory_than_the_run_can_fill(
    capacity: int, expected: int, demos: Path
) -> None:
    class Measuring(Person):
        def on_start(self, trainer: Trainer) -> None:
            super().on_start(trainer)
            assert trainer._corrections is not None
            assert trainer._corrections.replay.spec.capacity == expected

    run = train(demos, Measuring(*range(40)), **{"replay.capacity": capacity})
    assert Demonstrations.open(run / "corrections").steps == 40
