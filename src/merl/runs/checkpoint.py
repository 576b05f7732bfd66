"""Checkpoints: folders that are whole or not there at all.

`checkpoints/00010000/` holds `weights.safetensors` (networks and target), `learner.pt` (optimizers
and random generators; read with `weights_only=True`), `state.json` (where the run stood) and
`manifest.json` (sizes and SHA-256 of the others). It is written under a temporary name, flushed to
the disk, then renamed.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from safetensors.torch import save as to_bytes
from torch import nn

from merl.core import Agent, MerlError
from merl.core.guards import check_weights
from merl.networks.settings import torch_settings

FORMAT = 1
_WEIGHTS, _LEARNER, _STATE, _MANIFEST = (
    "weights.safetensors",
    "learner.pt",
    "state.json",
    "manifest.json",
)
_FILES = (_WEIGHTS, _LEARNER, _STATE)
_BAD_VALUES = (ValueError, TypeError, AttributeError, RecursionError)
_WEIGHT_GROUPS = ("networks", "critic_target")
_CPU = torch.device("cpu")
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint on the disk, checked against its manifest.

    Attributes:
        path: its folder.
        step: environment steps at which it was taken.
        score: the evaluation return at that step, if there was one.
    """

    path: Path
    step: int
    score: float | None

    @classmethod
    def open(cls, path: Path) -> Checkpoint:
        """Read the manifest and check every file against it.

        Raises:
            MerlError: a file is missing, cut short or changed.
        """
        try:
            manifest = json.loads((path / _MANIFEST).read_text())
            files, number = manifest["files"], manifest["format"]
            step, score = int(manifest["step"]), manifest["score"]
            score = None if score is None else float(score)
            if step < 0 or any(Path(name).name != name for name in files):
                raise ValueError(f"step {step}, files {', '.join(files)}")
            missing = {*_FILES} - {*files.keys()}
            if missing:
                raise ValueError(f"it does not list {', '.join(sorted(missing))}")
        except (OSError, LookupError, ArithmeticError, *_BAD_VALUES) as error:
            raise MerlError(f"checkpoint {path} has no readable manifest ({error})") from None
        if number != FORMAT:
            raise MerlError(f"checkpoint {path} has format {number}, this merl reads {FORMAT}")
        for name, expected in files.items():
            try:
                whole = _fingerprint(path / name) == expected
            except OSError:
                whole = False
            if not whole:
                raise MerlError(f"checkpoint {path}: {name} is missing or damaged")
        return cls(path, step, score)

    @classmethod
    def find(cls, root: Path, which: str = "latest") -> Checkpoint:
        """The "latest" whole checkpoint, the "best", or the one of a number of steps.

        Raises:
            MerlError: there is none.
        """
        if which not in ("latest", "best"):
            named = {str(int(path.name)): path for path in _folders(root)}
            if which not in named:
                there = ", ".join(["latest", "best", *named])
                raise MerlError(f"checkpoint {which!r} is not there: choose from {there}")
            return cls.open(named[which])
        whole = []
        for path in reversed(_folders(root)):
            try:
                whole.append(cls.open(path))
            except MerlError as error:
                _LOG.warning("%s: passed over", error)
                continue
            if which == "latest":
                return whole[0]
        scored = [checkpoint for checkpoint in whole if checkpoint.score is not None]
        if not whole:
            raise MerlError(f"no whole checkpoint in {root}: the run ended before its first one")
        return max(scored, key=lambda c: (c.score, c.step)) if scored else whole[0]

    def state(self) -> dict[str, Any]:
        """Return the state that `save` was given.

        Raises:
            MerlError: the file cannot be read, or does not have the form that merl writes.
        """
        with readable(self):
            state: dict[str, Any] = json.loads((self.path / _STATE).read_text())
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
    """Write a checkpoint, then let go of old ones but the last `keep` and the best.

    Args:
        root: the run's folder of checkpoints.
        step: environment steps so far.
        agent: whose state is saved.
        state: plain types, to be kept beside the agent.
        score: the evaluation return at this step, if there was an evaluation.
        keep: how many of the last ones to keep.

    Raises:
        OSError: it could not be written; the former ones are untouched.
        NotFinite: a weight is a NaN or an infinity; so are they then.
    """
    with torch_settings(_CPU):
        learnt = agent.state_dict()
        check_weights({group: learnt[group] for group in _WEIGHT_GROUPS})
    root.mkdir(exist_ok=True)  # no parents: a run's folder that was taken away stays away
    part = root / f".part-{step:08d}"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        with torch_settings(_CPU):
            _write(part, learnt, state)
        names = (_WEIGHTS, _LEARNER, _STATE)
        manifest = {
            "format": FORMAT,
            "step": step,
            "score": score,
            "files": {name: _fingerprint(part / name) for name in names},
        }
        (part / _MANIFEST).write_text(json.dumps(manifest, indent=1))
        for path in (*part.iterdir(), part):
            _sync(path)
        final = root / f"{step:08d}"
        former = root / f".part-{step:08d}-former"
        if final.exists():  # there until the very moment at which the new one takes its place
            final.rename(former)
        try:
            part.rename(final)
        except OSError:
            if former.exists():
                former.rename(final)
            raise
        _sync(root)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    _prune(root, step, keep)
    return Checkpoint(final, step, score)


def load_agent(agent: Agent, checkpoint: Checkpoint) -> None:
    """Give an agent the weights, optimizers and generators of a checkpoint, to learn on.

    Raises:
        MerlError: a file cannot be read, or belongs to other networks.
    """
    with readable(checkpoint), torch_settings(_CPU):
        learner = _learner(checkpoint)
        agent.load_state_dict({**_weights(checkpoint), **learner})


def load_networks(networks: nn.Module, checkpoint: Checkpoint) -> None:
    """Give networks the weights of a checkpoint, to act with; it may be from another device.

    Raises:
        MerlError: a file cannot be read, or belongs to other networks.
    """
    with readable(checkpoint), torch_settings(_CPU):
        networks.load_state_dict(_weights(checkpoint)["networks"])


@contextmanager
def readable(checkpoint: Checkpoint) -> Iterator[None]:
    """Say in one line why a checkpoint cannot be read.

    Raises:
        MerlError: something in here failed to read the checkpoint.
    """
    try:
        yield
    except MerlError:
        raise
    except (
        OSError,
        RuntimeError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        SafetensorError,
    ) as error:
        why = " ".join(line.strip() for line in str(error).strip().split("\n")[:2])
        raise MerlError(f"checkpoint {checkpoint.path} cannot be loaded: {why}") from None


def _learner(checkpoint: Checkpoint) -> dict[str, Any]:
    """Optimizers and generators: tensors and plain values only, nothing is unpickled.

    Raises:
        MerlError: the file holds something else. torch would advise to unpickle it all the same.
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
        f"checkpoint {checkpoint.path} cannot be loaded: {_LEARNER} holds something else than the "
        "tensors and plain values that merl writes; loading that could run code"
    )


def _weights(checkpoint: Checkpoint) -> dict[str, dict[str, torch.Tensor]]:
    weights = load_file(checkpoint.path / _WEIGHTS)
    return {
        group: {
            name.removeprefix(f"{group}."): tensor
            for name, tensor in weights.items()
            if name.startswith(f"{group}.")
        }
        for group in _WEIGHT_GROUPS
    }


def _write(folder: Path, agent: Mapping[str, Any], state: Mapping[str, Any]) -> None:
    weights = {
        f"{group}.{name}": tensor.detach().cpu().contiguous()
        for group in _WEIGHT_GROUPS
        for name, tensor in agent[group].items()
    }
    learner = io.BytesIO()
    torch.save({k: v for k, v in agent.items() if k not in _WEIGHT_GROUPS}, learner)
    # Python writes the bytes: a full disk is then an OSError, whatever the format.
    (folder / _WEIGHTS).write_bytes(to_bytes(weights))
    (folder / _LEARNER).write_bytes(learner.getbuffer())
    (folder / _STATE).write_text(json.dumps(state))


def _folders(root: Path) -> list[Path]:
    """Checkpoints by step, oldest first."""
    if not root.is_dir():
        return []
    folders = [path for path in root.iterdir() if path.is_dir() and _is_number(path.name)]
    return sorted(folders, key=lambda path: int(path.name))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdecimal()


def _prune(root: Path, step: int, keep: int) -> None:
    """Let go of what is neither among the last nor the best.

    A checkpoint of a later step was passed over as damaged when the run went on from before it.
    """
    folders = _folders(root)
    past = [path for path in folders if int(path.name) <= step]
    scores = {path: score for path, score in _scores(past) if score is not None}
    best = max(scores, key=lambda path: scores[path]) if scores else None
    stale = [path for path in root.glob(".part-*") if path.is_dir()]
    for path in [*stale, *(path for path in folders if path not in past), *past[:-keep]]:
        if path != best:
            shutil.rmtree(path, ignore_errors=True)


def _scores(folders: list[Path]) -> Iterator[tuple[Path, float | None]]:
    for path in folders:
        try:
            yield path, json.loads((path / _MANIFEST).read_text())["score"]
        except (OSError, ValueError, KeyError):
            yield path, None


def _fingerprint(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}


def _sync(path: Path) -> None:
    """Have a file, or a folder's list of names, reach the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
