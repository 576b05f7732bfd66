"""Checkpoints: folders that are written atomically.

`checkpoints/00010000/` holds `weights.safetensors` (the dicts of tensors in the agent's state),
`learner.pt` (the rest of it, e.g. optimizers and random generators; read with `weights_only=True`),
`state.json` (progress of the run) and `manifest.json` (sizes and SHA-256 of the other files). The
folder is written under a temporary name, flushed to disk, then renamed. A checkpoint that it
replaces is called `.former-00010000` until then.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes

from merl.core import Agent, MerlError
from merl.core.files import (
    cause,
    is_damage,
    is_gone,
    open_file,
    read_json,
    remove,
    reporting,
    sealed,
    sync,
)
from merl.core.guards import check_weights
from merl.networks.settings import torch_settings
from merl.runs.checkpoint_folders import FORMER, MANIFEST, folders, prune

FORMAT = 1
_WEIGHTS, _LEARNER = "weights.safetensors", "learner.pt"
_STATE = "state.json"
_FILES = (_WEIGHTS, _LEARNER, _STATE)
_BAD_VALUES = (ValueError, TypeError, AttributeError, ArithmeticError, RecursionError)
_CPU = torch.device("cpu")
_LOG = logging.getLogger(__name__)


class Unreadable(MerlError):  # noqa: N818 (named after a state)
    """A checkpoint cannot be read now, so that nobody knows whether it is damaged."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on disk, verified against its manifest.

    Attributes:
        path: the folder of the checkpoint.
        step: environment steps at which it was saved.
        score: the evaluation return at that step; None if there was no evaluation.
    """

    path: Path
    step: int
    score: float | None

    @classmethod
    def open(cls, path: Path) -> Checkpoint:
        """Read the manifest and check every file against it.

        Raises:
            MerlError: the manifest is damaged or has another format, or a file is missing,
                truncated or changed.
            Unreadable: the disk does not let a file be read.
        """
        try:
            return cls._open(path)
        except OSError as error:
            raise Unreadable(
                f"checkpoint {path} cannot be read: {cause(error)}: try again, or move it away to "
                "use the one before it"
            ) from error

    @classmethod
    def _open(cls, path: Path) -> Checkpoint:
        try:
            manifest = read_json(path / MANIFEST)
            files, number = manifest["files"], manifest["format"]
            step, score = int(manifest["step"]), manifest["score"]
            score = None if score is None else float(score)
            if step < 0 or any(Path(name).name != name for name in files):
                raise ValueError(f"step {step}, files {', '.join(files)}")
            missing = {*_FILES} - {*files.keys()}
            if missing:
                raise ValueError(f"it does not list {', '.join(sorted(missing))}")
        except (OSError, LookupError, *_BAD_VALUES) as error:
            if not is_damage(error):
                raise
            raise MerlError(f"checkpoint {path} has no readable manifest ({error})") from None
        if number != FORMAT:
            raise MerlError(
                f"checkpoint {path} has format {number}, but this version of merl reads format "
                f"{FORMAT}"
            )
        for name, expected in files.items():
            try:
                whole = _fingerprint(path / name, expected["bytes"]) == expected
            except (OSError, LookupError, TypeError) as error:
                if not is_damage(error):
                    raise
                whole = False
            if not whole:
                raise MerlError(f"checkpoint {path}: {name} is missing or damaged")
        return cls(path, step, score)

    @classmethod
    def find(cls, root: Path, which: str = "latest") -> Checkpoint:
        """Find a checkpoint and verify it.

        Damaged checkpoints are skipped with a warning, unless one is selected by its step.

        Args:
            root: the folder that holds the checkpoints of a run.
            which: "latest", "best" (by score), or a number of steps.

        Raises:
            MerlError: there is no such checkpoint, the selected one is damaged, or the disk does
                not let them be read.
        """
        with reporting(f"checkpoints {root} cannot be read"):
            found = folders(root)
        if which not in ("latest", "best"):
            named = {str(step): path for step, path in found.items()}
            if which not in named:
                choices = ", ".join(["latest", "best", *named])
                raise MerlError(f"checkpoint {which!r} does not exist: choose from {choices}")
            return cls.open(named[which])
        whole = []
        for path in reversed(found.values()):
            try:
                whole.append(cls.open(path))
            except Unreadable:
                raise
            except MerlError as error:
                _LOG.warning("%s: checkpoint skipped", error)
                continue
            if which == "latest":
                return whole[0]
        scored = [checkpoint for checkpoint in whole if checkpoint.score is not None]
        if not whole:
            raise MerlError(f"no complete checkpoint in {root}: the run ended before it saved one")
        return max(scored, key=lambda c: (c.score, c.step)) if scored else whole[0]

    def state(self) -> dict[str, Any]:
        """Return the `state` argument of `save`.

        Raises:
            MerlError: the file cannot be read or does not hold a dict.
        """
        with readable(self):
            state: dict[str, Any] = read_json(self.path / _STATE)
            if not isinstance(state, dict):
                raise TypeError(f"{_STATE} holds a {type(state).__name__}, not a dict")
        return state


def save(
    root: Path,
    step: int,
    agent: Agent,
    state: Mapping[str, Any],
    *,
    score: float | None,
    keep: int,
) -> Checkpoint:
    """Write a checkpoint, then delete old ones except the last `keep` and the best.

    Args:
        root: the folder that holds the checkpoints of the run.
        step: environment steps so far.
        agent: the agent to save.
        state: further state to save, as plain types for JSON.
        score: the evaluation return at this step; None if there was no evaluation.
        keep: number of recent checkpoints to keep.

    Raises:
        OSError: the checkpoint could not be written; earlier checkpoints are unchanged.
        NotFinite: a weight is NaN or infinite; earlier checkpoints are unchanged.
    """
    with torch_settings(_CPU):
        learnt = agent.state_dict()
        weights = {group: value for group, value in learnt.items() if _is_weights(group, value)}
        check_weights(weights)
    root.mkdir(exist_ok=True)  # no parents: do not recreate a run folder that was deleted
    part, final = root / f".part-{step:08d}", root / f"{step:08d}"
    former = root / f"{FORMER}{step:08d}"
    remove(part)
    part.mkdir()
    try:
        with torch_settings(_CPU):
            _write(part, weights, learnt, state)
        manifest = {
            "format": FORMAT,
            "step": step,
            "score": score,
            "files": {name: _fingerprint(part / name) for name in _FILES},
        }
        (part / MANIFEST).write_text(json.dumps(sealed(manifest), indent=1))
        for path in (*part.iterdir(), part):
            sync(path)
        if not is_gone(final):  # keep the old one until the new one replaces it
            remove(former)
            final.rename(former)
        part.rename(final)
        sync(root)
    except BaseException:
        remove(part)
        with suppress(OSError):  # it has not been renamed, or it has been replaced
            former.rename(final)
        raise
    with suppress(OSError):  # the next checkpoint deletes them
        prune(root, step, keep)
    return Checkpoint(final, step, score)


def load_agent(agent: Agent, checkpoint: Checkpoint) -> None:
    """Restore an agent to continue training: weights, optimizers and random generators.

    Raises:
        MerlError: a file cannot be read, or does not match the agent's networks.
    """
    with readable(checkpoint), torch_settings(_CPU):
        learner = _learner(checkpoint)
        agent.load_state_dict({**_weights(checkpoint), **learner})


def load_policy_of(agent: Agent, checkpoint: Checkpoint) -> None:
    """Restore an agent's policy to act only; the checkpoint may come from another device.

    Raises:
        MerlError: see `load_agent`.
    """
    with readable(checkpoint), torch_settings(_CPU):
        agent.load_policy(_weights(checkpoint))


@contextmanager
def readable(checkpoint: Checkpoint) -> Iterator[None]:
    """Convert an error inside the block into a one-line error about the checkpoint.

    Raises:
        MerlError: the block failed to read the checkpoint.
    """
    try:
        yield
    except MerlError:
        raise
    except (
        OSError,
        LookupError,
        MemoryError,
        RuntimeError,
        SafetensorError,
        *_BAD_VALUES,
    ) as error:
        why = " ".join(line.strip() for line in str(error).strip().split("\n")[:2])
        raise MerlError(f"checkpoint {checkpoint.path} cannot be loaded: {why}") from error


def _learner(checkpoint: Checkpoint) -> dict[str, Any]:
    """Load optimizers and generators; only tensors and plain values, no pickled objects.

    Raises:
        MerlError: the file holds something else. The message of torch, which recommends to unpickle
            the file, is not passed on.
    """
    path = checkpoint.path / _LEARNER
    try:
        with warnings.catch_warnings(action="ignore"):
            learner = torch.load(path, map_location="cpu", weights_only=True)
        if isinstance(learner, dict):
            return learner
    except OSError:
        raise
    except Exception:
        pass
    raise MerlError(
        f"checkpoint {checkpoint.path} cannot be loaded: {_LEARNER} holds something other than "
        "tensors and plain values; loading it could run code: use another checkpoint"
    )


def _weights(checkpoint: Checkpoint) -> dict[str, dict[str, torch.Tensor]]:
    weights: dict[str, dict[str, torch.Tensor]] = {}
    for whole, tensor in load_file(checkpoint.path / _WEIGHTS).items():
        group, _, name = whole.partition(".")
        weights.setdefault(group, {})[name] = tensor
    return weights


def _is_weights(group: str, value: Any) -> bool:
    """Return whether a part of an agent's state is a dict of tensors, as of `nn.Module`."""
    is_dict = isinstance(value, Mapping) and bool(value) and "." not in group
    return is_dict and all(isinstance(tensor, torch.Tensor) for tensor in value.values())


def _write(
    folder: Path,
    weights: Mapping[str, Mapping[str, torch.Tensor]],
    agent: Mapping[str, Any],
    state: Mapping[str, Any],
) -> None:
    flat = {
        f"{group}.{name}": tensor.detach().cpu().contiguous()
        for group, tensors in weights.items()
        for name, tensor in tensors.items()
    }
    learner = io.BytesIO()
    torch.save({key: value for key, value in agent.items() if key not in weights}, learner)
    # Write the bytes from Python, so that a full disk raises OSError for every format.
    (folder / _WEIGHTS).write_bytes(to_bytes(flat))
    (folder / _LEARNER).write_bytes(learner.getbuffer())
    (folder / _STATE).write_text(json.dumps(state))


def _fingerprint(path: Path, most: int | None = None) -> dict[str, Any]:
    """Return size and SHA-256 of a file of at most `most` bytes."""
    with open_file(path, most=most) as file:
        digest = hashlib.file_digest(cast(io.BufferedReader, file), "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}
