"""The bench of the environment runs and shows its result; the speeds are not tested."""

import json

from rich.console import Console

from helpers import flat
from merl.bench import env as bench
from merl.core import MerlError


def text_of(result):
    console = Console(width=200, markup=False)
    with console.capture() as capture:
        console.print(bench.table(result))
    return flat(capture.get())


def test_every_variant_is_timed():
    result = bench.run(repeats=2, steps=6, image_size=32)
    assert json.loads(json.dumps(result)) == result
    shown = text_of(result)
    sides = [bench.OURS, bench.BARE, bench.BLIND] + ([] if "skipped" in result else [bench.THEIRS])
    for side in sides:
        rate = result["steps_per_s"][side]
        assert 0 < rate["low"] <= rate["median"] <= rate["high"]
        assert side in shown
    assert result["overhead"]["median"] > -1


def test_dm_control_is_skipped_without_opengl(monkeypatch):
    def missing():
        raise MerlError("no OpenGL here")

    monkeypatch.setattr(bench, "enable_opengl", missing)
    result = bench.run(repeats=1, steps=2, image_size=16)
    assert "ratio" not in result
    assert bench.THEIRS not in result["steps_per_s"]
    assert "no OpenGL here" in text_of(result)
