"""Random shift (MERL 4.1, DrQ-v2), and how stacked frames become the network's input."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def draw_shifts(batch_size: int, pad: int, generator: torch.Generator) -> Tensor:
    """Where each crop begins in the padded image: int64 (B, 2), rows and columns in [0, 2 pad]."""
    return torch.randint(
        0, 2 * pad + 1, (batch_size, 2), generator=generator, device=generator.device
    )


def shift(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """Crop each sample from its edge-padded self, all frames of its stack by the same offset.

    DrQ-v2 writes it as a bilinear `grid_sample`, but its grid lands on pixel centres: the result
    is an integer crop, so it is made here on the bytes.

    Args:
        images: uint8 (B, K, H, W, C).
        shifts: int64 (B, 2), from `draw_shifts`; (pad, pad) leaves the image as it is.
        pad: pixels by which each side is padded.

    Returns:
        The shifted stacks, in the shape of `images`.
    """
    if images.device.type == "cpu":
        return torch.from_numpy(_shift_by_slices(images.numpy(), shifts.numpy(), pad))
    return _shift_by_index(images, shifts, pad)


def _shift_by_slices(
    images: NDArray[np.uint8], shifts: NDArray[np.int64], pad: int
) -> NDArray[np.uint8]:
    """A slice per sample, and the edges from beside it: rows are copied whole, and once."""
    height, width = images.shape[2:4]
    shifted = np.empty_like(images)
    for image, moved, (row, column) in zip(images, shifted, shifts.tolist(), strict=True):
        # What comes to (y, x) was at (y + down, x + right); further than the last edge is as far.
        down = min(max(row - pad, 1 - height), height - 1)
        right = min(max(column - pad, 1 - width), width - 1)
        top, bottom = max(-down, 0), height - max(down, 0)
        left, side = max(-right, 0), width - max(right, 0)
        moved[:, top:bottom, left:side] = image[
            :, top + down : bottom + down, left + right : side + right
        ]
        if right:
            edge = left if right < 0 else side - 1
            beyond = slice(left) if right < 0 else slice(side, None)
            moved[:, top:bottom, beyond] = moved[:, top:bottom, edge : edge + 1]
        if down:
            edge = top if down < 0 else bottom - 1
            beyond = slice(top) if down < 0 else slice(bottom, None)
            moved[:, beyond] = moved[:, edge : edge + 1]
    return shifted


def _shift_by_index(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """One gather, for devices where a launch per sample would cost more than it moves."""
    batch, _, height, width, _ = images.shape
    rows = torch.arange(height, device=images.device) + shifts[:, :1] - pad  # (B, H)
    columns = torch.arange(width, device=images.device) + shifts[:, 1:] - pad  # (B, W)
    gathered = images[
        torch.arange(batch, device=images.device)[:, None, None],
        :,
        rows.clamp(0, height - 1)[:, :, None],
        columns.clamp(0, width - 1)[:, None, :],
    ]  # (B, H, W, K, C)
    return gathered.permute(0, 3, 1, 2, 4)


def to_input(images: Tensor, dtype: torch.dtype) -> Tensor:
    """Stacked bytes (B, K, H, W, C) to what a convolution reads: (B, K C, H, W), x - 128.

    These whole numbers are exact in bf16, which x / 255 - 0.5 is not; the scale is left to the
    weights (`encoders.ConvEncoder`). The memory is in channels-last order, which convolutions are
    fastest with.
    """
    batch, stack, height, width, channels = images.shape
    interleaved = images.new_empty((batch, height, width, stack, channels))
    # A copy per channel runs along whole images; one permuted copy would run along three bytes.
    for frame in range(stack):
        for channel in range(channels):
            interleaved[..., frame, channel] = images[:, frame, ..., channel]
    centred = interleaved.bitwise_xor_(128).view(torch.int8)  # of a byte: less 128
    return centred.flatten(3).to(dtype).permute(0, 3, 1, 2)
