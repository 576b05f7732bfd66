"""The video of an episode, from the frames that the environment renders."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from merl.acting.rollout import Episode
from merl.core import MerlError
from merl.core.user_code import reason
from merl.envs.frame_rate import frame_rate
from merl.evaluation.video import FPS, Value, VideoWriter


def warn_user(message: str) -> None:
    """Log a warning."""
    logging.getLogger(__name__).warning("%s", message)


class EpisodeVideo:
    """The video of an episode; with `warn`, a failure ends the video but not the episode.

    Args:
        path: the file to write.
        env: the environment, rendered for each frame.
        warn: receives the reason of a failure; if None, a failure raises an error.
    """

    def __init__(
        self, path: Path, env: gymnasium.Env[Any, Any], warn: Callable[[str], None] | None
    ) -> None:
        self._path, self._env, self._warn = path, env, warn
        rate = frame_rate(env.metadata)
        if rate is None:
            (warn or warn_user)(
                f"the environment's metadata has no usable render_fps: its videos have {FPS:g} "
                "frames per second"
            )
        self._writer: VideoWriter | None = None
        with self._handling_errors():
            self._writer = VideoWriter(path, fps=FPS if rate is None else rate)

    def add(self, episode: Episode) -> None:
        """Render the environment and append the frame, with the sums of the episode so far.

        Raises:
            MerlError: the video cannot be made and `warn` is None.
        """
        if self._writer is not None:
            with self._handling_errors():
                self._writer.add(np.asarray(self._env.render()), _caption(episode))

    def close(self) -> None:
        """Finish the video.

        Raises:
            MerlError: the video cannot be made and `warn` is None.
        """
        if self._writer is not None:
            with self._handling_errors():
                self._writer.close()

    def abort(self) -> None:
        """Remove the video if it is not finished."""
        if self._writer is not None:
            self._writer.abort()

    @contextmanager
    def _handling_errors(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # from the user's `render`, the encoder or the disk
            self.abort()
            self._writer = None
            why = reason(error)
            if self._warn is None:
                raise MerlError(f"the video {self._path} cannot be made: {why}") from error
            self._warn(f"there is no video of this evaluation: {why}")


def _caption(episode: Episode) -> dict[str, Value]:
    caption: dict[str, Value] = {
        "step": episode.length,
        "return": episode.total_reward,
    }
    if episode.success is not None:
        caption["success"] = episode.success
    return caption
