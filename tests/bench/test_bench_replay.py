"""The bench of the replay runs and shows its result; the times are not tested."""

import json

import pytest
from rich.console import Console

from helpers import flat
from merl.bench import replay as bench
from merl.core import MerlError


def test_raw_and_compressed_replay_are_timed():
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
    assert result["image_bytes"][bench.COMPRESSED] < result["image_bytes"][bench.RAW] / 4


def test_too_little_disk_space_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "free_disk", lambda _: 200_000_000)
    with pytest.raises(MerlError, match=r"takes 0\.27 GB .* set TMPDIR to a larger folder"):
        bench.run(repeats=1)
