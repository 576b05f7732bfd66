"""Draw the pictures of README and docs from the committed numbers: python docs/make_figures.py."""

import json
from pathlib import Path
from statistics import mean

from measure_references import EASIER

from merl.envs import EnvConfig
from merl.report.figures import learning_curves, reward_terms
from merl.report.references import references

DOCS = Path(__file__).parent


def main() -> None:
    """Draw every picture that is made of numbers."""
    lines = {row.name: row.returns.mean for row in references("reach_duplo")}
    lines.pop("no motion")
    learning_curves(
        {"MERL, preset laptop": sorted((DOCS / "data").glob("laptop-seed?.csv"))},
        DOCS / "images" / "laptop.png",
        x="minutes",
        references=lines,
        title="reach_duplo",
    )
    states = {
        "reach_duplo": "reach_duplo",
        "move_box": "move_box",
        "move_box, goal linear to 0.3 m": "move_box-linear30",
        "move_box, the same, the hand around the box": "move_box-around",
        "move_box, easier: around or holding, both, smooth": "move_box-easier",
        "lift_box": "lift_box",
        "lift_box, goal linear to 0.3 m": "lift_box-linear30",
        "lift_box, the same, the hand around or holding the box": "lift_box-holding",
        "lift_box, easier: around or holding, both, smooth": "lift_box-easier",
    }
    files = {title: DOCS / "data" / f"state-{name}-seed0.csv" for title, name in states.items()}
    forms = {
        "reach_duplo": ("reach_duplo", EnvConfig()),
        "move_box": ("move_box", EnvConfig()),
        "lift_box": ("lift_box", EnvConfig()),
        **{
            title: (title.partition(",")[0], EnvConfig(**EASIER))
            for title, name in states.items()
            if name.endswith("easier")
        },
    }
    experts = {
        title: next(row.terms for row in references(*form) if row.name == "scripted expert")
        for title, form in forms.items()
    }
    reward_terms(files, DOCS / "images" / "state.png", references=experts)
    for seed in range(3):
        print(f"seed {seed}: {mean_return(f'laptop-seed{seed}'):.1f}")


def mean_return(name: str) -> float:
    """Of the episodes in `data/NAME-evaluation.json`."""
    told = json.loads((DOCS / "data" / f"{name}-evaluation.json").read_text())
    return mean(episode["return"] for episode in told["episodes"])


if __name__ == "__main__":
    main()
