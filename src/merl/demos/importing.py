"""Import of demonstrations from the formats of other projects, checked against an environment.

Nothing is written unless every episode fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from PIL import Image

from merl.core import MerlError, counted, suggest
from merl.core.files import part_of, remove, reporting
from merl.core.user_code import in_one_line
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode, check_episode
from merl.demos.lerobot_reader import INFO, LeRobotDataset
from merl.demos.lerobot_writer import lerobot_name
from merl.demos.minari_data import MinariData
from merl.demos.recorder import Recorder, check_free
from merl.demos.robomimic import RobomimicFile
from merl.demos.source import Feature, RawEpisode, Source

Actions = Literal["unit", "env"]
RATE_TOLERANCE = 0.01
"""Relative difference of two rates that still count as equal."""
ROUNDING = 1e-4
"""Distance of an action from [-1, 1] that still counts as rounding."""


@dataclass(frozen=True)
class Target:
    """The environment that demonstrations are imported for.

    Attributes:
        task: its name.
        observation_space, action_space: its spaces, in the form that agents use.
        bounds: lower and upper bounds of the actions in its own units; None if they are [-1, 1].
        rate: timesteps in a second; None if it is not known.
        options: options of the task, if it is one of merl's.
    """

    task: str
    observation_space: spaces.Dict
    action_space: spaces.Box
    bounds: tuple[list[float], list[float]] | None
    rate: float | None
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Rules:
    """How values of a source become those of an environment.

    Attributes:
        keys: {key of the environment: feature of the source}; a key that is left out takes the
            feature of its name.
        actions: the source's actions are in [-1, 1] (`unit`), or in the environment's own units
            (`env`).
        clip: clip actions beyond the bounds; otherwise they are an error.
        resize: resize images that have another size.
        any_rate: accept another rate than the environment's.
    """

    keys: Mapping[str, str] = field(default_factory=dict)
    actions: Actions = "unit"
    clip: bool = False
    resize: bool = False
    any_rate: bool = False


def open_source(path: Path) -> Source:
    """Open a folder or file in one of the formats, which its content shows.

    Raises:
        MerlError: it is in none of them, or damaged.
    """
    try:
        if (path / INFO).is_file():
            return LeRobotDataset(path)
        if (path / "data" / "metadata.json").is_file():
            return MinariData(path)
        if path.is_file():
            return RobomimicFile(path)
        if not path.exists():
            raise MerlError(f"{path} does not exist")
    except MerlError:
        raise
    except Exception as error:  # a damaged file makes a package raise anything
        raise MerlError(f"{path} cannot be read: {in_one_line(error)}") from None
    raise MerlError(
        f"{path} is neither a LeRobotDataset v3 (it has no {INFO}), nor a dataset of Minari (it "
        "has no data/metadata.json), nor an HDF5 file of robomimic"
    )


def import_demos(source: Source, out: Path, target: Target, rules: Rules) -> Demonstrations:
    """Convert all episodes of a source to demonstrations for an environment.

    Args:
        source: the source.
        out: folder of the demonstrations, which must not exist or be empty.
        target: the environment.
        rules: how to convert.

    Raises:
        MerlError: the source does not fit the environment or is damaged; nothing is written.
    """
    if not source.count:
        raise MerlError(f"{source.path} holds no episode")
    keys, out = matched(source, target, rules), out.absolute()
    check_free(out)
    part = part_of(out)
    remove(part)
    made = f"{source.format} {source.path.name}"
    try:
        recorder = Recorder(
            part,
            target.task,
            made,
            target.observation_space,
            target.action_space,
            target.options,
        )
        for raw in source.episodes(tuple(dict.fromkeys(keys.values()))):
            recorder.add(converted(raw, source, keys, target, rules))
        with reporting(f"{out} cannot be written"):
            if out.exists():
                out.rmdir()
            part.replace(out)
    except MerlError:
        raise
    except Exception as error:  # a package, or values of another kind than they say
        raise MerlError(f"{source.path} cannot be read: {in_one_line(error)}") from None
    finally:
        remove(part)
    return Demonstrations.open(out)


def matched(source: Source, target: Target, rules: Rules) -> dict[str, str]:
    """Return the feature for each key of the environment, checked.

    Raises:
        MerlError: a feature is missing or does not fit, or the actions or the rate differ.
    """
    given = target.observation_space.spaces
    for key in rules.keys:
        if key not in given:
            raise MerlError(
                f"--keys names {key!r}, but the environment has {', '.join(given)}: "
                f"{suggest(key, tuple(given))}"
            )
    keys = {}
    for key, space in given.items():
        keys[key] = name = rules.keys.get(key) or _name_of(key, source)
        if name not in source.features:
            have = ", ".join(source.features)
            raise MerlError(
                f"{source.path} has no feature {name!r} for observation {key!r}: it has {have}; "
                f"name one with --keys {key}=FEATURE"
            )
        _check_feature(source, key, name, space, rules)
    if source.action_size != target.action_space.shape[0]:
        raise MerlError(
            f"{source.path}: an action has {counted(source.action_size, 'number')}, and "
            f"{target.task} takes {target.action_space.shape[0]}"
        )
    if (
        source.rate is not None
        and target.rate is not None
        and not rules.any_rate
        and not abs(source.rate / target.rate - 1.0) <= RATE_TOLERANCE  # NaN is no rate
    ):
        raise MerlError(
            f"{source.path} has {source.rate:g} steps per second, and {target.task} has "
            f"{target.rate:g}: a step would mean another time; import them all the same with "
            "--any-rate"
        )
    return keys


def converted(
    raw: RawEpisode, source: Source, keys: Mapping[str, str], target: Target, rules: Rules
) -> Episode:
    """Return an episode of a source as an episode of the environment.

    Without the observation after the last action, that before it is repeated. Without rewards, the
    reward is 1 at the last step of an episode that does not end in failure, which then ends by
    termination unless the source says otherwise; else it is 0.

    Raises:
        MerlError: a value does not fit.
    """
    where = f"{source.path}, {raw.name}"
    steps = len(raw.actions)
    if not steps:
        raise MerlError(f"{where} has no step")
    observations = {}
    for key, name in keys.items():
        space, value = target.observation_space[key], raw.observations[name]
        if len(value) not in (steps, steps + 1):
            raise MerlError(f"{where}: {name!r} has {len(value)} values, and {steps} actions")
        value = _fitted(f"{where}: {name!r}", value, space, resize=rules.resize)
        observations[key] = value if len(value) > steps else np.concatenate([value, value[-1:]])
    actions = _scaled(where, raw.actions, target, rules)
    rewards, terminated = raw.rewards, raw.terminated
    if rewards is None:
        rewards = np.zeros(steps, np.float32)
        rewards[-1] = solved = raw.success is not False
        terminated = solved if terminated is None else terminated
    intended = actions if raw.intended is None else _scaled(where, raw.intended, target, rules)
    episode = Episode(
        observations,
        actions,
        intended,
        rewards.astype(np.float32),
        bool(terminated),
        raw.success,
        None if raw.successes is None else raw.successes.astype(bool),
    )
    check_episode(where, episode, target.observation_space, target.action_space)
    return episode


def _name_of(key: str, source: Source) -> str:
    """Return the feature that has a key's name, in merl's spelling or in LeRobot's."""
    names = (lerobot_name(key, image=True), lerobot_name(key, image=False), key)
    return next((name for name in names if name in source.features), key)


def _check_feature(
    source: Source, key: str, name: str, space: spaces.Space[Any], rules: Rules
) -> None:
    feature, shape = source.features[name], space.shape or ()
    fits = _flat(feature.shape) == _flat(shape)
    image = space.dtype == np.uint8
    if fits and (feature.dtype == "uint8") == image:
        return
    told = f"{source.path}: feature {name!r} is {feature}, and observation {key!r} is " + str(
        Feature(shape, str(space.dtype))
    )
    if image and feature.image and feature.shape[2:] == shape[2:]:
        if rules.resize:
            return
        raise MerlError(f"{told}: resize its images with --resize")
    raise MerlError(f"{told}: name another with --keys {key}=FEATURE")


def _flat(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return a shape without axes of one: () and (1,), (n,) and (n, 1) hold the same."""
    return tuple(size for size in shape if size != 1)


def _fitted(
    what: str, value: NDArray[Any], space: spaces.Space[Any], *, resize: bool
) -> NDArray[Any]:
    """Return values with shape and type of a space, checked against its bounds."""
    assert isinstance(space, spaces.Box)
    whole = np.issubdtype(space.dtype, np.integer)
    if value.dtype.kind not in ("biu" if whole else "biuf"):
        raise MerlError(f"{what} is {value.dtype}, and the observation {space.dtype}")
    if value.ndim == 4 and value.dtype == np.uint8 and value.shape[1:] != space.shape and resize:
        height, width = space.shape[:2]
        value = np.stack([_resized(frame, height, width) for frame in value])
    if _flat(value.shape[1:]) != _flat(space.shape):
        raise MerlError(
            f"{what} has the shape {value.shape[1:]}, and the observation {space.shape}"
            + (": resize images with --resize" if value.ndim == 4 else "")
        )
    value = value.reshape(len(value), *space.shape)
    below, above = (value < space.low).any(), (value > space.high).any()
    if below or above:
        worst = float(value.min() if below else value.max())
        raise MerlError(
            f"{what} is {worst:g} somewhere, which is outside of the observation's bounds, "
            f"[{space.low.min():g}, {space.high.max():g}]: its unit differs"
        )
    return value.astype(space.dtype, copy=False)


def _resized(frame: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Return a frame (H, W, C) of another size; each pixel is the mean of those that it covers."""
    image = Image.fromarray(frame.squeeze(-1) if frame.shape[-1] == 1 else frame)
    found = np.asarray(image.resize((width, height), Image.Resampling.BOX))
    return found.reshape(height, width, frame.shape[-1])


def _scaled(where: str, actions: NDArray[Any], target: Target, rules: Rules) -> NDArray[np.float32]:
    """Return actions in [-1, 1]."""
    if actions.dtype.kind not in "biuf":
        raise MerlError(f"{where}: actions are {actions.dtype}, not numbers")
    values = actions.astype(np.float64)
    if rules.actions == "env" and target.bounds is not None:
        low, high = (np.asarray(bound, np.float64) for bound in target.bounds)
        values = 2.0 * (values - low) / (high - low) - 1.0
    beyond = np.abs(values) > 1.0 + ROUNDING
    if beyond.any() and not rules.clip:
        step, index = np.argwhere(beyond)[0]
        units = "in the environment's own units" if rules.actions == "env" else "in [-1, 1]"
        other = "unit" if rules.actions == "env" else "env"
        raise MerlError(
            f"{where}: number {index} of action {step} is {actions[step, index]:g}, which is not "
            f"{units}: use --actions {other}, or cut such actions off with --clip"
        )
    return np.clip(values, -1.0, 1.0).astype(np.float32)
