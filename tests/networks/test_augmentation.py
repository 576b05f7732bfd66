"""Random shift against its definition and DrQ-v2's implementation; conversion to network input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from merl.networks.augmentation import (
    _shift_by_index,
    draw_shifts,
    shift,
)

SHAPES = [(1, 3, 84, 84, 3), (5, 2, 9, 12, 1), (3, 1, 4, 3, 3)]  # (B, K, H, W, C)


both_paths = pytest.mark.parametrize("path", [_shift_by_index, shift])


def random_images(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


def padded_crop(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """MERL 4.1, pixel by pixel: a position outside the image takes the nearest edge pixel."""
    height, width = images.shape[2:4]
    shifted = torch.empty_like(images)
    for b, (top, left) in enumerate(shifts.tolist()):
        for i in range(height):
            for j in range(width):
                row = min(max(i + top - pad, 0), height - 1)
                column = min(max(j + left - pad, 0), width - 1)
                shifted[b, :, i, j] = images[b, :, row, column]
    return shifted


def grid_sampled(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """DrQ-v2: replicate-pad, then sample bilinearly on a grid moved by whole pixels, in float32."""
    batch, stack, side, _, channels = images.shape
    flat = images.permute(0, 1, 4, 2, 3).reshape(batch, stack * channels, side, side).float()
    padded = functional.pad(flat, (pad, pad, pad, pad), mode="replicate")
    pixel = 2.0 / (side + 2 * pad)  # the padded image spans [-1, 1]
    centres = torch.linspace(-1 + pixel / 2, 1 - pixel / 2, side + 2 * pad)[:side]
    x = centres.expand(batch, side, side) + shifts[:, 1, None, None] * pixel
    y = centres[:, None].expand(batch, side, side) + shifts[:, 0, None, None] * pixel
    sampled = functional.grid_sample(padded, torch.stack([x, y], -1), align_corners=False)
    return sampled.reshape(batch, stack, channels, side, side).permute(0, 1, 3, 4, 2)


@both_paths
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("pad", [1, 4])
def test_shift_equals_padded_crop(path, shape: tuple[int, ...], pad: int) -> None:
    images = random_images(shape)
    shifts = draw_shifts(shape[0], pad, torch.Generator().manual_seed(1))
    shifted = path(images, shifts, pad)
    assert shifted.dtype == torch.uint8
    assert torch.equal(shifted, padded_crop(images, shifts, pad))


@both_paths
def test_shift_equals_grid_sample_of_drqv2(path) -> None:
    images = random_images((81, 3, 84, 84, 1))
    shifts = torch.cartesian_prod(torch.arange(9), torch.arange(9))  # all shifts
    difference = (path(images, shifts, 4).float() - grid_sampled(images, shifts, 4)).abs()
    assert difference.max() < 0.01  # of 255; rounding of the grid in float32


@both_paths
def test_largest_and_zero_shifts(path) -> None:
    image = torch.arange(30, dtype=torch.uint8).reshape(1, 1, 5, 6, 1)
    far = path(image, torch.tensor([[0, 0]]), 4)[0, 0, ..., 0]
    assert torch.equal(far[:4, :4], torch.zeros(4, 4, dtype=torch.uint8))
    assert far[4, 4:].tolist() == [0, 1]
    other = path(image, torch.tensor([[8, 8]]), 4)[0, 0, ..., 0]
    assert other[0, :3].tolist() == [28, 29, 29]
    assert (other[1:] == other[0]).all()
    assert torch.equal(path(image, torch.tensor([[4, 4]]), 4), image)
    down = path(image, torch.tensor([[5, 4]]), 4)[0, 0, ..., 0]  # rows come first
    assert down[0].tolist() == [6, 7, 8, 9, 10, 11]


@both_paths
def test_frames_of_a_stack_shift_together_and_samples_independently(path) -> None:
    images = random_images((2, 1, 12, 12, 3)).expand(2, 3, 12, 12, 3)
    shifted = path(images, torch.tensor([[1, 7], [6, 2]]), 4)
    assert torch.equal(shifted[:, 0], shifted[:, 1])
    assert torch.equal(shifted[:, 0], shifted[:, 2])
    assert torch.equal(shifted[0, 0, 3:-3, 0:-3], images[0, 0, 0:-6, 3:])
    assert torch.equal(shifted[1, 0, 0:-2, 2:], images[1, 0, 2:, 0:-2])


def test_shift_does_not_change_its_input() -> None:
    images = random_images((2, 3, 8, 8, 3))
    before = images.clone()
    shift(images, torch.tensor([[0, 0], [4, 4]]), 4).fill_(7)
    assert torch.equal(images, before)


@pytest.mark.parametrize("pad", [1, 4])
def test_shifts_are_uniform(pad: int) -> None:
    size, offsets = 90_000, 2 * pad + 1
    shifts = draw_shifts(size, pad, torch.Generator().manual_seed(0))
    assert shifts.dtype == torch.int64
    assert shifts.shape == (size, 2)
    cells = torch.bincount(shifts[:, 0] * offsets + shifts[:, 1], minlength=offsets**2)
    assert len(cells) == offsets**2
    expected = size / offsets**2
    chi_squared = float(((cells - expected) ** 2 / expected).sum())
    freedom = offsets**2 - 1
    assert chi_squared < freedom + 5 * np.sqrt(2 * freedom)


def test_generator_determines_shifts() -> None:
    first, again, other = (
        draw_shifts(50, 4, torch.Generator().manual_seed(seed)) for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
