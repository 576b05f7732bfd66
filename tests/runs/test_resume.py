from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from merl.core import MerlError
from merl.envs.config import EnvConfig
from merl.experiments.presets import compose
from merl.runs.resume import merge_resume_config

RECORDED = dataclasses.replace(
    compose("smoke", "move_box"), run_dir=Path("runs/mine"), threads=2, device="cpu", minutes=7.0
)


def test_open_fields_keep_their_recorded_values() -> None:
    asked = dataclasses.replace(RECORDED, threads=None, device="auto", minutes=None)
    config, changes = merge_resume_config(RECORDED, asked)
    assert config == dataclasses.replace(RECORDED, minutes=None)
    assert changes == []


def test_harmless_changes_are_applied_and_listed() -> None:
    asked = dataclasses.replace(
        RECORDED,
        steps=2000,
        keep=5,
        minutes=3.0,
        eval=dataclasses.replace(RECORDED.eval, every=250),
        agent=dataclasses.replace(RECORDED.agent, precision="bf16"),
    )
    config, changes = merge_resume_config(RECORDED, asked)
    assert config == asked
    assert sorted(changes) == [
        "agent.precision auto -> bf16",
        "eval.every 500 -> 250",
        "keep 2 -> 5",
        "steps 1,000 -> 2,000",
    ]


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        (dataclasses.replace(RECORDED, task="lift_box"), ["task move_box -> lift_box"]),
        (compose("smoke", "move_box", "drqv2"), ["agent_name merl -> drqv2"]),
        (dataclasses.replace(RECORDED, seed=1), ["seed 0 -> 1"]),
        (
            dataclasses.replace(
                RECORDED,
                env=dataclasses.replace(RECORDED.env, image_size=64),
                replay=dataclasses.replace(RECORDED.replay, n_step=1),
                agent=dataclasses.replace(RECORDED.agent, latent_dim=64),
            ),
            ["env.image_size 32 -> 64", "replay.n_step 3 -> 1", "agent.latent_dim 128 -> 64"],
        ),
    ],
)
def test_resume_refuses_other_changes_and_names_them(asked, named) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(MerlError, match="run runs/mine cannot resume with") as caught:
        merge_resume_config(RECORDED, asked)
    for words in named:
        assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_users_environment_resumes_with_any_env_config_of_merls_own_tasks() -> None:
    asked = compose("smoke", "Pendulum-v1", "ddpg")
    recorded = dataclasses.replace(asked, env=EnvConfig(image_size=48, renderer="gl"))
    assert asked.env != recorded.env
    assert merge_resume_config(recorded, asked) == (recorded, [])
