"""The folders of a run's checkpoints: find them, and delete the old ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from merl.core.files import entries, read_json, remove

MANIFEST = "manifest.json"
FORMER = ".former-"
"""Begin of the name of a checkpoint that another one of the same step is replacing."""


def folders(root: Path) -> dict[int, Path]:
    """Return the folders of checkpoints by their steps, in order.

    If a checkpoint was to be replaced, and the new one did not get its place, it is the former one.

    Raises:
        OSError: they cannot be read.
    """
    found = {}
    for path in entries(root):  # `.former-00000020` comes before `00000020`
        number = path.name.removeprefix(FORMER)
        if _is_number(number) and path.is_dir():
            found[int(number)] = path
    return dict(sorted(found.items()))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdecimal()


def prune(root: Path, step: int, keep: int) -> None:
    """Delete all checkpoints except the last `keep` and the best, and those after `step`."""
    discard_later(root, step)
    every = folders(root)
    scores = {path: score for path, score in _scores(every.values()) if score is not None}
    best = max(scores, key=lambda path: scores[path]) if scores else None
    old = [path for path in [*every.values()][:-keep] if path != best]
    stale = [path for path in entries(root) if path.name.startswith((".part-", FORMER))]
    for path in [*old, *(path for path in stale if path not in every.values())]:
        _discard(path)


def discard_later(root: Path, step: int) -> None:
    """Delete the checkpoints of later steps than `step`, from which the run was not resumed.

    They were skipped as damaged, and must not count among those that are kept.
    """
    with suppress(OSError):
        for later, path in folders(root).items():
            if later > step:
                _discard(path)


def _discard(path: Path) -> None:
    """Delete a checkpoint; a process that dies here leaves no half of one."""
    if not path.name.startswith(".part-"):
        with suppress(OSError):
            path = path.rename(path.with_name(f".part-{path.name}-pruned"))
    remove(path)


def _scores(paths: Iterable[Path]) -> Iterator[tuple[Path, float | None]]:
    for path in paths:
        try:
            yield path, read_json(path / MANIFEST)["score"]
        except (OSError, ValueError, LookupError, TypeError):
            yield path, None
