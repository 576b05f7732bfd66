"""Random shift (MERL 4.1, DrQ-v2)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def draw_shifts(batch_size: int, pad: int, generator: torch.Generator) -> Tensor:
    """Draw each crop's offset in the padded image: int64 (B, 2), row and column in [0, 2 pad]."""
    return torch.randint(
        0, 2 * pad + 1, (batch_size, 2), generator=generator, device=generator.device
    )


def shift(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """Pad each image with its edge pixels and crop it; all frames of a stack share one offset.

    DrQ-v2 uses a bilinear `grid_sample`, but its grid lands on pixel centres, so its result is an
    integer crop. This function makes that crop directly on the bytes.

    Args:
        images: uint8 (B, K, H, W, C).
        shifts: int64 (B, 2), from `draw_shifts`; (pad, pad) leaves the image unchanged.
        pad: padding of each side, in pixels.

    Returns:
        The shifted stacks, in the shape of `images`.
    """
    if images.device.type != "cpu":
        return _shift_by_index(images, shifts, pad)
    shifted = torch.empty_like(images, memory_format=torch.contiguous_format)
    crop = RandomShift(shifts, pad)
    for sample, (frames, out) in enumerate(zip(images.numpy(), shifted.numpy(), strict=True)):
        crop(sample, frames, out)
    return shifted


class RandomShift:
    """Random shift of one sample at a time, applied while frames are copied.

    It is a `core.FrameTransform`; for the same shifts its result equals that of `shift`.

    Args:
        shifts: int64 (B, 2), from `draw_shifts`.
        pad: padding of each side, in pixels.
    """

    def __init__(self, shifts: Tensor, pad: int) -> None:
        self._moves = (shifts - pad).tolist()

    def __call__(self, sample: int, frames: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
        """Write frames (K, H, W, C) to `out`, cropped with the offset of this sample."""
        height, width, channels = frames.shape[1:]
        down, right = self._moves[sample]
        # out[y, x] = frames[y + down, x + right]; beyond the image, the nearest edge pixel.
        down = min(max(down, 1 - height), height - 1)
        right = min(max(right, 1 - width), width - 1)
        # Move all bytes as one block; the code below overwrites bytes that wrapped across an edge.
        ahead = (down * width + right) * channels
        source, target = frames.reshape(-1), out.reshape(-1)
        if ahead >= 0:
            target[: len(target) - ahead] = source[ahead:]
        else:
            target[-ahead:] = source[:ahead]
        if right > 0:
            out[:, :, width - right :] = out[:, :, width - right - 1, None]
        elif right < 0:
            out[:, :, :-right] = out[:, :, -right, None]
        if down > 0:
            out[:, height - down :] = out[:, height - down - 1, None]
        elif down < 0:
            out[:, :-down] = out[:, -down, None]


def _shift_by_index(images: Tensor, shifts: Tensor, pad: int) -> Tensor:
    """Shift with one gather, for devices where a kernel launch per sample is too slow."""
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
