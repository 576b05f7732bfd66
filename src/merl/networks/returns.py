"""Representation of a return by a critic's output: as the value itself, or as a histogram."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class Scalar(nn.Module):
    """Return as a scalar: the output is the value, trained with the mean squared error.

    Attributes:
        outputs: size of a critic's output.
    """

    outputs = 1

    def value(self, output: Tensor) -> Tensor:
        """Return the output (B,) unchanged."""
        return output

    def loss(self, output: Tensor, y: Tensor) -> Tensor:
        """Return the loss of one head, a scalar.

        Args:
            output: the head's output.
            y: targets, (B,).
        """
        return (output - y).square().mean()

    def start_at_zero(self, bias: Tensor) -> None:
        """Do nothing: with zero bias, the initial values are near 0 already."""


class HLGauss(nn.Module):
    """Return as a histogram, with logits as output (HL-Gauss; Farebrother et al. 2024).

    A target y becomes a Gaussian with mean y, integrated over each bin. The loss is the
    cross-entropy; the value is the mean of the bin centers. Targets outside of [low, high] are
    clipped. Three bins lie beyond each bound, so that a target at a bound keeps its mean.

    Args:
        low: lowest target.
        high: highest target.
        bins: number of bins, at least `FEWEST`.

    Attributes:
        outputs: size of a critic's output: the number of bins.
    """

    SIGMA = 0.75
    """Standard deviation of the Gaussian, in bins."""
    MARGIN = 3
    """Bins beyond each bound: four standard deviations."""
    FEWEST = 2 * MARGIN + 1
    index: Tensor

    def __init__(self, low: float, high: float, bins: int) -> None:
        super().__init__()
        self.low, self.high, self.outputs = low, high, bins
        self.width = (high - low) / (bins - 2 * self.MARGIN)
        index = torch.arange(bins + 1.0) - self.MARGIN
        self.register_buffer("index", index, persistent=False)

    def value(self, output: Tensor) -> Tensor:
        """Compute the mean of the histogram, (B,), from logits (B, bins)."""
        # Not as a matrix product: autocast would round the centers.
        centers = self.low + self.width * (self.index[:-1] + 0.5)
        return (torch.softmax(output, dim=-1) * centers).sum(-1)

    def histogram(self, y: Tensor) -> Tensor:
        """Return the probability of each bin, (B, bins), for targets (B,); each row sums to 1."""
        y = y.clamp(self.low, self.high)
        edges = self.low + self.width * self.index
        cdf = torch.erf((edges - y[:, None]) / (math.sqrt(2.0) * self.SIGMA * self.width))
        return cdf.diff(dim=-1) / (cdf[:, -1:] - cdf[:, :1])

    def loss(self, output: Tensor, y: Tensor) -> Tensor:
        """Return the cross-entropy of one head, a scalar; see `Scalar.loss`."""
        return functional.cross_entropy(output, self.histogram(y))

    @torch.no_grad()
    def start_at_zero(self, bias: Tensor) -> None:
        """Set the bias of an output layer so that the initial values are near 0.

        Equal logits would give the middle of the bounds, and bootstrapping would need thousands of
        updates to correct that.
        """
        share = self.histogram(torch.zeros_like(bias[:1]))[0]
        bias.copy_((share + 1e-3 / self.outputs).log())


Returns = Scalar | HLGauss
