from __future__ import annotations

import json
import random
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from dm_control import mjcf

from merl.acting.environments import InProcessEnvs
from merl.acting.generators import (
    environment_state,
    global_state,
    held_by,
    kept_generators,
    seed_global_generators,
    set_environment_state,
    set_global_state,
)
from merl.acting.workers import _Worker
from toy import DotEnv

MODULE_GENERATOR = np.random.default_rng(1)


class Drawing(DotEnv):
    shared = np.random.RandomState(2)

    def __init__(self) -> None:
        super().__init__()
        self.rng, self.python = np.random.default_rng(3), random.Random(4)
        self.torch = torch.Generator().manual_seed(5)

    def reset(self, **options: Any) -> Any:
        self.rng = np.random.default_rng(options["seed"])
        return super().reset(**options)

    def draw(self) -> list[float]:
        """Draw a number from each generator that the environment can use."""
        return [
            *drawn(),
            float(self.np_random.normal()),
            float(self.rng.normal()),
            self.python.random(),
            float(torch.rand((), generator=self.torch)),
            float(self.shared.normal()),
            float(MODULE_GENERATOR.normal()),
            float(self.action_space.sample()[0]),
            float(self.observation_space.sample()["joint"][0]),
        ]


def drawn() -> list[float]:
    return [
        float(np.random.normal()),  # noqa: NPY002
        random.random(),
        float(torch.rand(())),
    ]


def test_a_seed_determines_the_global_generators() -> None:
    several = []
    for seed in (0, 1, 0, 2**32):  # NumPy's seed has at most 32 bits
        seed_global_generators(seed)
        several.append(drawn())
    assert several[0] == several[2]
    assert not set(several[0]) & set(several[1])


def test_global_generators_are_restored_from_json() -> None:
    np.random.normal()  # noqa: NPY002 (NumPy stores the second of two numbers)
    state = json.loads(json.dumps(global_state()))
    first = drawn()
    drawn()
    set_global_state(state)
    assert drawn() == first


@pytest.mark.parametrize("wrapped", [False, True])
def test_kept_generators_restores_all_generators(wrapped: bool) -> None:
    env = Drawing()
    whole: Any = gymnasium.wrappers.TimeLimit(env, 5) if wrapped else env
    env.reset(seed=7)
    before, generator = env.draw(), env.rng
    with kept_generators(whole):
        expected = env.draw()
        env.draw()
    with kept_generators(whole):
        env.reset(seed=8)
        env.draw()
    assert env.rng is generator
    assert env.draw() == expected
    assert expected != before


def test_kept_generators_restores_after_an_error() -> None:
    env = Drawing()
    env.reset(seed=7)
    env.draw()  # this also makes the generators of the spaces
    with kept_generators(env):
        expected = env.draw()
    with pytest.raises(ZeroDivisionError), kept_generators(env):
        print(env.draw()[0] / 0)
    assert env.draw() == expected


def test_an_environment_state_of_an_earlier_checkpoint_is_restored() -> None:
    """An earlier state has no global generators, or is None."""
    env = DotEnv()
    env.reset(seed=3)
    state = environment_state(env)
    expected = env.np_random.normal()
    del state["globals"]
    set_environment_state(env, state)
    set_environment_state(env, None)
    assert env.np_random.normal() == expected


def test_the_seed_of_an_episode_seeds_the_global_generators_of_its_process() -> None:
    env = DotEnv()
    for environment in (
        lambda seed: InProcessEnvs(env).reset({0: seed}),
        lambda seed: _Worker(env, 0).reset(seed=seed),
    ):
        seeded = []
        for seed in (3, 4, 3):
            environment(seed)
            seeded.append(drawn())
        assert seeded[0] == seeded[2] != seeded[1]
        seed_global_generators(3)
        environment(None)
        assert drawn() == seeded[0]


@pytest.mark.parametrize(
    "hold",
    [lambda rng: [rng], lambda rng: {"noise": rng}, lambda rng: SimpleNamespace(rng=rng)],
    ids=["list", "dict", "object"],
)
def test_generators_in_containers_are_restored(hold: Any) -> None:
    env, rng = DotEnv(), np.random.default_rng(3)
    env.kept = hold(rng)  # type: ignore[attr-defined]
    before = rng.bit_generator.state
    with kept_generators(env):
        rng.random(5)
    assert rng.bit_generator.state == before


def test_held_by_takes_a_made_up_dict_for_no_attributes() -> None:
    physics = mjcf.Physics.from_mjcf_model(mjcf.RootElement())
    binding = physics.bind([])  # it answers to every name with an array, also to __dict__
    (only,) = held_by(SimpleNamespace(binding=binding))
    assert only is binding
