"""In a notebook, training shows its progress, and the interrupt of the kernel saves the run."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import merl
from helpers import wait_for
from merl.report.curves import read_metrics

nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

CELLS = [
    """
import gymnasium, merl
from toy import DotEnv
small = dict(
    preset="smoke", random_steps=20, seed_steps=20, device="cpu", threads=1,
    **{"eval.every": 0, "agent.hidden_dim": 16, "replay.batch_size": 4, "agent.images": ()},
)
""",
    """
length = 10
def make():  # of the notebook: it cannot be imported
    env = DotEnv()
    env.length = length
    return env
outcome = merl.train(env=make, run_dir="run", steps=2_000_000, **small)
""",
    "print(outcome.signal, outcome.saved, outcome.progress.step == merl.load_policy('run').step)",
    """
outcome = merl.resume("run", env=make, steps=outcome.progress.step + 50)
print(outcome.signal, outcome.progress.step)
""",
]


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Start a kernel in a new folder."""
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    cells = [nbformat.v4.new_code_cell(source) for source in CELLS]
    notebook = nbformat.v4.new_notebook(cells=cells)
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(notebook, timeout=300, resources=resources)
    with client.setup_kernel():
        yield client


def run_cell(client: Any, index: int) -> str:
    """Execute a cell; return what it shows."""
    cell = client.execute_cell(client.nb.cells[index], index)
    texts = [out.get("text") or out["data"]["text/plain"] for out in cell.outputs]
    return "\n".join(texts)


def test_an_interrupt_saves_the_run_and_returns_its_outcome(client: Any, tmp_path: Path) -> None:
    run_cell(client, 0)

    def interrupt() -> None:
        metrics = tmp_path / "run/metrics.csv"
        wait_for(lambda: metrics.exists() and metrics.read_text().count("\n") > 20)
        asyncio.run(client.km.interrupt_kernel())

    thread = threading.Thread(target=interrupt)
    thread.start()
    shown = run_cell(client, 1)
    thread.join()
    assert " of 2,000,000" in shown
    assert "steps/s" in shown
    assert "\x1b" not in shown
    assert shown.count("progress") == 1  # replaced, not repeated
    assert run_cell(client, 2).split() == ["2", "True", "True"]
    step = merl.load_policy(tmp_path / "run").step
    shown = run_cell(client, 3)
    assert shown.startswith("100% ━")
    assert shown.splitlines()[-1] == f"None {step + 50}"
    assert read_metrics(tmp_path / "run")["step"][-1] > step
