"""`merl info` and `merl bench`: what the machine offers, as the command line tells it."""

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


def test_info_tells_versions_processor_memory_and_renderers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("merl.bench.renderers.FRAMES", 2)
    told = dict(takewhile(lambda row: not row[0].startswith("preset"), _rows()))
    assert told["merl"] == merl.__version__
    assert told["mujoco"] == "3.17.0"
    assert "cores" in told["processor"]
    assert float(told["memory"].split()[0]) > 0.1
    speed = told["renderer raster"]
    assert speed.endswith("frames/s at 84x84")
    assert float(speed.split()[0]) > 0
    assert told["renderer gl"]


@pytest.mark.long
def test_info_tells_what_each_preset_would_take(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info"]) == 0
    shown = flat(capsys.readouterr().out)
    assert "preset laptop" in shown
    assert "steps/s and" in shown
    assert re.search(r"preset laptop about [\d,.]+ steps/s and [\d,.]+ updates/s", shown)


def test_bench_env_writes_what_it_shows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "bench.json"
    assert main(["bench", "env", "--repeats", "1", "--json", str(output)]) == 0
    shown = flat(capsys.readouterr().out)
    result = json.loads(output.read_text())
    assert "steps/s" in shown
    assert result["steps_per_s"]["merl, raster"]["median"] > 0
    assert ("ratio" in result) != ("skipped" in result)


def test_bench_refuses_what_cannot_be(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "env", "--repeats", "0"]) == 2
    assert "--repeats must be at least 1" in capsys.readouterr().err
    assert main(["bench"]) == 0
    assert "usage: merl bench {update,env,replay,train}" in capsys.readouterr().out
