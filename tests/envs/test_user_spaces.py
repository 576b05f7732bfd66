"""Spaces of a user's environment: which are used, how, and the advice for the others."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from test_user_envs import SpaceEnv, image, vector

from merl.core import EnvironmentFailed, MerlError
from merl.envs.config import UserEnvConfig
from merl.envs.user_env import adapt
from merl.envs.user_spaces import advice, brief, user_key
from merl.modalities import Depth, Modality, Sequence

LARGEST32, LARGEST64 = float(np.finfo(np.float32).max), float(np.finfo(np.float64).max)


# -- images ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [1, 3, 4, 6, 9, 12, 15, 36])
@pytest.mark.parametrize("size", [(48, 64), (84, 84), (40, 40)])
def test_the_smaller_outer_axis_is_the_channel_axis(channels: int, size: tuple[int, int]) -> None:
    for shape, first in (((channels, *size), True), ((*size, channels), False)):
        used = user_key("camera", image(*shape), "auto")
        assert used is not None
        assert (used.modality.space.shape, used.channels_first) == ((*size, channels), first)


@pytest.mark.parametrize(
    "shape",
    [(5, 84, 84), (84, 84, 5), (2, 84, 84), (84, 84, 2), (20, 20, 20), (24, 24, 32), (3, 84, 3),
     (16, 16, 16), (84, 84, 84), (39, 84, 84), (24, 32, 36)],
)  # fmt: skip
def test_an_ambiguous_image_layout_is_rejected(shape: tuple[int, ...]) -> None:
    with pytest.raises(MerlError, match=r"'image' .*--env.image-layout hwc .* or chw") as caught:
        adapt(SpaceEnv(image(*shape)))
    assert len(str(caught.value).splitlines()) == 1
    plain = SpaceEnv(image(*shape))
    before = plain.reset()[0]
    for layout, expected in (("hwc", before), ("chw", before.transpose(1, 2, 0))):
        env = adapt(plain, UserEnvConfig(image_layout=layout))  # type: ignore[arg-type]
        np.testing.assert_array_equal(env.reset()[0]["image"], expected)


@pytest.mark.parametrize("shape", [(20, 30, 3), (3, 20, 30)])
def test_an_image_in_another_layout_than_its_space_is_rejected(shape: tuple[int, ...]) -> None:
    used = user_key("camera", image(*shape), "auto")
    assert used is not None
    other = (3, 20, 30) if shape[-1] == 3 else (20, 30, 3)
    with pytest.raises(EnvironmentFailed, match=r"'camera' has shape .* but its space has"):
        used.convert(np.zeros(other, np.uint8))


def test_an_unknown_layout_is_rejected() -> None:
    with pytest.raises(MerlError, match=r"env.image-layout 'cwh' is unknown: did you mean"):
        UserEnvConfig(image_layout="cwh")  # type: ignore[arg-type]


def test_an_image_keeps_the_bounds_of_its_pixels() -> None:
    mask = adapt(SpaceEnv(spaces.Box(0, 1, (20, 30), np.uint8)))
    assert mask.observation_space["image"] == spaces.Box(0, 1, (20, 30, 1), np.uint8)  # type: ignore[index]
    used = user_key("mask", spaces.Box(0, 1, (20, 30), np.uint8), "auto")
    assert used is not None
    used.convert(np.ones((20, 30), np.uint8))
    with pytest.raises(EnvironmentFailed, match="pixels from 0 to 255, but its space has 0 to 1"):
        used.convert(np.eye(20, 30, dtype=np.uint8) * 255)
    used = user_key("bright", spaces.Box(100, 255, (20, 30), np.uint8), "auto")
    assert used is not None
    with pytest.raises(EnvironmentFailed, match="pixels from 7 to 7, but its space has 100"):
        used.convert(np.full((20, 30), 7, np.uint8))


def test_pixels_of_one_value_or_of_different_ranges_are_rejected() -> None:
    with pytest.raises(MerlError, match="'image' has pixels from 0 to 0"):
        adapt(SpaceEnv(spaces.Box(0, 0, (20, 30, 3), np.uint8)))
    high = np.full((20, 30, 4), 255, np.uint8)
    high[..., 3] = 1
    for bounds in (high, high.transpose(2, 0, 1)):
        with pytest.raises(MerlError, match=r"upper bounds \[1, 255\]: use a separate key"):
            adapt(SpaceEnv(spaces.Box(np.zeros_like(bounds), bounds, dtype=np.uint8)))


# -- vectors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "box",
    [
        spaces.Box(-1, 1, (), np.float32),
        spaces.Box(-1, 1, (1,), np.float32),
        spaces.Box(-1, 1, (5, 1), np.float64),
        spaces.Box(-1, 1, (1, 5), np.float32),
        spaces.Box(0, 9, (5, 1), np.int64),
        spaces.Box(0, 255, (5, 1), np.uint8),
        spaces.Box(-LARGEST64, LARGEST64, (3,), np.float64),
        spaces.Box(-np.inf, np.inf, (2,), np.float16),
    ],
    ids=brief,
)
def test_numbers_along_one_axis_are_a_vector(box: spaces.Box) -> None:
    size = int(np.prod(box.shape))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = adapt(SpaceEnv(box))
        assert env.observation_space["state"].shape == (size,)  # type: ignore[index]
        used = env.get_wrapper_attr("keys")["state"]
        vector = used.convert(np.arange(size, dtype=box.dtype).reshape(box.shape))
    assert vector.dtype == np.float32
    np.testing.assert_array_equal(vector, np.arange(size))


def test_a_number_beyond_float32_is_rejected() -> None:
    used = user_key("arm", vector(3, np.float64), "auto")
    assert used is not None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for value in (1e39, -1e300):
            with pytest.raises(EnvironmentFailed, match=r"'arm' is -?1e\+\d+ at index 1, .*beyond"):
                used.convert(np.array([0.0, value, np.nan]))
        assert np.isinf(used.convert(np.array([0.0, np.inf, 0.0]))[1])  # the run's guard reports it


# -- depth images and histories --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "kind", "shape"),
    [
        (spaces.Box(0, 65535, (64, 48), np.uint16), Depth, (64, 48, 1)),
        (spaces.Box(0.1, 9, (1, 64, 48), np.float64), Depth, (64, 48, 1)),
        (spaces.Box(-1, 1, (3, 20), np.float32), Sequence, (3, 20)),
        (spaces.Box(-1, 1, (4, 4), np.float64), Sequence, (4, 4)),
    ],
    ids=lambda value: brief(value) if isinstance(value, spaces.Space) else "",
)
def test_two_axes_are_a_depth_image_or_a_history(
    space: spaces.Box, kind: type[Modality], shape: tuple[int, ...]
) -> None:
    used = user_key("x", space, "auto")
    assert used is not None
    assert (type(used.modality), used.modality.shape) == (kind, shape)
    assert used.convert(space.sample()).shape == shape


@pytest.mark.parametrize(("dtype", "none"), [(np.uint16, 65535), (np.float32, np.inf)])
def test_depth_beyond_its_bounds_is_clipped(dtype: type, none: float) -> None:
    used = user_key("x", spaces.Box(100, 5000, (20, 30), dtype), "auto")
    assert used is not None
    seen = used.convert(np.array([[0, none] * 15] * 20, dtype))
    assert (seen.min(), seen.max()) == (100, 5000)


# -- advice ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "message", "excluded"),
    [
        (spaces.Discrete(5), "one-hot, a float32 box of 5", "nested"),
        (spaces.MultiDiscrete([3, 4]), "one-hot", "nested"),
        (spaces.MultiBinary(4), "box from 0 to 1", "nested"),
        (
            spaces.Dict({"b": vector(2)}),
            "nested: move each of its entries to the outer Dict",
            "uint8",
        ),
        (spaces.Tuple([vector(2)]), "in a spaces.Dict", "uint8"),
        (spaces.Text(5), "in numbers", "uint8"),
        (spaces.Box(0, 1, (64, 64, 3), np.float32), "(255 * x).astype(np.uint8)", "dtype=np"),
        (spaces.Box(0, 255, (64, 64, 3), np.float32), "use a box with dtype=np.uint8", "255 *"),
        (spaces.Box(0, 255, (64, 64), np.int32), "use a box with dtype=np.uint8", "255 *"),
        (spaces.Box(-1, 1, (64, 64, 3), np.float32), "(127.5 * (x + 1))", "255 * x"),
        (spaces.Box(0, 65535, (64, 64, 3), np.uint16), "largest relevant value", "(255 * x)"),
        (spaces.Box(0, np.inf, (64, 64, 1), np.float32), "the farthest one", "(255 * x)"),
        (spaces.Box(-9, 9, (64, 64), np.float32), "the nearest distance (at least 0)", "np.uint8"),
        (spaces.Box(-1, 1, (2, 3, 4), np.float32), "remove a wrapper that stacks", "uint8"),
        (spaces.Box(-1, 1, (2, 4, 4), np.float32), "flattened to a box (32,)", "uint8"),
        (spaces.Box(0, 255, (4, 84, 84, 3), np.uint8), "--replay.frame-stack", "255 *"),
        (spaces.Box(0, 1, (0,), np.float32), "no numbers", "uint8"),
    ],
    ids=lambda value: brief(value) if isinstance(value, spaces.Space) else "",
)
def test_the_advice_matches_the_space(space: Any, message: str, excluded: str) -> None:
    assert user_key("x", space, "auto") is None
    assert message in advice(space)
    assert excluded not in advice(space)
    assert len(brief(space)) <= 100
    for given in (space, spaces.Dict({"x": space})):
        if given is space and isinstance(space, spaces.Dict):
            continue
        with pytest.raises(MerlError, match="neither an image") as caught:
            adapt(SpaceEnv(given))
        assert advice(space) in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1


def test_a_flat_dict_is_not_reported_as_nested() -> None:
    flat = spaces.Dict({"gear": spaces.Discrete(3), "depth": spaces.Box(0, np.inf, (64, 64))})
    with pytest.raises(MerlError, match="neither an image") as caught:
        adapt(SpaceEnv(flat))
    assert "'gear' is Discrete(3)" in str(caught.value)
    assert "'depth' is a float32 box (64, 64) from 0 to inf" in str(caught.value)
    assert "nested" not in str(caught.value)


# -- actions --------------------------------------------------------------------------------------


def box(low: Any, high: Any, dtype: Any = np.float32, size: int = 2) -> spaces.Box:
    """A box whose bounds are set afterwards, so that Gymnasium does not check them."""
    made = spaces.Box(-1, 1, (size,), dtype)
    made.low, made.high = (np.full(size, bound) for bound in (low, high))
    return made


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (spaces.Box(-LARGEST32, LARGEST32, (2,), np.float32), "more than 1,000,000 apart"),
        (spaces.Box(-LARGEST64, LARGEST64, (2,), np.float64), "set finite bounds"),
        (spaces.Box(0, LARGEST64, (2,), np.float64), "more than 1,000,000 apart"),
        (spaces.Box(-1, 1e30, (2,), np.float32), "action 0 has the bounds -1 and 1e.30, more than"),
        (box(-1e300, 1e300), "set finite bounds"),  # infinite in the actions' float32
        (box(-np.inf, 1.0), "bounds -inf and 1: set finite"),
        (box(np.nan, 1.0), "bounds nan and 1: set finite"),
        (box(1.0, -1.0), "the lower bound is above the upper bound"),
        (box(1.0, 1.0), "there is nothing to learn"),
        (spaces.Box(-9, 9, (2,), np.int64), "real numbers"),
        (spaces.Box(-1, 1, (), np.float32), r"make it \(1,\)"),
        (spaces.Box(-1, 1, (2, 3), np.float32), r"make it \(6,\)"),
        (spaces.Box(-1, 1, (0,), np.float32), "a box of real numbers"),
        (spaces.MultiDiscrete([3, 3]), "real numbers"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_actions_that_cannot_be_rescaled_are_rejected(actions: Any, message: str) -> None:
    with pytest.raises(MerlError, match=message) as caught:
        adapt(SpaceEnv(vector(2), actions))
    assert len(str(caught.value).splitlines()) == 1
    assert ("--env.allow-wide-actions" in str(caught.value)) == message.endswith(("apart", "than"))


@pytest.mark.parametrize(
    "actions",
    [
        spaces.Box(-LARGEST32, LARGEST32, (2,), np.float32),
        spaces.Box(0, LARGEST64, (2,), np.float64),
        spaces.Box(-60000, 60000, (2,), np.float16),
    ],
    ids=brief,
)
@pytest.mark.filterwarnings("error")
def test_allowed_wide_actions_stay_finite(actions: spaces.Box) -> None:
    given = SpaceEnv(vector(2), actions)
    env = adapt(given, UserEnvConfig(allow_wide_actions=True))
    env.reset()
    for share in np.linspace(-1, 1, 21, dtype=np.float32):
        env.step(np.full(2, share))
        assert np.isfinite(given.received_action).all()
        assert actions.contains(given.received_action)


def test_a_range_of_a_million_and_a_fixed_joint_are_accepted() -> None:
    low, high = np.array([-5e5, 2.0]), np.array([5e5, 2.0])
    given = SpaceEnv(vector(2), spaces.Box(low, high, dtype=np.float64))
    env = adapt(given)
    env.reset()
    env.step(np.ones(2, np.float32))
    assert given.received_action.tolist() == [5e5, 2.0]


@pytest.mark.parametrize("action", [0.5, np.zeros(3), np.zeros((1, 2))])
def test_an_action_of_the_wrong_shape_does_not_reach_the_environment(action: Any) -> None:
    given = SpaceEnv(vector(2))
    env = adapt(given)
    env.reset()
    with pytest.raises(MerlError, match=r"action has shape .*: it must have \(2,\)"):
        env.step(action)
    assert not hasattr(given, "received_action")
