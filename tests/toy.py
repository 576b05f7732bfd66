"""A small environment for tests: a dot on a line, with a camera image and a joint vector."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class DotEnv(gymnasium.Env[dict[str, Any], Any]):
    """The action moves a dot at x in [-1, 1]; the reward is 1 - |x|; 10 steps per episode."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    length = 10

    def __init__(self, ends_truly: bool = False, action_dim: int = 1) -> None:
        self.ends_truly = ends_truly
        self.render_mode = "rgb_array"
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (16, 16, 3), np.uint8),
                "joint": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (action_dim,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.x, self.steps = float(self.np_random.uniform(-1, 1)), 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        self.x = float(np.clip(self.x + 0.3 * float(action[0]), -1, 1))
        self.steps += 1
        over = self.steps >= self.length
        info = {"success": float(abs(self.x) < 0.2), "reward_terms": {"near": 1 - abs(self.x)}}
        truly = over and self.ends_truly
        return self._observe(), 1 - abs(self.x), truly, over and not truly, info

    def render(self) -> Any:
        return np.full((480, 480, 3), round(100 * (self.x + 1)), np.uint8)

    def _observe(self) -> dict[str, Any]:
        image = np.zeros((16, 16, 3), np.uint8)
        image[:, round((self.x + 1) * 7.5)] = 255
        return {"image": image, "joint": np.array([self.x, self.steps], np.float32)}
