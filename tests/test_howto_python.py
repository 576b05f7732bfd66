"""The examples of docs/howto/python.md and docs/howto/logging.md run, in a small form."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import merl
from merl import api
from merl.report.curves import read_metrics

HOWTO = Path(__file__).parents[1] / "docs/howto"
TEXT = "".join((HOWTO / page).read_text(encoding="utf-8") for page in ("python.md", "logging.md"))
SNIPPETS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
SMALL: dict[str, Any] = {
    "steps": 40,
    "device": "cpu",
    "threads": 1,
    "random_steps": 20,
    "seed_steps": 20,
    "updates_per_step": 0.2,
    "eval.every": 20,
    "eval.episodes": 1,
    "eval.max_episode_steps": 20,
    "eval.video": "none",
    "agent.hidden_dim": 16,
    "replay.batch_size": 4,
}


def small_train(task: Any = None, **given: Any) -> Any:
    """Train with the example's arguments, but few steps, and on the dot in place of the arm."""
    task = "merl.envs.dot:split" if task == "reach_duplo" else task
    return api.train(task, preset="smoke", progress=False, **{**given, **SMALL})


def small_resume(run: str, steps: int | None = None, **given: Any) -> Any:
    return api.resume(run, progress=False, steps=steps and 60, **given)


def test_the_examples_run_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tensorboard")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(merl, "train", small_train)
    monkeypatch.setattr(merl, "resume", small_resume)
    monkeypatch.setattr(merl, "evaluate", partial(api.evaluate, max_episode_steps=20))
    names: dict[str, Any] = {}
    for snippet in SNIPPETS:
        exec(compile(snippet, str(HOWTO), "exec"), names)
    assert len(SNIPPETS) >= 9
    runs = {path.name for path in (tmp_path / "runs").iterdir()}
    assert runs == set(re.findall(r'run_dir="runs/(\w+)"', TEXT))
    assert merl.load_policy("runs/mine").step == 60
    assert list(tmp_path.glob("best-*.mp4"))
    assert list((tmp_path / "runs/logged/tensorboard").iterdir())
    rows = (tmp_path / "runs/json/metrics.jsonl").read_text().splitlines()
    assert len(rows) >= len(read_metrics("runs/json")["step"])


def test_the_page_lists_every_event_and_function() -> None:
    for event in (name for name in vars(merl.Callback) if name.startswith("on_")):
        assert f"`{event}(" in TEXT
    for function in ("train", "resume", "evaluate", "load_policy", "make_env"):
        assert f"`merl.{function}(" in TEXT
