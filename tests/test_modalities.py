"""Modalities: recognition, storage, and the inputs of encoders."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import Tensor

from merl.modalities import Depth, Image, Sequence, Vector, modalities_of, modality_of

SHAPES = [(2, 3, 8, 9, 3), (1, 1, 5, 4, 1), (3, 2, 6, 6, 4)]


def image_of(shape: tuple[int, ...]) -> Image:
    return Image(spaces.Box(0, 255, shape[2:], np.uint8))


def random_images(shape: tuple[int, ...]) -> Tensor:
    return torch.randint(0, 256, shape, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("space", "kind"),
    [
        (spaces.Box(0, 255, (8, 9, 3), np.uint8), Image),
        (spaces.Box(0, 2, (8, 9, 1), np.float32), Depth),
        (spaces.Box(0, 9000, (8, 9, 1), np.uint16), Depth),
        (spaces.Box(-np.inf, np.inf, (7,), np.float32), Vector),
        (spaces.Box(-np.inf, np.inf, (7, 3), np.float32), Sequence),
        (spaces.Box(0, np.inf, (8, 9, 1), np.float32), None),
        (spaces.Box(0, 2, (8, 9, 3), np.float32), None),
        (spaces.Box(0, 2, (0,), np.float32), None),
        (spaces.Discrete(3), None),
    ],
)
def test_kind_of_a_space(space: spaces.Space, kind: type | None) -> None:
    assert type(modality_of(space)) is (kind or type(None))


def test_modalities_are_ordered_by_kind() -> None:
    space = spaces.Dict(
        {
            "a": spaces.Box(-1, 1, (5, 2), np.float32),
            "b": spaces.Box(-1, 1, (5,), np.float32),
            "c": spaces.Box(0, 1, (5, 5, 1), np.float32),
            "d": spaces.Box(0, 255, (5, 5, 1), np.uint8),
            "e": spaces.Discrete(2),
        }
    )
    assert list(modalities_of(space)) == ["d", "c", "b", "a"]


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0.3, 2.5, (6, 7, 1), np.float32),
        spaces.Box(0, 65535, (6, 7, 1), np.uint16),
        spaces.Box(100, 9000, (6, 7, 1), np.uint16),
    ],
)
def test_depth_is_stored_in_two_bytes_without_noticeable_loss(space: spaces.Box) -> None:
    depth = Depth(space)
    space.seed(0)
    value = space.sample()
    low, high = float(space.low.min()), float(space.high.max())
    value[0, 0], value[0, 1] = low, high
    stored = depth.to_stored(value)
    assert (stored.dtype, stored.shape) == (np.int16, value.shape)
    assert (stored[0, 0], stored[0, 1]) == (-(2**15), 2**15 - 1)
    back = (stored.astype(np.float64) + 2**15) / (2**16 - 1) * (high - low) + low
    assert np.abs(back - value).max() <= 0.51 / (2**16 - 1) * (high - low) + 1e-7
    if high - low == 65535:
        assert np.array_equal(np.rint(back), value)


def test_depth_beyond_its_bounds_is_clipped() -> None:
    depth = Depth(spaces.Box(0.5, 2.0, (1, 3, 1), np.float32))
    stored = depth.to_stored(np.array([[[0.0], [np.inf], [1.25]]], np.float32))
    assert stored[..., 0].tolist() == [[-(2**15), 2**15 - 1, 0]]


def test_depth_as_input_lies_within_half_a_unit() -> None:
    depth = Depth(spaces.Box(0.0, 2.0, (1, 3, 1), np.float32))
    distances = np.array([[[0.0], [2.0], [0.5]]], np.float32)
    stack = torch.from_numpy(depth.to_stored(distances))[None, None]
    torch.testing.assert_close(
        depth.to_input(stack), torch.tensor([[[[-0.5, 0.5, -0.25]]]]), atol=2e-5, rtol=0
    )


@pytest.mark.parametrize("bounds", [(0, 255), (0, 1), (3, 200)])
def test_image_as_input_is_scaled_by_its_bounds(bounds: tuple[int, int]) -> None:
    low, high = bounds
    image = Image(spaces.Box(low, high, (4, 5, 2), np.uint8))
    stacks = torch.randint(low, high + 1, (2, 3, 4, 5, 2), dtype=torch.uint8)
    x = image.to_input(stacks)
    expected = (stacks.double() - low) / (high - low) - 0.5
    expected = expected.permute(0, 1, 4, 2, 3).reshape(2, 6, 4, 5)
    torch.testing.assert_close(x.double(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_input_has_centred_pixels_in_channel_order(
    shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    images = random_images(shape)
    batch, stack, height, width, channels = shape
    x = image_of(shape).centred(images, dtype)
    assert x.dtype == dtype
    assert x.shape == (batch, stack * channels, height, width)
    for frame in range(stack):  # the oldest first, its channels together
        for channel in range(channels):
            expected = images[:, frame, :, :, channel].to(torch.float64) - 128
            assert torch.equal(x[:, frame * channels + channel].to(torch.float64), expected)


def test_input_is_exact_for_every_byte() -> None:
    images = torch.arange(256, dtype=torch.uint8).reshape(256, 1, 1, 1, 1)
    x = image_of(images.shape).centred(images, torch.bfloat16)
    assert torch.equal(x.flatten().long(), torch.arange(256) - 128)
    assert torch.equal(images.flatten().long(), torch.arange(256))  # unchanged


def test_input_is_channels_last() -> None:
    shape = SHAPES[0]
    x = image_of(shape).centred(random_images(shape), torch.float32)
    assert x.is_contiguous(memory_format=torch.channels_last)
