"""Performance profiles: the share of runs that score above a threshold (Agarwal et al. 2021)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from merl.report.aggregates import Array, performance_profile, profile_band
from merl.report.drawing import (
    DASHES,
    MUTED,
    PALETTE,
    Label,
    direct_labels,
    new_figure,
    save,
    style,
    value_axis,
)


def draw_profiles(scores: Mapping[str, Array], output: Path) -> Path:
    """Draw the performance profile of each variant with its 95 % bootstrap band.

    Args:
        scores: {variant: (seeds, tasks)}.
        output: the figure's file; its suffix sets the format.

    Returns:
        `output`.

    Raises:
        MerlError: the figure cannot be written.
    """
    figure = new_figure(height=3.6)
    axes = figure.subplots()
    style(axes, "share of runs")
    highest = max(float(each.max()) for each in scores.values())
    thresholds = np.linspace(0.0, max(1.0, highest) * 1.02, 201)
    labels = []
    for i, (label, each) in enumerate(scores.items()):
        color, dash = PALETTE[i % len(PALETTE)], DASHES[i // len(PALETTE) % len(DASHES)]
        low, high = profile_band(each, thresholds)
        shares = performance_profile(each, thresholds)
        axes.fill_between(thresholds, low, high, color=color, alpha=0.14, lw=0, step="post")
        axes.step(thresholds, shares, color=color, linestyle=dash, lw=2, where="post")
        labels.append(Label(label, float(shares[np.searchsorted(thresholds, 0.5)]), color, "bold"))
    axes.set_xlim(0, float(thresholds[-1]))
    axes.set_xlabel("score", color=MUTED)
    value_axis(axes, [], True)
    direct_labels(figure, {axes: labels})
    return save(figure, output)
