"""Every action held for some steps, as DrQ-v2 does."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium

from merl.envs.frame_rate import frame_rate


class ActionRepeat(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An action is held until it was taken `repeat` times or the episode is over.

    Rewards and the terms of the reward are summed; what else `info` tells is the last step's.

    Args:
        env: whose steps are repeated.
        repeat: how many of its steps make one of this.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], repeat: int) -> None:
        super().__init__(env)
        self.repeat = repeat
        fps = frame_rate(env.metadata)
        if fps is not None:  # videos of it stay in real time
            self.metadata = {**env.metadata, "render_fps": fps / repeat}

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Take the action `repeat` times."""
        total, terms = 0.0, dict[str, float]()
        for _ in range(self.repeat):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            for name, value in info.get("reward_terms", {}).items():
                terms[name] = terms.get(name, 0.0) + float(value)
            if terminated or truncated:
                break
        if terms:
            info = {**info, "reward_terms": terms}
        return observation, total, terminated, truncated, info
