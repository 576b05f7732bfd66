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
    if images.device.type != "cpu":
        return _shift_by_index(images, shifts, pad)
    shifted = torch.empty_like(images, memory_format=torch.contiguous_format)
    crop = RandomShift(shifts, pad)
    for sample, (frames, out) in enumerate(zip(images.numpy(), shifted.numpy(), strict=True)):
        crop(sample, frames, out)
    return shifted


class RandomShift:
    """`shift` sample by sample, for who copies the frames anyway: see `core.FrameTransform`.

    Args:
        shifts: int64 (B, 2), from `draw_shifts`.
        pad: pixels by which each side is padded.
    """

    def __init__(self, shifts: Tensor, pad: int) -> None:
        self._moves = (shifts - pad).tolist()

    def __call__(self, sample: int, frames: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
        """Write frames (K, H, W, C) to `out`, cropped as the sample is to be."""
        height, width, channels = frames.shape[1:]
        down, right = self._moves[sample]
        # What comes to (y, x) was at (y + down, x + right); further than the last edge is as far.
        down = min(max(down, 1 - height), height - 1)
        right = min(max(right, 1 - width), width - 1)
        # All bytes move alike, in one piece; what comes across an edge is overwritten.
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


def to_input(images: Tensor, dtype: torch.dtype, middle: int = 128) -> Tensor:
    """Stacked bytes (B, K, H, W, C) to what a convolution reads: (B, K C, H, W), x - middle.

    These whole numbers are exact in bf16, which x / 255 - 0.5 is not; the scale is left to the
    weights (`encoders.ConvEncoder`). The memory is in channels-last order, which convolutions are
    fastest with.

    Args:
        images: uint8.
        dtype: of the result.
        middle: what is subtracted.
    """
    pixels = _centred(images).view(torch.int8).flatten(3).to(dtype)
    if middle != 128:
        pixels = pixels + (128 - middle)
    return pixels.permute(0, 3, 1, 2)


def _centred(images: Tensor) -> Tensor:
    """(B, K, H, W, C) to (B, H, W, K, C), a pixel's channels side by side, each byte less 128."""
    if images.device.type != "cpu":
        return _centred_at_once(images)
    batch, stack, height, width, channels = images.shape
    interleaved = images.new_empty((batch, height, width, stack, channels))
    # A copy per channel runs along whole images; one permuted copy would run along three bytes.
    for frame in range(stack):
        for channel in range(channels):
            interleaved[..., frame, channel] = images[:, frame, ..., channel]
    return interleaved.bitwise_xor_(128)


def _centred_at_once(images: Tensor) -> Tensor:
    """Where a launch costs more than what it moves; the shift leaves them in this order already."""
    return images.permute(0, 2, 3, 1, 4).contiguous().bitwise_xor(128)
