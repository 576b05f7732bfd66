"""Runs of earlier versions of merl, whose configs name values that no longer exist."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from merl.core import CONFIG_FILE, MerlError
from merl.experiments.presets import compose
from merl.runs.resume import merge_resume_config
from merl.runs.run import Run

IMAGE = spaces.Box(0, 255, (32, 32, 3), np.uint8)
VECTOR = spaces.Box(-np.inf, np.inf, (5,), np.float32)
ACTION = spaces.Box(-1.0, 1.0, (9,), np.float32)
CAMERA = spaces.Dict({"image": IMAGE, "proprio": VECTOR})
STATE = spaces.Dict({"state": VECTOR})


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that records a run with a changed environment config."""
    for name in ("commit", "machine", "package_versions"):
        monkeypatch.setattr(f"merl.runs.run.{name}", dict)

    def record(task: str, space: spaces.Dict, folder: str = "run", **env: Any) -> Path:
        agent = "merl_state" if space is STATE else "merl"
        config = dataclasses.replace(compose("smoke", task, agent), run_dir=tmp_path / folder)
        with Run.begin(config, space, ACTION):
            pass
        file = tmp_path / folder / CONFIG_FILE
        plain = json.loads(file.read_text())
        plain["config"]["env"].update(env)
        file.write_text(json.dumps(plain))
        return tmp_path / folder

    return record


def test_a_run_that_saw_images_of_a_removed_renderer_is_refused(recorded: Any) -> None:
    with pytest.raises(MerlError, match=r"renderer 'warp' no longer exists: .*raster") as error:
        Run.open(recorded("reach_duplo", CAMERA, renderer="warp"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [("reward", "near"), ("reward", "far"), ("reward", "both"), ("floor", "smooth")],
)
def test_a_run_of_a_removed_form_of_a_task_is_refused(
    recorded: Any, field: str, value: str
) -> None:
    with pytest.raises(MerlError, match=f"{field} '{value}' no longer exists: train") as error:
        Run.open(recorded("move_box", STATE, **{field: value}))
    assert "\n" not in str(error.value)


def test_a_run_on_the_remaining_floor_is_opened(recorded: Any) -> None:
    folder = recorded("move_box", CAMERA, floor="rough", reward="staged")
    run = Run.open(folder)
    assert run.config.env == dataclasses.replace(compose("smoke", "move_box").env, reward="staged")
    with pytest.raises(MerlError, match="floor 'wet' is unknown"):
        Run.open(recorded("lift_box", CAMERA, folder="other", floor="wet"))


@pytest.mark.parametrize(
    ("task", "space"), [("move_box", STATE), ("Pendulum-v1", STATE), ("Pendulum-v1", CAMERA)]
)
def test_a_removed_renderer_is_replaced_if_the_agent_used_no_image_of_it(
    recorded: Any, task: str, space: spaces.Dict
) -> None:
    run = Run.open(recorded(task, space, renderer="warp"))
    assert run.config.env.renderer == "raster"
    config, changes = merge_resume_config(run.config, run.config)
    assert (config.env, changes) == (run.config.env, [])


def test_a_users_environment_resumes_with_any_env_config_of_merls_own_tasks(
    recorded: Any,
) -> None:
    run = Run.open(recorded("Pendulum-v1", CAMERA, image_size=48, renderer="gl"))
    asked = dataclasses.replace(compose("smoke", "Pendulum-v1"), run_dir=run.path)
    assert asked.env != run.config.env
    assert merge_resume_config(run.config, asked) == (run.config, [])
