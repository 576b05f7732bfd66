"""A person records demonstrations with keyboard or gamepad; SDL's dummy driver is the screen."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from merl.cli import main
from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.envs import make_env
from merl.envs.expert_policy import HandMotion
from merl.evaluation.teleoperation import PAIRS, Window, record_by_hand
from toy import DotEnv

pygame = pytest.importorskip("pygame")


@pytest.fixture(autouse=True)
def _no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def window() -> Iterator[Window]:
    made = Window("keyboard", ["x"])
    yield made
    made.close()


def press(*keys: int, release: bool = False) -> None:
    for key in keys:
        pygame.event.post(pygame.event.Event(pygame.KEYUP if release else pygame.KEYDOWN, key=key))


def acting(window: Window, plan: dict[int, list[int]]) -> Any:
    """Return a map from axes to actions that presses the keys of `plan` after each of its calls."""
    calls = iter(range(10**6))

    def action_for(command: NDArray[np.float64]) -> NDArray[np.float32]:
        press(*plan.get(next(calls), []))
        return command.astype(np.float32)

    return action_for


def record(window: Window, plan: dict[int, list[int]], episodes: int = 1) -> list[Any]:
    made = record_by_hand(window, acting(window, plan), DotEnv(), episodes, 500.0, failures=True)
    return list(made)


def test_a_held_key_moves_its_axis_until_it_is_released(window: Window) -> None:
    up, down = (pygame.key.key_code(key) for key in PAIRS[0])
    press(up)
    assert window.read().tolist() == [1.0]
    assert window.read().tolist() == [1.0]
    press(pygame.K_LSHIFT)
    assert window.read().tolist() == [0.4]
    press(up, pygame.K_LSHIFT, release=True)
    press(down)
    assert window.read().tolist() == [-1.0]


def test_episodes_hold_what_the_person_did(window: Window) -> None:
    (episode,) = record(window, {2: [pygame.K_d]})
    assert episode.actions[:, 0].tolist() == [0, 0, 0, *[1] * 7]
    assert len(episode) == DotEnv.length
    np.testing.assert_array_equal(episode.intended, episode.actions)


def test_enter_keeps_an_episode_backspace_discards_it_and_escape_finishes(window: Window) -> None:
    plan = {3: [pygame.K_RETURN], 5: [pygame.K_BACKSPACE], 11: [pygame.K_ESCAPE]}
    found = record(window, plan, episodes=9)
    # After a key, the step in progress is the last one.
    assert [len(episode) for episode in found] == [5]
    assert window.finished


def test_the_command_records_in_a_window(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Window, "begin", lambda self: setattr(self, "_ends", None))
    read = Window.read

    def pressing(self: Window) -> NDArray[np.float64]:
        press(pygame.K_e)
        return read(self)

    monkeypatch.setattr(Window, "read", pressing)
    options = ["--from", "keyboard", "--episodes", "1", "--failures", "--hz", "500"]
    assert main(["demos", "record", "reach_duplo", "--preset", "smoke", *options]) == 0
    found = Demonstrations.open(tmp_path / "demos/reach_duplo")
    assert (found.source, found.lines[0].steps) == ("keyboard", 250)
    state = next(found.episodes()).observations
    assert set(state) == {"image", "proprio", "state"}


@pytest.mark.parametrize(("axis", "along"), [(0, 0), (1, 1), (2, 2)])
def test_a_command_moves_the_hand_along_its_axis(axis: int, along: int) -> None:
    env = make_env("reach_duplo", observations=("proprio",))
    env.reset(seed=0)
    motion, command = HandMotion(env), np.zeros(5)
    command[axis] = 1.0
    site = env.physics.bind(env.task.robot.hand.pinch_site)
    before = np.array(site.xpos)
    for _ in range(15):
        env.step(motion(command))
    moved = np.array(site.xpos) - before
    assert 0.08 < moved[along] < 0.2
    assert np.abs(np.delete(moved, along)).max() < 0.03


def test_sticks_come_first_and_then_pairs_of_buttons(window: Window) -> None:
    """No gamepad is connected: this one stands for it."""
    axes, buttons = [0.5, -0.25, 0.1, 1.0, -1.0, -1.0], [0, 1, 0, 0]
    stick: Any = SimpleNamespace(
        get_numaxes=lambda: len(axes),
        get_axis=axes.__getitem__,
        get_numbuttons=lambda: len(buttons),
        get_button=buttons.__getitem__,
    )
    window._stick, window._axes = stick, tuple("abcde")
    assert window.read().tolist() == [0.5, 0.25, 0.0, -1.0, -1.0]


@pytest.mark.parametrize(
    ("device", "axes", "line"),
    [
        ("gamepad", 2, "--from gamepad: no gamepad is connected"),
        ("keyboard", 10, "an action has 10 numbers, and the keyboard moves at most 9"),
    ],
)
def test_what_the_device_cannot_do_is_said(device: Any, axes: int, line: str) -> None:
    with pytest.raises(MerlError, match=line):
        Window(device, ["axis"] * axes)


def test_no_screen_is_one_line(tmp_path: Path) -> None:
    hidden = ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-m", "merl.cli", "demos", "record", "reach_duplo", "--preset"]
    command += ["smoke", "--from", "keyboard"]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]  # SDL may have printed a line before
    assert last == "merl: error: --from keyboard needs a screen: no display was found"
    assert not any(tmp_path.iterdir())
