"""Evaluation of a policy whose senses, actions or scene are disturbed.

It shows which sense a policy relies on, and what it tolerates. Every disturbance is evaluated from
the same start states as the undisturbed policy. Noise and bias of numbers are in units of their
standard deviation in undisturbed episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from merl.core import Kind
from merl.evaluation.evaluation import Evaluation
from merl.evaluation.policy import Policy

Value = NDArray[Any]
Values = list[Value]
"""Values of one key since the episode began, the newest last."""
Env = gymnasium.Env[Any, Any]

NOISE = 20 / 255
"""Standard deviation of the noise of images, as a share of their range."""
SHIFT = 0.05
"""Shift of an image to the right, as a share of its width; the left edge is repeated."""
DELAYS = (1, 2, 5)
"""Steps."""
SHARES = (0.1, 0.5)
"""Standard deviation of the noise, and size of the bias, of numbers."""
LIGHT = 0.5
"""Factor of the light's brightness."""
TINT = np.array([1.3, 1.0, 0.6])
"""Factors of red, green and blue of the colours of the floor."""
FRAMES: tuple[Kind, ...] = ("image", "depth")
NUMBERS: tuple[Kind, ...] = ("vector", "sequence")


@dataclass(frozen=True)
class Disturbance:
    """A disturbance by name.

    Attributes:
        sense: what it disturbs: `camera`, `joints` (all vectors and histories), `actions`, `scene`;
            `none` for the undisturbed policy.
        name: the name within this sense.
        wrap: adds it to an environment.
        form: fields of `EnvConfig`, for another form of a task of merl.
    """

    sense: str
    name: str
    wrap: Callable[[Env], Env] = lambda env: env
    form: Mapping[str, Any] = field(default_factory=dict)


def robustness(
    policy: Policy, episodes: int, *, trust: bool = False
) -> Iterator[tuple[Disturbance, Evaluation]]:
    """Evaluate a policy undisturbed, then with each disturbance that its senses can have.

    Args:
        policy: the policy.
        episodes: number of episodes of each evaluation.
        trust: see `Policy.make_env`.

    Raises:
        MerlError: see `Policy.evaluate`.
    """
    seen: dict[str, Values] = {
        key: [] for key, modality in policy.modalities.items() if modality.kind in NUMBERS
    }
    undisturbed = Disturbance("none", "undisturbed", partial(Recorder, seen=seen))
    yield undisturbed, policy.evaluate(episodes=episodes, trust=trust, wrap=undisturbed.wrap)
    scales = {key: np.std(values, axis=0) for key, values in seen.items()}
    for each in disturbances(policy, scales):
        yield each, policy.evaluate(episodes=episodes, trust=trust, wrap=each.wrap, **each.form)


def disturbances(policy: Policy, scales: Mapping[str, Value]) -> Iterator[Disturbance]:
    """Yield the disturbances that a policy's senses can have.

    Args:
        policy: the policy.
        scales: the standard deviation of each key with numbers.
    """
    modalities = policy.modalities
    frames = [key for key, modality in modalities.items() if modality.kind in FRAMES]
    numbers = [key for key, modality in modalities.items() if modality.kind in NUMBERS]
    delays: dict[str, Change] = {f"delayed by {n}": partial(_delayed, n) for n in DELAYS}
    camera: dict[str, Change] = {
        "frozen": lambda values, rng: values[0],
        "black": lambda values, rng: np.zeros_like(values[-1]),
        "shifted": lambda values, rng: _shifted(values[-1]),
        "noise": lambda values, rng: _with_noise(values[-1], rng),
    }
    joints: dict[str, Change] = {
        "frozen": lambda values, rng: values[0],
        "dropped": lambda values, rng: np.zeros_like(values[-1]),
    }
    if frames:
        for name, change in (camera | delays).items():
            yield Disturbance(
                "camera", name, partial(Changed, changes=dict.fromkeys(frames, change))
            )
    if numbers:
        for name, change in (joints | delays).items():
            yield Disturbance(
                "joints", name, partial(Changed, changes=dict.fromkeys(numbers, change))
            )
        for name, disturbed in (("noise", _noisy), ("bias", _biased)):
            for share in SHARES:
                changes = {key: partial(disturbed, share * scales[key]) for key in numbers}
                yield Disturbance("joints", f"{name} {share:g}", partial(Changed, changes=changes))
    for steps in DELAYS:
        yield Disturbance("actions", f"delayed by {steps}", partial(LateActions, steps=steps))
    if frames and not policy.config.has_user_env:
        yield Disturbance("scene", "darker light", _with_darker_light)
        yield Disturbance("scene", "other floor", _with_other_floor)
        from merl.tasks import ABOVE, BOX_TASKS  # loads the simulator

        env = policy.config.evaluated.env
        if policy.config.task in BOX_TASKS and env.start == ABOVE and not env.occluded:
            yield Disturbance("scene", "occluded", form={"occluded": True})


Change = Callable[[Values, np.random.Generator], Value]
"""A function from the values of a key in this episode to the disturbed newest value."""


class Changed(gymnasium.ObservationWrapper[Any, Any, Any]):
    """A wrapper that changes keys of the observation.

    Args:
        env: the environment.
        changes: the change of each key.
    """

    def __init__(self, env: Env, changes: Mapping[str, Change]) -> None:
        super().__init__(env)
        self._changes = changes
        self._values: dict[str, Values] = {}
        self._rng = np.random.default_rng(0)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode; the random numbers depend on its seed alone."""
        self._values = {key: [] for key in self._changes}
        self._rng = np.random.default_rng(options.get("seed"))
        return super().reset(**options)

    def observation(self, observation: Mapping[str, Value]) -> dict[str, Value]:
        """Return the observation with the changes."""
        changed = dict(observation)
        for key, change in self._changes.items():
            self._values[key].append(observation[key])
            value = np.asarray(change(self._values[key], self._rng))
            changed[key] = value.astype(observation[key].dtype)
        return changed


class Recorder(gymnasium.ObservationWrapper[Any, Any, Any]):
    """A wrapper that records the values of keys.

    Args:
        env: the environment.
        seen: a list for each key, to which its values are appended.
    """

    def __init__(self, env: Env, seen: Mapping[str, Values]) -> None:
        super().__init__(env)
        self._seen = seen

    def observation(self, observation: Mapping[str, Value]) -> Mapping[str, Value]:
        """Record the values, and return the observation unchanged."""
        for key, values in self._seen.items():
            values.append(observation[key])
        return observation


class LateActions(gymnasium.Wrapper[Any, Any, Any, Any]):
    """A wrapper that executes each action some steps later; the first steps have the action 0."""

    def __init__(self, env: Env, steps: int) -> None:
        super().__init__(env)
        self._steps = steps
        self._waiting: list[Value] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Start an episode."""
        shape = self.action_space.shape or ()
        self._waiting = [np.zeros(shape, np.float32) for _ in range(self._steps)]
        return self.env.reset(**options)

    def step(self, action: Value) -> Any:
        """Take the action of some steps ago."""
        self._waiting.append(action)
        return self.env.step(self._waiting.pop(0))


def _delayed(steps: int, values: Values, rng: np.random.Generator) -> Value:
    return values[max(0, len(values) - 1 - steps)]


def _shifted(frame: Value) -> Value:
    """Return a frame (H, W, C) moved to the right."""
    pixels = max(1, round(SHIFT * frame.shape[1]))
    return np.pad(frame[:, :-pixels], ((0, 0), (pixels, 0), (0, 0)), mode="edge")


def _with_noise(frame: Value, rng: np.random.Generator) -> Value:
    high = 255.0 if frame.dtype == np.uint8 else float(frame.max())
    return np.clip(frame + rng.normal(0.0, NOISE * high, frame.shape), 0.0, high)


def _noisy(deviation: Value, values: Values, rng: np.random.Generator) -> Value:
    noisy: Value = values[-1] + deviation * rng.normal(size=deviation.shape)
    return noisy


def _biased(size: Value, values: Values, rng: np.random.Generator) -> Value:
    """Add a constant, of the same random signs in every step and every episode."""
    biased: Value = values[-1] + size * np.random.default_rng(0).choice([-1.0, 1.0], size.shape)
    return biased


def _with_darker_light(env: Env) -> Env:
    """Reduce the light of a task of merl; before the first image is drawn."""
    model = env.get_wrapper_attr("physics").model
    model.light_diffuse[:] *= LIGHT
    model.vis.headlight.diffuse[:] *= LIGHT
    model.vis.headlight.ambient[:] *= LIGHT
    return env


def _with_other_floor(env: Env) -> Env:
    """Change the colour of the floor of a task of merl; before the first image is drawn."""
    model = env.get_wrapper_attr("physics").model
    for geom in np.flatnonzero(model.geom_type == 0):  # planes
        material = model.geom_matid[geom]
        colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        colour[:3] = np.clip(colour[:3] * TINT, 0.0, 1.0)
    return env
