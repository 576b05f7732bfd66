"""`merl info` and `merl bench` on the command line."""

from __future__ import annotations

import json
import re
from itertools import takewhile
from pathlib import Path

import pytest

import merl
from helpers import flat
from merl.cli import main
from merl.cli.info import _rows


def test_info_shows_versions_processor_memory_and_renderers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("merl.cli.info.FRAMES", 2)
    shown = dict(takewhile(lambda row: not row[0].startswith("preset"), _rows()))
    assert shown["merl"] == merl.__version__
    assert shown["mujoco"] == "3.17.0"
    assert "cores" in shown["processor"]
    assert float(shown["memory"].split()[0]) > 0.1
    speed = shown["renderer raster"]
    assert speed.endswith("frames/s at 84x84")
    assert float(speed.split()[0]) > 0
    assert shown["renderer gl"]


@pytest.mark.long
def test_info_shows_the_expected_speed_of_each_preset(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    shown = flat(capsys.readouterr().out)
    assert "preset laptop" in shown
    assert "steps/s and" in shown
    assert re.search(r"preset laptop about [\d,.]+ steps/s and [\d,.]+ updates/s", shown)


def test_bench_env_prints_and_writes_its_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "bench.json"
    assert main(["bench", "env", "--repeats", "1", "--json", str(output)]) == 0
    shown = flat(capsys.readouterr().out)
    result = json.loads(output.read_text())
    assert "steps/s" in shown
    assert result["steps_per_s"]["merl, raster"]["median"] > 0
    assert ("ratio" in result) != ("skipped" in result)


def test_bench_refuses_zero_repeats_and_prints_its_usage(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["bench", "env", "--repeats", "0"]) == 2
    assert "--repeats must be at least 1" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main(["bench", "--help"])
    assert "usage: merl bench [-h] update|env|replay|train" in capsys.readouterr().out
