"""An arm with LeRobot's driver as an environment, e.g. the SO-101 with two cameras.

    merl train lerobot_arm:make_env --eval.every 0 --random-steps 1 --agent.start-from runs/cloned
    merl run runs/RUN --env lerobot_arm:make_unpaced --hz 15

Fill in `connect` for your arm. docs/howto/real_robot.md explains the whole way. An action changes
the joints' targets by at most `STEP`; targets never leave `LOW` to `HIGH`, and every change begins
from targets at most `LEAD` from the joints. A reset moves to `REST` in the same small changes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray
from PIL import Image

HZ = 15
SIZE = 64  # pixels of the agent's images
EPISODE = 15 * HZ  # steps
# Degrees of the joints, per cent of the gripper: change these to your workspace.
LOW = {"shoulder_pan": -60.0, "shoulder_lift": -90.0, "elbow_flex": -60.0, "wrist_flex": -90.0}
HIGH = {"shoulder_pan": 60.0, "shoulder_lift": 60.0, "elbow_flex": 90.0, "wrist_flex": 90.0}
REST = {"shoulder_pan": 0.0, "shoulder_lift": -60.0, "elbow_flex": 60.0, "wrist_flex": 60.0}
LOW |= {"wrist_roll": -90.0, "gripper": 0.0}
HIGH |= {"wrist_roll": 90.0, "gripper": 60.0}
REST |= {"wrist_roll": 0.0, "gripper": 30.0}
STEP = 3.0
LEAD = 10.0
PATIENCE = 10 * HZ  # steps in which the arm must reach its rest position


class Robot(Protocol):
    """What this uses of `lerobot.robots.Robot`."""

    def get_observation(self) -> Mapping[str, Any]:
        """Return `NAME.pos` for each joint, and an image (H, W, 3) for each camera."""
        ...

    def send_action(self, action: dict[str, float]) -> Any:
        """Send the target `NAME.pos` of each joint."""
        ...

    def disconnect(self) -> None:
        """End the connection; SO-101's driver then turns the motors off."""
        ...


class LeRobotArm(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """Two cameras and the joints; the reward is 1 when a person says that the task is solved.

    Args:
        robot: the connected arm.
        ready: waits until a person has reset the scene.
        solved: returns whether the task is solved, after each step.
        paced: whether a step takes 1 / HZ s. `merl run` keeps the time itself.
    """

    metadata = {"render_fps": HZ}  # noqa: RUF012

    def __init__(
        self,
        robot: Robot,
        ready: Callable[[], object],
        solved: Callable[[], bool],
        *,
        paced: bool = True,
    ) -> None:
        self._robot, self._ready, self._solved, self._paced = robot, ready, solved, paced
        self._joints = tuple(REST)
        self._low, self._high, self._rest = (
            np.array([each[name] for name in self._joints]) for each in (LOW, HIGH, REST)
        )
        seen = robot.get_observation()
        self._cameras = [name for name, value in seen.items() if np.ndim(value) == 3]
        image = spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        numbers = spaces.Box(-np.inf, np.inf, (2 * len(self._joints),), np.float32)
        self.observation_space = spaces.Dict(
            dict.fromkeys(self._cameras, image) | {"joints": numbers}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (len(self._joints),), np.float32)
        self._target = self._rest
        self._next = time.perf_counter()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Move slowly to the rest position, and wait for the person."""
        super().reset(seed=seed)
        _, here = self._observe()
        self._target = here
        for _ in range(PATIENCE):
            self._move(self._rest - self._target, bounded=False)
            time.sleep(1 / HZ)
            _, here = self._observe()
            self._target = self._target.clip(here - LEAD, here + LEAD)
            if np.abs(here - self._rest).max() <= LEAD and (self._target == self._rest).all():
                break
        else:
            raise RuntimeError(
                f"the arm does not reach its rest position: it is at {here.round(1)}"
            )
        self._ready()
        self._next = time.perf_counter()
        return self._observe()[0], {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Change the targets by at most `STEP`, and observe after 1 / HZ s."""
        self._move(STEP * np.asarray(action, float))
        if self._paced:
            self._next = max(self._next + 1 / HZ, time.perf_counter())
            time.sleep(max(0.0, self._next - time.perf_counter()))
        observation, here = self._observe()
        self._target = self._target.clip(here - LEAD, here + LEAD).clip(self._low, self._high)
        solved = self._solved()
        return observation, float(solved), solved, False, {"success": solved}

    def close(self) -> None:
        """End the connection, which leaves the arm as its driver does."""
        self._robot.disconnect()

    def _move(self, change: NDArray[Any], *, bounded: bool = True) -> None:
        self._target = self._target + change.clip(-STEP, STEP)
        if bounded:  # a reset comes from wherever the arm is
            self._target = self._target.clip(self._low, self._high)
        named = zip(self._joints, self._target.tolist(), strict=True)
        self._robot.send_action({f"{name}.pos": value for name, value in named})

    def _observe(self) -> tuple[dict[str, Any], NDArray[np.float64]]:
        """Return the observation and the joints' positions."""
        seen = self._robot.get_observation()
        here = np.array([float(seen[f"{name}.pos"]) for name in self._joints])
        numbers = np.concatenate([here, self._target]) / 100.0
        found: dict[str, Any] = {"joints": numbers.astype(np.float32)}
        for name in self._cameras:
            image = Image.fromarray(np.asarray(seen[name], np.uint8))
            found[name] = np.asarray(image.resize((SIZE, SIZE), Image.Resampling.BOX))
        return found, here


def connect() -> Robot:
    """Connect to the arm with LeRobot's driver; change port and cameras to yours."""
    from lerobot.cameras.opencv.configuration_opencv import OpenCVCameraConfig
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    cameras = {
        name: OpenCVCameraConfig(index_or_path=index, fps=30, width=640, height=480)
        for index, name in enumerate(("front", "wrist"))
    }
    robot: Any = SO101Follower(
        SO101FollowerConfig(
            port="/dev/ttyACM0", id="arm", cameras=cameras, max_relative_target=LEAD
        )
    )
    robot.connect()
    return robot  # type: ignore[no-any-return]


def make_env() -> gymnasium.Env[Any, Any]:
    """Make the environment for training; a person resets the scene and ends solved episodes."""
    ready = "Reset the scene and press Enter; a second Enter says that the task is solved. "
    return _make(lambda: input(ready), _enter_pressed, paced=True)


def make_unpaced() -> gymnasium.Env[Any, Any]:
    """Make the environment for `merl run`, which keeps the time and reads the keys."""
    ready = "Reset the scene and press Enter. "
    return _make(lambda: input(ready), lambda: False, paced=False)


def _make(
    ready: Callable[[], object], solved: Callable[[], bool], *, paced: bool
) -> gymnasium.Env[Any, Any]:
    robot = connect()
    try:
        return TimeLimit(LeRobotArm(robot, ready, solved, paced=paced), EPISODE)
    except BaseException:
        robot.disconnect()
        raise


def _enter_pressed() -> bool:
    import select
    import sys

    ready, _, _ = select.select([sys.stdin], [], [], 0)
    return bool(ready) and sys.stdin.readline() != ""
