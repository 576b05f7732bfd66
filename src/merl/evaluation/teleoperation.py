"""Demonstrations of a person, who acts with a keyboard or a gamepad in front of a window."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.demos.episode import Episode, EpisodeRecording
from merl.demos.packages import require
from merl.evaluation.demonstrating import FIRST_SEED
from merl.evaluation.realtime import Limits, drive

DeviceName = Literal["keyboard", "gamepad"]
Command = NDArray[np.float64]
PAIRS = ("da", "ws", "eq", "rf", "tg", "yh", "uj", "ik", "ol")
"""Keys of each axis: the first moves it up, the second down."""
STILL = 0.15
"""A stick that is nearer to its middle than this counts as centred."""
SIDE = 480
"""Height of the window's image, in pixels."""
SOFT = 0.4
"""Part of an axis that a key moves while Shift is held."""


class Window:
    """A window that shows an environment and reads the keyboard and a gamepad.

    Args:
        device: what moves the axes.
        axes: the name of each axis.

    Attributes:
        finished: the person wants no further episode.

    Raises:
        MerlError: pygame is missing, there is no screen or no gamepad, or there are too many axes
            for the keys.
    """

    def __init__(self, device: DeviceName, axes: Sequence[str]) -> None:
        require("pygame", f"--from {device}", extra="teleop")
        import pygame

        self._game, self._axes, self.finished = pygame, tuple(axes), False
        if device == "keyboard" and len(axes) > len(PAIRS):
            raise MerlError(
                f"an action has {len(axes)} numbers, and the keyboard moves at most {len(PAIRS)}: "
                "use a gamepad, or record from Python (docs/howto/demonstrations.md)"
            )
        try:
            pygame.display.init()
            pygame.font.init()
            pygame.joystick.init()
            pygame.display.set_caption("merl demos record")
            self._screen = pygame.display.set_mode((SIDE, SIDE + 24 * (len(axes) + 4)))
            if pygame.display.get_driver() == "offscreen":  # SDL's choice where there is none
                raise pygame.error("no display was found")
        except pygame.error as error:
            raise MerlError(f"--from {device} needs a screen: {error}") from None
        self._stick = None
        if device == "gamepad":
            if not pygame.joystick.get_count():
                raise MerlError("--from gamepad: no gamepad is connected")
            self._stick = pygame.joystick.Joystick(0)
        self._held: set[int] = set()
        self._ends: Literal["keep", "discard"] | None = None

    def close(self) -> None:
        """Close the window."""
        self._game.quit()

    def begin(self) -> None:
        """Start an episode."""
        self._ends = None

    def ended(self) -> bool:
        """Return whether the person ended the episode."""
        return self._ends is not None or self.finished

    @property
    def discards(self) -> bool:
        """Whether the person wants to discard the episode."""
        return self._ends == "discard" or self.finished

    def read(self) -> Command:
        """Handle what the person did; return the axes, in [-1, 1]."""
        game = self._game
        for event in game.event.get():
            if event.type == game.QUIT:
                self.finished = True
            elif event.type == game.KEYDOWN:
                self._held.add(event.key)
                self._press(event.key)
            elif event.type == game.KEYUP:
                self._held.discard(event.key)
        return self._keys() if self._stick is None else self._sticks()

    def show(self, image: NDArray[np.uint8] | None, lines: Sequence[str]) -> None:
        """Draw the image, (H, W, 3), the keys, and these lines."""
        game, screen = self._game, self._screen
        screen.fill((24, 24, 27))
        if image is not None:
            surface = game.surfarray.make_surface(np.ascontiguousarray(image.swapaxes(0, 1)))
            screen.blit(game.transform.scale(surface, (SIDE, SIDE)), (0, 0))
        font = game.font.Font(None, 22)
        for number, line in enumerate([*lines, *self.legend()]):
            screen.blit(font.render(line, True, (228, 228, 231)), (10, SIDE + 8 + 24 * number))
        game.display.flip()

    def legend(self) -> list[str]:
        """Return lines that name the keys."""
        ends = "Enter: keep the episode   Backspace: discard it   Escape: discard it and finish"
        if self._stick is not None:
            return ["sticks, then pairs of buttons:", *self._axes, ends]
        pairs = zip(PAIRS, self._axes, strict=False)
        keys = [f"{pair[0].upper()}, {pair[1].upper()}: {axis}" for pair, axis in pairs]
        return [*keys, "Shift: slowly", ends]

    def _press(self, key: int) -> None:
        game = self._game
        if key == game.K_RETURN:
            self._ends = "keep"
        elif key == game.K_BACKSPACE:
            self._ends = "discard"
        elif key == game.K_ESCAPE:
            self.finished = True

    def _keys(self) -> Command:
        game = self._game
        held = [[game.key.key_code(key) in self._held for key in pair] for pair in PAIRS]
        axes = np.array([float(up) - float(down) for up, down in held])[: len(self._axes)]
        slow = self._held & {game.K_LSHIFT, game.K_RSHIFT}
        return SOFT * axes if slow else axes

    def _sticks(self) -> Command:
        """Return the axes of the gamepad, upward counting up, then its buttons in pairs."""
        stick = self._stick
        assert stick is not None
        axes = [stick.get_axis(i) * (-1.0 if i % 2 else 1.0) for i in range(stick.get_numaxes())]
        buttons = [float(stick.get_button(i)) for i in range(stick.get_numbuttons())]
        pairs = [up - down for up, down in zip(buttons[::2], buttons[1::2], strict=False)]
        found = np.zeros(len(self._axes))
        # Sticks have four axes; behind them are triggers, which rest at -1.
        given = np.array([*axes[:4], *pairs][: len(found)])
        found[: len(given)] = np.where(np.abs(given) < STILL, 0.0, given)
        return found


def record_by_hand(
    window: Window,
    action_for: Callable[[Command], NDArray[np.float32]],
    env: gymnasium.Env[Any, Any],
    episodes: int,
    rate: float,
    *,
    seed: int = 0,
    failures: bool = False,
) -> Iterator[Episode]:
    """Let a person act, in real time, and yield the episodes that are kept.

    Args:
        window: where the person sees and acts.
        action_for: maps the axes to an action.
        env: the environment; its images are shown if it renders to arrays.
        episodes: number of episodes to yield, unless the person finishes before.
        rate: steps per second.
        seed: selects the start states.
        failures: also yield episodes that do not end in success.
    """
    kept = tried = 0
    while kept < episodes and not window.finished:
        observation, _ = env.reset(seed=FIRST_SEED + 100_000 * seed + tried)
        tried += 1
        recording = EpisodeRecording(observation)
        window.begin()
        note = f"episode {kept + 1} of {episodes}"

        def act(
            _: Any, note: str = note, recording: EpisodeRecording = recording
        ) -> NDArray[np.float32]:
            image = env.render() if env.render_mode == "rgb_array" else None
            shown = image if isinstance(image, np.ndarray) else None
            window.show(shown, [f"{note}   step {len(recording)}"])
            return action_for(window.read())

        limits = Limits(late=10**9)
        driven = drive(act, env, observation, rate, limits, window.ended, record=recording.add)
        if window.discards or not len(recording):
            continue
        episode = recording.finish(terminated=driven.end == "terminated")
        if failures or episode.success is not False:
            kept += 1
            yield episode
