"""A task as a Gymnasium environment with a `Dict` observation, a key per modality."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from merl.core import MerlError
from merl.envs.config import EnvConfig
from merl.envs.rendering import Renderer, make_renderer
from merl.tasks.jaco import CAMERA, EPISODE_STEPS, PROPRIO_SIZES, JacoTask

Observation = dict[str, NDArray[Any]]


class JacoEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One task of the Jaco arm, as an agent sees it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, task: JacoTask, config: EnvConfig, render_mode: str | None = None) -> None:
        self.task, self.config, self.render_mode = task, config, render_mode
        self._physics = task.compile()
        self._substeps = task.physics_steps_per_control_step
        low, high = self._physics.model.actuator_ctrlrange.T
        self._action_center, self._action_scale = (high + low) / 2, (high - low) / 2
        self._renderers: dict[int, Renderer] = {}
        self._steps = 0
        self.action_space = spaces.Box(-1.0, 1.0, low.shape, np.float32)
        self.observation_space = self._observation_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; what it starts from depends on the seed alone."""
        super().reset(seed=seed)
        random_state = np.random.RandomState(self.np_random.integers(2**32, dtype=np.uint32))
        random_state.uniform()  # dm_control draws the brick's stud size here, which has no spread
        with self._physics.reset_context():
            self.task.initialize_episode(self._physics, random_state)
        self._steps = 0
        return self._observe(), self._info(self.task.reward_terms(self._physics))

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for 0.04 s."""
        self._physics.set_control(self._control(action))
        self._physics.step(self._substeps)
        self._steps += 1
        terms = self.task.reward_terms(self._physics)
        truncated = self._steps >= EPISODE_STEPS
        return self._observe(), sum(terms.values()), False, truncated, self._info(terms)

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """A picture for people."""
        return None if self.render_mode is None else self._picture(self.config.render_size)

    def close(self) -> None:
        """Let go of pictures and physics."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self._physics.free()

    def _control(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        values = np.asarray(action, dtype=np.float64)
        if values.shape != self.action_space.shape:
            raise MerlError(f"action has shape {values.shape}: {self.action_space.shape} is needed")
        if not np.isfinite(values).all():
            raise MerlError(f"action {values.tolist()} is not finite: give numbers in [-1, 1]")
        return self._action_center + self._action_scale * np.clip(values, -1.0, 1.0)

    def _observe(self) -> Observation:
        observation: Observation = {}
        if "image" in self.config.observations:
            observation["image"] = self._picture(self.config.image_size)
        if "proprio" in self.config.observations:
            observation["proprio"] = self.task.proprio(self._physics, self.config.proprio)
        if "state" in self.config.observations:
            observation["state"] = self.task.state(self._physics)
        return observation

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        return {
            "success": float(self.task.success(self._physics)),
            "distance": self.task.hand_distance(self._physics),
            "reward_terms": terms,
        }

    def _picture(self, size: int) -> NDArray[np.uint8]:
        if size not in self._renderers:
            self._renderers[size] = make_renderer(
                self.config.renderer, self._physics, CAMERA.name, size
            )
        return self._renderers[size].render()

    def _observation_space(self) -> spaces.Dict:
        size = self.config.image_size
        everything: dict[str, spaces.Space[Any]] = {
            "image": spaces.Box(0, 255, (size, size, 3), np.uint8),
            "proprio": _vector(PROPRIO_SIZES[self.config.proprio]),
            "state": _vector(self.task.state(self._physics).size),
        }
        return spaces.Dict({name: everything[name] for name in self.config.observations})


def _vector(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)
