"""Gymnasium environment of a task, with a `Dict` observation that has one key per modality."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.config import DEPTH_RANGE, EnvConfig
from merl.envs.rendering import Renderer, check_renderer, make_renderer
from merl.tasks.jaco import (
    CAMERA,
    CONTROL_TIMESTEP,
    EPISODE_STEPS,
    PROPRIO_SIZES,
    TOUCH_SIZE,
    JacoTask,
)

Observation = dict[str, Any]


class JacoEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A Gymnasium environment for one task of the Jaco arm.

    An observation is a dict with the keys in `EnvConfig.observations`: `image` uint8 (H, W, 3),
    `depth` float32 (H, W, 1) in m, `proprio` float32 (24,) or (42,), `touch` float32 (7,), `state`
    float32 (n,). An action is float32 (9,) in [-1, 1]:
    the velocities of the arm's six joints and of the three fingers, as fractions of their maximum.

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

    def __init__(self, task: JacoTask, config: EnvConfig, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise MerlError(f"render_mode {render_mode!r} is unknown: give 'rgb_array' or None")
        if render_mode or {"image", "depth"} & {*config.observations}:
            check_renderer(config.renderer)
        self.task, self.config, self.render_mode = task, config, render_mode
        if "touch" in config.observations:
            task.add_touch_sensors()
        self._physics: Any = self._compile()
        self._renderers: dict[tuple[int, int], Renderer] = {}  # by size and samples
        self._steps_left = 0
        low, high = self._physics.model.actuator_ctrlrange.T
        self._action_center, self._action_scale = (high + low) / 2, (high - low) / 2
        self.action_space = spaces.Box(-1.0, 1.0, low.shape, np.float32)
        state_size = self.task.state(self._physics, config.state).size
        self.observation_space = _observation_space(config, state_size)

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
            action: (9,); values outside [-1, 1] are clipped.

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
        return None if self.render_mode is None else self._image(self.config.render_size)

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
        """Return the action (9,), in [-1, 1], for velocities of the joints (9,), rad/s."""
        shares = (velocities - self._action_center) / self._action_scale
        action: NDArray[np.float32] = shares.clip(-1.0, 1.0).astype(np.float32)
        return action

    def _velocities(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the target velocities of the joints for an action, (9,), rad/s."""
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
        wanted = self.config.observations
        observation: Observation = {}
        if "image" in wanted:
            observation["image"] = self._image(self.config.image_size, self.config.samples)
        if "depth" in wanted:
            renderer = self._renderer(self.config.image_size, 1)
            observation["depth"] = renderer.render_depth().clip(*DEPTH_RANGE)[..., None]
        if "touch" in wanted:
            observation["touch"] = self.task.touch(self._physics)
        if "proprio" in wanted:
            observation["proprio"] = self.task.proprio(self._physics, self.config.proprio)
        if "state" in wanted:
            observation["state"] = self.task.state(self._physics, self.config.state)
        return observation

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        return {
            "success": float(self.task.success(self._physics)),
            "distance": self.task.distance(self._physics),
            "reward_terms": terms,
        }

    def _image(self, size: int, samples: int = 1) -> NDArray[np.uint8]:
        """Return an image of the scene, uint8 (size, size, 3)."""
        return self._renderer(size, samples).render()

    def _renderer(self, size: int, samples: int) -> Renderer:
        if (size, samples) not in self._renderers:
            renderer = make_renderer(
                self.config.renderer, self._physics, CAMERA.name, size, samples
            )
            self._renderers[size, samples] = renderer
        return self._renderers[size, samples]


def _observation_space(config: EnvConfig, state_size: int) -> spaces.Space[Observation]:
    image_shape = (config.image_size, config.image_size, 3)
    everything: dict[str, spaces.Space[Any]] = {
        "image": spaces.Box(0, 255, image_shape, np.uint8),
        "depth": spaces.Box(*DEPTH_RANGE, (*image_shape[:2], 1), np.float32),
        "touch": spaces.Box(0.0, np.inf, (TOUCH_SIZE,), np.float32),
        "proprio": spaces.Box(-np.inf, np.inf, (PROPRIO_SIZES[config.proprio],), np.float32),
        "state": spaces.Box(-np.inf, np.inf, (state_size,), np.float32),
    }
    return spaces.Dict({name: everything[name] for name in config.observations})
