"""Errors that the user can fix, and helpers that format their messages."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class MerlError(Exception):
    """An error that the user can fix.

    The message is one line that names the thing, the value, and the way out. The command line
    prints it without a traceback and exits with `exit_code`.
    """

    exit_code = 2


class NotFinite(MerlError):  # noqa: N818 (named after a state, as `isfinite`)
    """A value is NaN or infinite: the run stops before it uses that value."""

    exit_code = 3


class NotSaved(MerlError):  # noqa: N818 (named after an event)
    """The run has ended, but its last checkpoint or metrics could not be written to disk."""

    exit_code = 5


class EnvironmentsLost(MerlError):  # noqa: N818 (named after an event)
    """Worker processes died or did not answer too often: the run is saved and ends."""

    exit_code = 4


class EnvironmentFailed(MerlError):  # noqa: N818 (named after an event)
    """The user's environment raised an exception or returned an invalid value."""

    exit_code = 4


class EvaluationFailed(MerlError):  # noqa: N818 (named after an event)
    """An evaluation raised an exception: the run was saved before it and can be resumed."""

    exit_code = 4


class CallbackFailed(MerlError):  # noqa: N818 (named after an event)
    """A callback raised an exception: the run is saved and can be resumed."""


def suggest(name: str, known: Iterable[str], closeness: float = 0.6) -> str:
    """Return a hint for an unknown name: the most similar known name, or else all known names.

    Args:
        name: the unknown name.
        known: the valid names.
        closeness: the similarity that a suggestion needs, from 0 to 1; see
            `difflib.get_close_matches`.
    """
    close = get_close_matches(name, list(known), n=1, cutoff=closeness)
    return f"did you mean {close[0]!r}?" if close else f"choose from {', '.join(known)}"


def counted(number: float, noun: str) -> str:
    """Return a number and its noun, singular or plural: "1 step", "150,000 steps"."""
    shown = f"{number:,}" if isinstance(number, int) else f"{number:,g}"
    return f"{shown} {noun}" if number == 1 else f"{shown} {noun}s"


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Check that a value is one of the choices.

    Raises:
        MerlError: the value is not one of them; the message names it and suggests a choice.
    """
    if value not in choices:
        raise MerlError(f"{name} {value!r} is unknown: {suggest(str(value), choices)}")
