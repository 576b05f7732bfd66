"""Action repeat: apply every action for several steps, as DrQ-v2 does."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium

from merl.envs.frame_rate import frame_rate


class ActionRepeat(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that applies each action `repeat` times, or until the episode ends.

    Rewards and reward terms are summed. All other entries of `info` are those of the last step.

    Args:
        env: the environment whose steps are repeated.
        repeat: number of its steps in one step of the wrapper.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], repeat: int) -> None:
        super().__init__(env)
        self.repeat = repeat
        fps = frame_rate(env.metadata)
        if fps is not None:  # videos keep real time
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
