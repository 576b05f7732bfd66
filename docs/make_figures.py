"""Draw the pictures of README and docs from the committed numbers: python docs/make_figures.py."""

from pathlib import Path

from merl.report.curves import curve
from merl.report.figures import learning_curves

DOCS = Path(__file__).parent


def main() -> None:
    """Draw every picture that is made of numbers."""
    seeds = sorted((DOCS / "data").glob("laptop-seed*.csv"))
    learning_curves(
        {"MERL, preset laptop": seeds},
        DOCS / "images" / "laptop.png",
        x="minutes",
        references={"random": 0.6, "DrQ-v2 after 2.98M frames": 224.6},
        title="reach_duplo",
    )
    for seed in seeds:
        print(seed.name, *(f"{y:.0f}@{x:.0f}" for x, y in zip(*curve(seed, "eval/return"))))


if __name__ == "__main__":
    main()
