"""The bench runs and says what it measured; the figures themselves are not tested."""

import json

import pytest
from rich.console import Console

from helpers import flat
from merl.bench import replay as bench
from merl.core import MerlError


def test_both_sides_are_timed():
    result = bench.run(repeats=1, steps=500, batch_size=4)
    assert json.loads(json.dumps(result)) == result
    console = Console(width=300, markup=False)
    with console.capture() as capture:
        console.print(bench.table(result))
    shown = flat(capture.get())
    for side in (bench.RAW, bench.COMPRESSED):
        assert side in shown
        assert result["sample_ms"][side]["median"] > 0
        assert result["ready_ms"][side]["median"] > 0
        assert result["gigabytes"][side] <= bench.BARS_GB[side]
    assert result["picture_bytes"][bench.COMPRESSED] < result["picture_bytes"][bench.RAW] / 4


def test_where_temporary_files_have_no_room_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "free_disk", lambda _: 200_000_000)
    with pytest.raises(MerlError, match=r"takes 0\.27 GB .* name a larger folder in TMPDIR"):
        bench.run(repeats=1)
