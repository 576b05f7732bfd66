"""Errors that a user can mend, and the words of their messages."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class MerlError(Exception):
    """A fault that the user can mend.

    Its text is one line that names the thing, the value, and the way out; the command line prints
    it without a traceback and exits with `exit_code`.
    """

    exit_code = 2


class NotFinite(MerlError):  # noqa: N818 (a state of affairs, as in `isfinite`)
    """A NaN or an infinity where there must be a number: the run stops before it spreads."""

    exit_code = 3


class NotSaved(MerlError):  # noqa: N818 (what happened, not a mistake)
    """The run has ended, and its end could not be written to the disk."""

    exit_code = 5


class EnvironmentsLost(MerlError):  # noqa: N818 (what happened, not a mistake)
    """Environments' processes died or fell silent too often: the run is saved and ends."""

    exit_code = 4


class EnvironmentFailed(MerlError):  # noqa: N818 (what happened, not a mistake)
    """The user's environment raised an exception, or gave what is no observation, reward or end."""

    exit_code = 4


class EvaluationFailed(MerlError):  # noqa: N818 (what happened, not a mistake)
    """An evaluation ended by an exception: the run was saved before it, and can be resumed."""

    exit_code = 4


def suggest(name: str, known: Iterable[str], closeness: float = 0.6) -> str:
    """Return the way out of a name that is unknown: what was perhaps meant, or all that there is.

    Args:
        name: the unknown one.
        known: those that there are.
        closeness: how similar the two must be, from 0 to 1 (`difflib.get_close_matches`).
    """
    close = get_close_matches(name, list(known), n=1, cutoff=closeness)
    return f"did you mean {close[0]!r}?" if close else f"choose from {', '.join(known)}"


def counted(number: float, noun: str) -> str:
    """Return a number with its noun, e.g. "1 step", "0.5 minutes", "150,000 steps"."""
    shown = f"{number:,}" if isinstance(number, int) else f"{number:,g}"
    return f"{shown} {noun}" if number == 1 else f"{shown} {noun}s"


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Refuse a value that is none of the choices.

    Raises:
        MerlError: naming the value and the choices.
    """
    if value not in choices:
        raise MerlError(f"{name} {value!r} is unknown: {suggest(str(value), choices)}")
