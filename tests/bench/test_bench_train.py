"""The bench of the training loop runs and shows its result; the speeds are not tested."""

from __future__ import annotations

import json

from rich.console import Console

from helpers import flat
from merl.bench import train


def test_every_variant_of_the_loop_is_timed() -> None:
    result = train.run(repeats=1, steps=6, preset="smoke")
    assert len(result["steps_per_s"]) == 3
    assert all(0 < rate["low"] <= rate["high"] for rate in result["steps_per_s"].values())
    assert result["ratio"][train.STRICT] == {"median": 1.0, "low": 1.0, "high": 1.0}
    json.dumps(result)
    console = Console(width=120, record=True)
    console.print(train.table(result))
    assert "beside the learner" in flat(console.export_text())
