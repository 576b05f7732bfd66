"""Training of a classifier of success from the images of demonstrations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from merl.core import MerlError
from merl.core.files import replace_file, reporting
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode
from merl.envs.learnt_success import SHAPES
from merl.modalities import Image, modalities_of
from merl.networks.augmentation import draw_shifts, shift
from merl.networks.success_classifier import SuccessNetwork

LEARNING_RATE = 1e-3
BATCH = 64
SHIFT = 1 / 24
"""Largest shift of an image in training, as a share of its height."""
HELD_OUT = 0.2
"""Share of the episodes that the classifier is tested on."""


@dataclass(frozen=True)
class Labelled:
    """Images with labels.

    Attributes:
        images: uint8 (N, H, W, C) by key.
        solved: whether the task is solved in each, (N,).
        episode: the number of its episode, (N,).
    """

    images: dict[str, NDArray[np.uint8]]
    solved: NDArray[np.bool_]
    episode: NDArray[np.int64]

    def part(self, chosen: NDArray[Any]) -> Labelled:
        """Return the chosen images."""
        images = {key: values[chosen] for key, values in self.images.items()}
        return Labelled(images, self.solved[chosen], self.episode[chosen])

    def tensors(self, index: Tensor | slice = slice(None)) -> dict[str, Tensor]:
        """Return images as tensors, (B, H, W, C) by key."""
        return {key: torch.from_numpy(values)[index] for key, values in self.images.items()}


@dataclass(frozen=True)
class Report:
    """How a classifier does on episodes that it was not trained on.

    Attributes:
        solved: number of images in which the task is solved.
        found: how many of these it recognises.
        others: number of the other images.
        alarms: how many of these it takes for a success.
    """

    solved: int
    found: int
    others: int
    alarms: int


def label(folders: Sequence[Demonstrations], keys: Sequence[str] = ()) -> Labelled:
    """Return the images of demonstrations with their labels.

    Args:
        folders: demonstrations of one task, also of episodes that fail.
        keys: the cameras; all of them if empty.

    Raises:
        MerlError: a camera is missing, or the labels do not contain both success and failure.
    """
    space = folders[0].observation_space
    cameras = [key for key, kind in modalities_of(space).items() if isinstance(kind, Image)]
    for key in keys:
        if key not in cameras:
            raise MerlError(f"{folders[0].path} has no image {key!r}: choose from {cameras}")
    used = list(keys) or cameras
    parts: dict[str, list[NDArray[np.uint8]]] = {key: [] for key in used}
    solved, numbers = list[NDArray[np.bool_]](), list[NDArray[np.int64]]()
    for folder in folders:
        folder.check_fits(space, folders[0].action_space)
        for episode in folder.episodes():
            known, labels = _labels(episode)
            for key in used:
                parts[key].append(episode.observations[key][known])
            solved.append(labels)
            numbers.append(np.full(len(labels), len(numbers)))
    every = np.concatenate(solved)
    if not used or every.all() or not every.any():
        shows = "no image" if not used else "only success" if every.all() else "no success"
        raise MerlError(
            f"{folders[0].path} shows {shows}: a classifier needs images with success and without "
            "(`merl demos record --failures`)"
        )
    images = {key: np.concatenate(values) for key, values in parts.items()}
    return Labelled(images, every, np.concatenate(numbers))


def _labels(episode: Episode) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the observations whose label is known, and whether the task is solved there."""
    steps = len(episode)
    if episode.successes is not None:
        return np.arange(1, steps + 1), episode.successes
    if episode.success is None:
        return np.arange(0), np.zeros(0, bool)
    if episode.success:  # when it was solved is unknown, but at its end it was
        return np.array([steps]), np.ones(1, bool)
    return np.arange(steps + 1), np.zeros(steps + 1, bool)


def train_classifier(
    data: Labelled, *, updates: int, threshold: float, seed: int = 0
) -> tuple[SuccessNetwork, Report]:
    """Train a classifier; return it and how it does on held-out episodes.

    Each batch has as many images with success as without, randomly shifted.

    Raises:
        MerlError: there are too few episodes.
    """
    rng = np.random.default_rng(seed)
    held = _held_out(data, rng)
    train, test = data.part(~held), data.part(held)
    torch.manual_seed(seed)
    network = SuccessNetwork({key: values.shape[1:] for key, values in data.images.items()})
    network(train.tensors(slice(0, 1)))  # gives the lazy layers their sizes
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    kinds = [np.flatnonzero(train.solved), np.flatnonzero(~train.solved)]
    target = torch.arange(BATCH) < BATCH // 2
    generator = torch.Generator().manual_seed(seed)
    for _ in range(updates):
        index = torch.from_numpy(np.concatenate([rng.choice(kind, BATCH // 2) for kind in kinds]))
        images = {key: _shifted(values, generator) for key, values in train.tensors(index).items()}
        loss = binary_cross_entropy_with_logits(network(images), target.float())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return network.eval(), _report(network, test, threshold)


def _shifted(images: Tensor, generator: torch.Generator) -> Tensor:
    """Shift each of the images (B, H, W, C) at random."""
    pad = max(1, round(SHIFT * images.shape[1]))
    return shift(images[:, None], draw_shifts(len(images), pad, generator), pad)[:, 0]


def _held_out(data: Labelled, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which images are held out: a share of the episodes with success, and of the others."""
    episodes = np.unique(data.episode)
    succeeds = np.array([data.solved[data.episode == number].any() for number in episodes])
    held: list[int] = []
    for kind in (True, False):
        found = rng.permutation(episodes[succeeds == kind])
        held += found[: round(HELD_OUT * len(found))].tolist()
    chosen = np.isin(data.episode, held)
    for part in (chosen, ~chosen):
        if not part.any() or data.solved[part].all() or not data.solved[part].any():
            raise MerlError(
                f"{len(episodes)} episodes are too few to train and to test a classifier: record "
                "more, some with and some without success"
            )
    return chosen


def _report(network: SuccessNetwork, data: Labelled, threshold: float) -> Report:
    with torch.inference_mode():
        parts = [slice(at, at + 512) for at in range(0, len(data.solved), 512)]
        logits = torch.cat([network(data.tensors(part)) for part in parts])
    says = (logits.sigmoid() >= threshold).numpy()
    solved = data.solved
    return Report(
        int(solved.sum()), int(says[solved].sum()), int((~solved).sum()), int(says[~solved].sum())
    )


def save_classifier(network: SuccessNetwork, data: Labelled, file: Path) -> None:
    """Write a classifier, for `merl.envs.learnt_success.LearntSuccess`.

    Raises:
        MerlError: the file cannot be written; an existing one keeps its content.
    """
    shapes = {key: values.shape[1:] for key, values in data.images.items()}
    content = save(network.state_dict(), {SHAPES: json.dumps(shapes)})
    with reporting(f"{file} cannot be written"):
        replace_file(file, content)
