"""Put the policy of a run into the package: python benchmarks/make_pretrained.py RUN NAME.

Writes src/merl/pretrained/NAME, a run folder that holds a config and one checkpoint with the
agent's networks in bf16, evaluates it over 200 episodes, and writes card.md. `merl evaluate
pretrained/NAME` then works in every installation.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import uuid
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

import merl
from merl.core.statistics import Interval
from merl.demos.demonstrations import Demonstrations
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.runs.run_folder import PRETRAINED

EPISODES = 200
LARGEST = 3_000_000
"""Maximum size of a policy, bytes."""


def write_policy(run: Run, checkpoint: Checkpoint, folder: Path) -> None:
    """Write the parts of a run that `load_policy` reads."""
    record = json.loads((run.path / "config.json").read_text())
    record["config"]["run_dir"] = None
    record["config"]["demos"] = None  # a path of its machine; the digest stays
    record["id"] = uuid.uuid4().hex  # the run's own id is a secret of its machine
    record.pop("resumed", None)
    at = folder / "checkpoints" / checkpoint.path.name
    at.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(record, indent=1))
    weights = load_file(checkpoint.path / "weights.safetensors")
    small = {
        name: tensor.to(torch.bfloat16) if tensor.is_floating_point() else tensor
        for name, tensor in weights.items()
        if name.startswith("networks.")
    }
    save_file(small, at / "weights.safetensors")
    torch.save({}, at / "learner.pt")
    progress = {"reports_success": checkpoint.state()["progress"]["reports_success"]}
    (at / "state.json").write_text(json.dumps({"progress": progress}))
    files = {path.name: fingerprint(path) for path in sorted(at.iterdir()) if path.suffix != ""}
    files.pop("manifest.json", None)
    manifest = {"format": 1, "step": checkpoint.step, "score": checkpoint.score, "files": files}
    (at / "manifest.json").write_text(json.dumps(manifest, indent=1))
    size = sum(path.stat().st_size for path in at.iterdir())
    if size > LARGEST:
        raise SystemExit(f"{folder} has {size:,} bytes: at most {LARGEST:,} are allowed")


def fingerprint(path: Path) -> dict[str, object]:
    """Return size and hash of a file, as a checkpoint's manifest has them."""
    content = path.read_bytes()
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def write_card(run: Run, step: int, name: str, commit: str | None) -> None:
    """Evaluate the policy and write its card."""
    record = json.loads((run.path / "config.json").read_text())
    demos = run.config.demos
    shown_by = "none" if demos is None else told(Demonstrations.open(demos))
    result = merl.load_policy(f"pretrained/{name}").evaluate(episodes=EPISODES)
    success = result.success_end
    with (run.path / "metrics.csv").open() as file:
        hours = float(list(csv.DictReader(file))[-1]["time/seconds"]) / 3600
    config, machine = run.config, record["machine"]
    where = f"{machine['cores']} cores, {machine['processor']}"
    (PRETRAINED / name / "card.md").write_text(
        f"""# pretrained/{name}

| | |
|---|---|
| task | `{config.task}` |
| agent, preset, seed | {config.agent_name}, {record["preset"]}, {config.seed} |
| observations | {", ".join(record["observation_space"])} |
| demonstrations | {shown_by} |
| trained for | {step:,} steps, {hours:.1f} hours on {where} |
| commit | {commit or record["commit"]} |
| return, {EPISODES} episodes | {shown(result.returns, ".0f")} |
| success at the end | {"not reported" if success is None else shown(success, ".0%")} |

The intervals are 95 % over episodes: `merl evaluate pretrained/{name} --episodes {EPISODES}`. The
weights are stored in bf16. The policy can be evaluated and deployed; it cannot be trained further.
"""
    )


def told(demos: Demonstrations) -> str:
    """Return the number of demonstrations and who acted, as text."""
    return f"{len(demos.lines)} episodes by {demos.source}"


def shown(interval: Interval, form: str) -> str:
    """Return an interval as text."""
    return f"{interval.mean:{form}} [{interval.low:{form}}, {interval.high:{form}}]"


def main() -> None:
    """Write the folder and the card."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--checkpoint", default="latest")
    parser.add_argument("--commit", help="if the run was not trained from a Git checkout")
    options = parser.parse_args()
    run = Run.open(options.run)
    checkpoint = Checkpoint.find(run.checkpoints, options.checkpoint)
    write_policy(run, checkpoint, PRETRAINED / options.name)
    write_card(run, checkpoint.step, options.name, options.commit)


if __name__ == "__main__":
    main()
