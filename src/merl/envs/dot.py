"""A toy task with a known optimum: steer a dot to a mark, with a camera and joint positions.

Agents learn it in a minute or two. It shows whether an agent works, and how it uses each modality:

    merl.envs.dot:whole   the camera sees dot and mark
    merl.envs.dot:split   the camera sees only the mark; the joints give the position of the dot
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

SIZE = 32
"""Height and width of the image, pixels."""
REACH = 0.2
"""Maximum motion of the dot in one step, along each axis of a plane from -1 to 1."""
EPISODE_STEPS = 20
NEAR = 0.1
"""Success: the dot is closer to the mark than this, along both axes."""
_WIDTH = 4  # width of dot and mark, pixels


class SteerDot(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """A dot that an agent steers to a mark; both start at random positions.

    An action (2,) in [-1, 1] moves the dot by up to 0.2 along each axis. An observation has
    `image`, uint8 (32, 32, 3), with the mark in green and the dot in red, and `joints`, float32
    (2,), the position of the dot. The reward is 1 - d / 2, where d in [0, 2] is the larger one of
    the distances along the two axes. The best policy moves straight to the mark (`best_action`). An
    episode has 20 steps.

    Args:
        shows_dot: whether the camera sees the dot.
        render_mode: `rgb_array` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, shows_dot: bool = True, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8),
                "joints": spaces.Box(-1.0, 1.0, (2,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._shows_dot = shows_dot
        self._dot = self._mark = np.zeros(2)
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode at random; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self._dot, self._mark = self.np_random.uniform(-1.0, 1.0, (2, 2))
        self._step = 0
        return self._observe(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Move the dot; see `gymnasium.Env.step`."""
        self._dot = np.clip(self._dot + REACH * np.clip(action, -1.0, 1.0), -1.0, 1.0)
        self._step += 1
        distance = float(np.abs(self._dot - self._mark).max())
        info = {"success": distance < NEAR}
        return self._observe(), 1.0 - distance / 2, False, self._step == EPISODE_STEPS, info

    def best_action(self) -> NDArray[np.float32]:
        """Return the action straight to the mark: no policy gets a higher reward."""
        way = (self._mark - self._dot) / REACH
        best: NDArray[np.float32] = np.clip(way, -1.0, 1.0).astype(np.float32)
        return best

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image of dot and mark, even if the camera does not see the dot."""
        return None if self.render_mode is None else self._image(shows_dot=True)

    def _observe(self) -> dict[str, Any]:
        return {
            "image": self._image(self._shows_dot),
            "joints": self._dot.astype(np.float32),
        }

    def _image(self, shows_dot: bool) -> NDArray[np.uint8]:
        image = np.zeros((SIZE, SIZE, 3), np.uint8)
        for position, channel in ((self._mark, 1), (self._dot, 0))[: 1 + shows_dot]:
            row, column = np.round((position + 1) / 2 * (SIZE - _WIDTH)).astype(int)
            image[row : row + _WIDTH, column : column + _WIDTH, channel] = 255
        return image


def whole(render_mode: str | None = None) -> SteerDot:
    """Make the task in which the camera sees dot and mark."""
    return SteerDot(render_mode=render_mode)


def split(render_mode: str | None = None) -> SteerDot:
    """Make the task in which the camera sees only the mark; the joints give the dot's position."""
    return SteerDot(shows_dot=False, render_mode=render_mode)
