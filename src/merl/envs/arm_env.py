"""Gymnasium environment of a task, with a `Dict` observation that has one key per modality."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.config import DEPTH_RANGE, OBSERVATION_KINDS, EnvConfig, ObservationKey
from merl.rendering.opengl import enable_opengl
from merl.rendering.renderer import Renderer, make_renderer
from merl.tasks.arm_task import CAMERA, CONTROL_TIMESTEP, EPISODE_STEPS, ArmTask

Observation = dict[str, Any]
CAMERA_KEYS = {key for key, kind in OBSERVATION_KINDS.items() if kind in ("image", "depth")}


class ArmEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A Gymnasium environment for one task of a robot arm.

    An observation is a dict with the keys in `EnvConfig.observations`: `image` and `wrist` uint8
    (H, W, 3), `depth` and `wrist_depth` float32 (H, W, 1) in m, `proprio`, `touch` and `state`
    float32 (n,). An action is in [-1, 1]: the velocities of the arm's joints and of the fingers, as
    fractions of their maximum. The Jaco has `proprio` (24,) or (42,), `touch` (7,) and actions
    (9,): six joints and three fingers.

    An episode has 250 steps of 0.04 s and ends by truncation. After each step, `info` holds
    `success` (1.0 if the task is solved in the current state, else 0.0), `distance` (the distance
    that decides success, m) and `reward_terms` (by name; their sum is the reward, in [0, 1]).

    The only random state is Gymnasium's `np_random`: if it is restored between two episodes, the
    same episodes follow.

    Attributes:
        task: the task to solve.
        config: the settings of the environment.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / CONTROL_TIMESTEP),
    }

    def __init__(self, task: ArmTask, config: EnvConfig, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise MerlError(f"render_mode {render_mode!r} is unknown: give 'rgb_array' or None")
        keys = {*config.observations}
        if config.renderer == "gl" and (render_mode or CAMERA_KEYS & keys):
            enable_opengl()
        self.task, self.config, self.render_mode = task, config, render_mode
        if "touch" in keys:
            task.robot.add_touch_sensors()
        self._cameras = dict.fromkeys(("image", "depth"), CAMERA.name)
        if {"wrist", "wrist_depth"} & keys:
            wrist = task.robot.add_wrist_camera()
            self._cameras |= dict.fromkeys(("wrist", "wrist_depth"), wrist)
        self._physics: Any = self._compile()
        self._renderers: dict[tuple[str, int, int], Renderer] = {}  # by camera, size and samples
        self._steps_left = 0
        low, high = self._physics.model.actuator_ctrlrange.T
        self._action_center, self._action_scale = (high + low) / 2, (high - low) / 2
        self.action_space = spaces.Box(-1.0, 1.0, low.shape, np.float32)
        self.observation_space = spaces.Dict({key: self._space(key) for key in config.observations})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a random episode; after `close()`, open the environment again.

        Args:
            seed: if given, the start depends only on the seed, not on earlier episodes.
            options: not used.

        Returns:
            The first observation, and `info`.
        """
        if self._physics is None:
            self._physics = self._compile()
        super().reset(seed=seed)
        random_state = np.random.RandomState(self.np_random.integers(2**32, dtype=np.uint32))
        self.task.start_episode(self._physics, random_state)
        self._steps_left = EPISODE_STEPS
        return self._observe(), self._info(self.task.reward_terms(self._physics))

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply an action for 0.04 s.

        Args:
            action: (n,); values outside [-1, 1] are clipped.

        Returns:
            Observation, reward in [0, 1], terminated (always False), truncated (True at the 250th
            step), and `info`.

        Raises:
            MerlError: the action has the wrong shape or is not finite, or no episode is running.
                The simulation is then unchanged.
        """
        if self._steps_left == 0:
            raise MerlError("no episode is running: call reset() first")
        self._physics.set_control(self._velocities(action))
        self._physics.step(self.task.physics_steps_per_control_step)
        self._steps_left -= 1
        terms = self.task.reward_terms(self._physics)
        truncated = self._steps_left == 0
        return self._observe(), sum(terms.values()), False, truncated, self._info(terms)

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image for videos, uint8 (render_size, render_size, 3), from the agent's camera.

        Raises:
            MerlError: the environment is closed.
        """
        if self._physics is None:
            raise MerlError("the environment is closed: call reset() first")
        return (
            None
            if self.render_mode is None
            else self._renderer(CAMERA.name, self.config.render_size, 1).render()
        )

    def close(self) -> None:
        """Free renderers and physics until the next `reset()`; repeated calls have no effect."""
        while self._renderers:
            self._renderers.popitem()[1].close()
        if self._physics is not None:
            self._physics.free()
        self._physics, self._steps_left = None, 0

    @property
    def physics(self) -> Any:
        """The simulation, a dm_control `mjcf.Physics`; `reset()` after `close()` makes a new one.

        Raises:
            MerlError: the environment is closed.
        """
        if self._physics is None:
            raise MerlError("the environment is closed: call reset() first")
        return self._physics

    def _compile(self) -> Any:
        """Compile the task's simulation."""
        physics = self.task.compile()
        buffer = physics.model.vis.global_  # OpenGL's buffer must hold every image
        buffer.offwidth = buffer.offheight = max(self.config.image_size, self.config.render_size)
        return physics

    def action_for(self, velocities: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the action, in [-1, 1], for velocities of the joints, both (n,), rad/s or m/s."""
        shares = (velocities - self._action_center) / self._action_scale
        action: NDArray[np.float32] = shares.clip(-1.0, 1.0).astype(np.float32)
        return action

    def _velocities(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the target velocities of the joints for an action, both (n,), rad/s or m/s."""
        try:
            given = np.asarray(action)
            values = given.astype(np.float64) if given.dtype.kind in "fiu" else None
        except (TypeError, ValueError):
            values = None
        if values is None:
            shown = " ".join(repr(action).split())
            raise MerlError(f"action {shown} is not an array of numbers")
        if values.shape != self.action_space.shape:
            raise MerlError(
                f"action has shape {values.shape}: it must have {self.action_space.shape}"
            )
        if not np.isfinite(values).all():
            raise MerlError(f"action {values.tolist()} is not finite: give numbers in [-1, 1]")
        velocities: NDArray[np.float64] = self._action_center + self._action_scale * values.clip(
            -1.0, 1.0
        )
        return velocities

    def _observe(self) -> Observation:
        return {key: self._read(key) for key in self.config.observations}

    def _read(self, key: ObservationKey) -> NDArray[Any]:
        """Return the current value of a key."""
        robot, physics, config = self.task.robot, self._physics, self.config
        match OBSERVATION_KINDS[key]:
            case "image":
                size, samples = config.image_size, config.samples
                return self._renderer(self._cameras[key], size, samples).render()
            case "depth":
                renderer = self._renderer(self._cameras[key], config.image_size, 1)
                return renderer.render_depth().clip(*DEPTH_RANGE)[..., None]
        match key:
            case "touch":
                return robot.touch(physics)
            case "proprio":
                return robot.proprio(physics, config.proprio)
            case "state":
                return self.task.state(physics, config.state)
            case _:
                raise AssertionError(f"no value for {key}")

    def _space(self, key: ObservationKey) -> spaces.Box:
        size = self.config.image_size
        match OBSERVATION_KINDS[key]:
            case "image":
                return spaces.Box(0, 255, (size, size, 3), np.uint8)
            case "depth":
                return spaces.Box(*DEPTH_RANGE, (size, size, 1), np.float32)
            case _:
                lowest = 0.0 if key == "touch" else -np.inf
                return spaces.Box(lowest, np.inf, self._read(key).shape, np.float32)

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        return {
            "success": float(self.task.success(self._physics)),
            "distance": self.task.distance(self._physics),
            "reward_terms": terms,
        }

    def _renderer(self, camera: str, size: int, samples: int) -> Renderer:
        which = camera, size, samples
        if which not in self._renderers:
            self._renderers[which] = make_renderer(
                self.config.renderer, self._physics, camera, size, samples
            )
        return self._renderers[which]
