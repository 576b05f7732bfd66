"""How a critic's output stands for a return: as the number itself, or as a histogram of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


class Scalar(nn.Module):
    """The output is the value, learnt by the mean squared error.

    Attributes:
        outputs: numbers of a critic's output.
    """

    outputs = 1

    def value(self, output: Tensor) -> Tensor:
        """(B,) to (B,)."""
        return output

    def loss(self, first: Tensor, second: Tensor, y: Tensor) -> Tensor:
        """The sum of both critics' losses.

        Args:
            first: output of Q_1.
            second: output of Q_2.
            y: targets, (B,).
        """
        return (first - y).square().mean() + (second - y).square().mean()

    def start_at_zero(self, bias: Tensor) -> None:
        """Nothing: an output layer without bias starts there."""


class HLGauss(nn.Module):
    """The output is a histogram of the value, as logits (HL-Gauss; Farebrother et al. 2024).

    A target y becomes a Gaussian about y, integrated over each bin; the loss is the cross-entropy,
    the value is the mean of the bins' centers. Targets outside of [low, high] count as the nearer
    bound. Three bins lie beyond each bound, so that a target at a bound keeps its mean.

    Args:
        low: the lowest target.
        high: the highest.
        bins: how many, at least `FEWEST`.

    Attributes:
        outputs: the number of bins.
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
        """Logits (B, bins) to the mean of their histogram, (B,)."""
        # No matrix product: autocast would round the centers.
        centers = self.low + self.width * (self.index[:-1] + 0.5)
        return (torch.softmax(output, dim=-1) * centers).sum(-1)

    def histogram(self, y: Tensor) -> Tensor:
        """Targets (B,) to the shares of their Gaussians in the bins, (B, bins); a row sums to 1."""
        y = y.clamp(self.low, self.high)
        edges = self.low + self.width * self.index
        cdf = torch.erf((edges - y[:, None]) / (math.sqrt(2.0) * self.SIGMA * self.width))
        return cdf.diff(dim=-1) / (cdf[:, -1:] - cdf[:, :1])

    def loss(self, first: Tensor, second: Tensor, y: Tensor) -> Tensor:
        """The sum of both critics' cross-entropies; see `Scalar.loss`."""
        histogram = self.histogram(y)
        of_first, of_second = (functional.cross_entropy(q, histogram) for q in (first, second))
        return of_first + of_second

    @torch.no_grad()
    def start_at_zero(self, bias: Tensor) -> None:
        """Set the bias of an output layer such that the first values are near 0.

        Equal logits would mean the middle of the bounds, which bootstrapping takes thousands of
        updates to forget.
        """
        share = self.histogram(torch.zeros_like(bias[:1]))[0]
        bias.copy_((share + 1e-3 / self.outputs).log())


Returns = Scalar | HLGauss
