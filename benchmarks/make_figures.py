"""Draw the figures of README and docs from results/.

python benchmarks/make_figures.py
"""

import csv
import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from merl.core.statistics import bootstrap_interval, wilson_interval
from merl.report.curves import Curve, curve_of, read_metrics
from merl.report.drawing import (
    INK,
    LABEL_SIZE,
    PALETTE,
    Label,
    direct_labels,
    new_figure,
    number,
    save,
    step_axis,
    style,
    value_axis,
)
from merl.report.figures import learning_curves
from merl.report.references import references
from small_tasks import SPLIT, optimum, returns_of

ROOT = Path(__file__).resolve().parent.parent
DATA, IMAGES = ROOT / "results", ROOT / "docs/images"
AGENTS = DATA / "agents"
MOST = {"state": 100_000, "laptop": 100_000}
"""Steps up to which the agents are compared, by preset."""
BOXES = ("move_box", "lift_box")
COMPARED = {"state": ("ddpg", "sac", "merl_state"), "laptop": ("merl", "drqv2", "proprio")}

PAPER = {
    "fig2": {
        "MERL, preset laptop": ("fig2", "merl-laptop"),
        "DrQ-v2, preset laptop": ("fig2", "drqv2-laptop"),
        "DDPG, preset state": ("fig2", "ddpg-state"),
        "SAC, preset state": ("fig2", "sac-state"),
    },
    "fig3": {
        "MERL": ("fig2", "merl-laptop"),
        "fusion shared by actor and critic (3a)": ("fig3", "shared-laptop"),
        "no LayerNorm in the fusion (3c)": ("fig3", "no_norm-laptop"),
    },
}
"""{figure: {label: folder in results/ and the runs' names}}."""


def main() -> None:
    """Draw all figures; print the table of the evaluations."""
    laptop()
    gpu()
    agents()
    paper()
    small_tasks()
    boxes()
    for file in sorted(AGENTS.glob("*-evaluation.json")):
        print(table_row(file))


def table_row(file: Path) -> str:
    """Return the results of an evaluation, with 95 % intervals, as a row of a Markdown table."""
    evaluation = json.loads(file.read_text())
    episodes = evaluation["episodes"]
    mean, low, high = bootstrap_interval([episode["return"] for episode in episodes])
    cells = [file.name.removesuffix("-evaluation.json"), f"{evaluation['step']:,}"]
    cells.append(f"{mean:.1f} [{low:.1f}, {high:.1f}]")
    for name in ("success_end", "success_any"):
        count = int(sum(episode[name] for episode in episodes))
        rate, low, high = (100 * part for part in wilson_interval(count, len(episodes)))
        cells.append(f"{rate:.0f} % [{low:.0f}, {high:.0f}]")
    return f"| {' | '.join(cells)} |"


def laptop() -> None:
    """Draw preset laptop over wall-clock time."""
    lines = {row.name: row.returns.mean for row in references("reach_duplo")}
    lines.pop("no motion")
    learning_curves(
        {"MERL, preset laptop": sorted((DATA / "speedrun").glob("laptop-avx2-10-s?.csv"))},
        IMAGES / "laptop.png",
        x="minutes",
        references=lines,
        title="reach_duplo",
    )


def gpu() -> None:
    """Draw preset paper on a GPU beside DrQ-v2's published curve."""
    published: dict[str, list[tuple[float, float]]] = {}
    with (DATA / "gpu/drqv2_published.csv").open() as file:
        for row in csv.DictReader(file):
            points = published.setdefault(row["seed"], [])
            points.append((float(row["frame"]), float(row["return"])))
    lines = {row.name: row.returns.mean for row in references("reach_duplo")}
    learning_curves(
        {
            "MERL, preset paper, one seed": [
                DATA / "gpu/reach_duplo-merl-paper-h100-raster-s0.csv"
            ],
            "DrQ-v2, published": [Curve(*np.array(points).T) for points in published.values()],
        },
        IMAGES / "gpu.png",
        band="bootstrap",
        references={"scripted expert": lines["scripted expert"]},
        title="reach_duplo",
    )


def agents() -> None:
    """Draw the agents on `reach_duplo`, one figure per preset."""
    task = "reach_duplo"
    known = {row.name: row.returns.mean for row in references(task)}
    for preset, names in COMPARED.items():
        runs = {f"{name}, matched": seeds(task, name, preset) for name in names}
        learning_curves(
            runs,
            IMAGES / f"agents-{task}-{preset}.png",
            references=known,
            title=f"{task}, preset {preset}",
        )


def paper() -> None:
    """Draw the runs of the sweeps of the paper's figures."""
    lines = {row.name: row.returns.mean for row in references("reach_duplo")}
    for name, runs in PAPER.items():
        learning_curves(
            {
                label: sorted(DATA.glob(f"{folder}/reach_duplo-{rest}-s?.csv"))
                for label, (folder, rest) in runs.items()
            },
            IMAGES / f"{name}.png",
            references=lines,
            title="reach_duplo",
        )


def seeds(task: str, agent: str, preset: str) -> list[Curve]:
    """Return the evaluations of an agent's runs, up to the step in `MOST`."""
    files = sorted(AGENTS.glob(f"{task}-{agent}-{preset}-matched-s*.csv"))
    if (agent, preset) == ("merl", "laptop"):
        files = sorted(DATA.glob("laptop-seed?.csv"))  # these runs are merl's on reach_duplo
    whole = [curve_of(read_metrics(file), "eval/return") for file in files]
    return [Curve(*(part[one.steps <= MOST[preset]] for part in one)) for one in whole]


def boxes() -> None:
    """Draw the terms of the reward of the tasks with a box, from the state and mixed starts.

    A panel for each task, a curve for each term: its sum over an evaluation episode.
    """
    figure = new_figure(height=2.9 * len(BOXES))
    labels: dict[Axes, list[Label]] = {}
    for axes, task in zip(figure.subplots(len(BOXES), 1), BOXES, strict=True):
        metrics = read_metrics(DATA / f"runs/{task}-merl_state-carrying-s0.csv")
        style(axes, "sum over an episode")
        title = f"{task}, from the state, mixed starts"
        axes.set_title(title, loc="left", color=INK, size=LABEL_SIZE + 1, weight="bold")
        labels[axes] = []
        names = [name for name in metrics if name.startswith("eval/reward/")]
        for name, color in zip(names, PALETTE, strict=False):
            drawn = curve_of(metrics, name)
            axes.plot(*drawn, color=color, lw=1.8)
            last = drawn.values[-1]
            text = f"{name.removeprefix('eval/reward/')} {number(last)}"
            labels[axes].append(Label(text, last, color, "bold"))
        value_axis(axes, [], False)
        step_axis(axes, metrics["step"])
    direct_labels(figure, labels)
    save(figure, IMAGES / "boxes.png")


def small_tasks() -> None:
    """Draw the task in which only camera and joints together can steer the dot to its mark."""
    with (DATA / "small_tasks.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["task"] == SPLIT]
    runs = {
        label: [
            Curve(
                *np.array(
                    [
                        (float(row["step"]), float(row["return"]))
                        for row in rows
                        if (row["agent"], row["precision"], row["seed"]) == (*which, seed)
                    ]
                ).T
            )
            for seed in sorted({row["seed"] for row in rows})
        ]
        for label, which in (
            ("merl, both", ("merl", "fp32")),
            ("merl, both, in bf16", ("merl", "bf16")),
            ("drqv2, camera", ("drqv2", "fp32")),
            ("proprio, joints", ("proprio", "fp32")),
        )
    }
    still = np.mean(returns_of(lambda env: 0 * env.best_action(), SPLIT))
    learning_curves(
        runs,
        IMAGES / "split.png",
        band="bootstrap",
        references={"straight to the mark": optimum(SPLIT), "standing still": float(still)},
        title="the camera sees the mark, the joints know the dot",
    )


if __name__ == "__main__":
    main()
