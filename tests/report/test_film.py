"""Film strips of a run's videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from merl.core import MerlError
from merl.report.film import FRAMES, LABEL, MARGIN, SIDE, film_strip
from runs_on_disk import write_video


def test_a_row_for_each_evaluation_from_start_to_end(tmp_path: Path) -> None:
    videos = {step: write_video(tmp_path / f"{step}.mp4") for step in (1000, 2000)}
    strip = np.asarray(Image.open(film_strip(videos, tmp_path / "strip.png")).convert("L"))
    assert strip.shape == (2 * (SIDE + MARGIN), LABEL + FRAMES * (SIDE + MARGIN))
    middle = LABEL + np.arange(FRAMES) * (SIDE + MARGIN) + SIDE // 2
    brightness = strip[SIDE // 2, middle].astype(int)
    assert (np.diff(brightness) > 5).all()  # the video becomes brighter
    assert brightness[0] == pytest.approx(20, abs=6)
    assert brightness[-1] == pytest.approx(20 + 15 * 11, abs=6)


def test_many_evaluations_are_thinned_and_the_last_is_kept(tmp_path: Path) -> None:
    videos = {step: write_video(tmp_path / f"{step}.mp4") for step in range(1000, 12_000, 1000)}
    height = Image.open(film_strip(videos, tmp_path / "strip.jpg")).height
    assert height == 5 * (SIDE + MARGIN)


def test_a_damaged_video_is_left_out(tmp_path: Path) -> None:
    good = write_video(tmp_path / "good.mp4")
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(good.read_bytes()[:300])
    strip = film_strip({1: bad, 2: good}, tmp_path / "strip.png")
    assert Image.open(strip).height == SIDE + MARGIN
    with pytest.raises(MerlError, match="no video can be read"):
        film_strip({1: bad}, tmp_path / "none.png")
