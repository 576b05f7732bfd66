"""A small task whose optimum is known: steer a dot to a mark, by camera and joints.

Learnt in a minute or two, it tells whether an agent works, and what each sense is good for:

    merl.envs.dot:whole   the camera sees dot and mark
    merl.envs.dot:split   it sees the mark alone: where the dot is, the joints know
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

SIZE = 32
"""Height and width of the picture, pixels."""
REACH = 0.2
"""How far the dot moves in a step at most, along each axis of a plane from -1 to 1."""
EPISODE_STEPS = 20
NEAR = 0.1
"""Success: the dot is this near to the mark, along both axes."""
_WIDTH = 4  # of dot and mark, pixels


class SteerDot(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """The dot and the mark start at random; an action (2,) in [-1, 1] moves the dot by up to 0.2.

    An observation is `image`, uint8 (32, 32, 3), the mark in green and the dot in red, and
    `joints`, float32 (2,), where the dot is. The reward is 1 - d / 2, d in [0, 2] the greater of
    the distances along the two axes; what is best is to go straight (`best_action`). An episode has
    20 steps.

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
        """Straight to the mark: no policy is paid more."""
        way = (self._mark - self._dot) / REACH
        best: NDArray[np.float32] = np.clip(way, -1.0, 1.0).astype(np.float32)
        return best

    def render(self) -> NDArray[np.uint8] | None:
        """Dot and mark, whether the camera sees both or not."""
        return None if self.render_mode is None else self._picture(shows_dot=True)

    def _observe(self) -> dict[str, Any]:
        return {
            "image": self._picture(self._shows_dot),
            "joints": self._dot.astype(np.float32),
        }

    def _picture(self, shows_dot: bool) -> NDArray[np.uint8]:
        picture = np.zeros((SIZE, SIZE, 3), np.uint8)
        for position, channel in ((self._mark, 1), (self._dot, 0))[: 1 + shows_dot]:
            row, column = np.round((position + 1) / 2 * (SIZE - _WIDTH)).astype(int)
            picture[row : row + _WIDTH, column : column + _WIDTH, channel] = 255
        return picture


def whole(render_mode: str | None = None) -> SteerDot:
    """The camera sees dot and mark."""
    return SteerDot(render_mode=render_mode)


def split(render_mode: str | None = None) -> SteerDot:
    """The camera sees the mark, the joints know where the dot is."""
    return SteerDot(shows_dot=False, render_mode=render_mode)
