import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from merl.core import MerlError
from merl.report import figures
from merl.report.curves import Curve
from merl.report.drawing import headline, new_figure, save
from merl.report.figures import learning_curve, learning_curves

HEADER = (
    "step,time/seconds,train/return,eval/return,eval/return_low,eval/return_high,"
    "eval/success_end,eval/success_end_low,eval/success_end_high,eval/success_any\n"
)


def write_run(run, steps, offset=0.0):
    """Write metrics with a training episode at every step and an evaluation at every second one."""
    run.mkdir(exist_ok=True)
    lines = [HEADER]
    for i, step in enumerate(steps):
        value = offset + step / 1000
        evaluation = f"{value},{value - 3},{value + 4},.5,.3,.7,.6" if i % 2 else ",,,,,,"
        lines.append(f"{step},{step / 25},{value * 0.9},{evaluation}\n")
    (run / "metrics.csv").write_text("".join(lines))
    config = {"task": "reach_duplo", "preset": "laptop", "seed": 3, "agent": {"width": 512}}
    (run / "config.json").write_text(json.dumps(config))
    return run


@pytest.fixture
def drawn(monkeypatch):
    """Collect the figures that are saved."""
    saved = []
    save = figures.save
    monkeypatch.setattr(
        figures, "save", lambda figure, to: (saved.append(figure), save(figure, to))[1]
    )
    return saved


def words(figure):
    """Return {text on a figure: its box in pixels}; the title has no box."""
    figure.draw_without_rendering()
    found = {figure.get_suptitle(): None}
    for axes in figure.axes:
        for text in axes.texts:
            found[text.get_text()] = text.get_window_extent()
    return found


def test_learning_curve_of_one_run(tmp_path, drawn):
    run = write_run(tmp_path / "run", range(1000, 61_000, 1000))
    path = learning_curve(
        run, tmp_path / "a" / "curve.png", references={"random": 2.1, "best known": 224.6}
    )
    assert imread(path).shape[:2] == (864, 1216)
    assert [one.name for one in path.parent.iterdir()] == ["curve.png"]
    assert set(words(drawn[0])) == {
        "reach_duplo · laptop · seed 3",
        "random 2.1",
        "best known 225",
        "training",
        "evaluation 60",
        "at the end 50 %",
        "at any time 60 %",
    }
    above, below = drawn[0].axes
    evaluation = next(line for line in above.lines if line.get_color() == figures.BLUE)
    np.testing.assert_array_equal(evaluation.get_xdata(), np.arange(2000, 61_000, 2000))
    np.testing.assert_array_equal(evaluation.get_ydata(), np.arange(2, 61, 2))
    for axes in (above, below):
        assert len(axes.collections) == 1  # the band
    band = above.collections[0].get_datalim(above.transData)
    assert (band.ymin, band.ymax) == (-1, 64)
    assert below.collections[0].get_datalim(below.transData).ymax == 0.7


def test_labels_are_whole_and_do_not_overlap(tmp_path, drawn):
    run = write_run(tmp_path / "run", range(1000, 5000, 1000))
    references = {"random": 2.1, "standing still": 2.2, "twice": 2.2, "best known": 224.6}
    learning_curve(run, tmp_path / "curve.png", references=references)
    boxes = [box for box in words(drawn[0]).values() if box is not None]
    assert len(boxes) == 8
    for i, box in enumerate(boxes):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= drawn[0].bbox.x1
        assert box.y1 <= drawn[0].bbox.y1
        assert not any(box.overlaps(other) for other in boxes[:i])


@pytest.mark.parametrize(
    ("steps", "title_end"),
    [([], "(no episode has ended yet)"), ([250], "(no evaluation yet)"), ([250, 500], "seed 3")],
)
def test_the_title_says_if_there_is_no_evaluation_yet(tmp_path, drawn, steps, title_end):
    run = write_run(tmp_path / "run", steps)
    assert imread(learning_curve(run, tmp_path / "curve.png")).std() > 0
    assert drawn[0].get_suptitle().endswith(title_end)


def test_a_run_without_config_evaluations_or_times(tmp_path, drawn):
    (tmp_path / "metrics.csv").write_text("step,train/return\n250,3\n500,4\n")
    learning_curve(tmp_path, tmp_path / "curve.svg")
    assert drawn[0].get_suptitle() == f"{tmp_path.name} (no evaluation yet)"
    assert len(drawn[0].axes) == 1
    assert b"<svg" in (tmp_path / "curve.svg").read_bytes()


@pytest.mark.parametrize("config", ["", "[1]", "{", '{"task": "reach_duplo"}'])
def test_an_incomplete_config_is_accepted(tmp_path, drawn, config):
    run = write_run(tmp_path / "run", [250, 500])
    (run / "config.json").write_text(config)
    learning_curve(run, tmp_path / "curve.png")
    assert drawn[0].get_suptitle() == ("reach_duplo" if "task" in config else "run")


def test_long_training_is_drawn_as_means():
    steps, per_point = figures._smooth(Curve(np.arange(601.0), np.arange(601.0) % 2))
    assert per_point == 5
    assert len(steps.steps) == 120
    np.testing.assert_array_equal(steps.steps[:2], [2, 7])
    np.testing.assert_allclose(steps.values[:2], [0.4, 0.6])


def test_the_time_axis_follows_uneven_speed(tmp_path, drawn):
    # 1000 steps in the first two minutes, 3000 in the next two.
    text = "step,time/seconds,eval/return\n500,60,1\n1000,120,1\n4000,240,1\n"
    (tmp_path / "metrics.csv").write_text(text)
    learning_curve(tmp_path, tmp_path / "curve.png")
    drawn[0].draw_without_rendering()
    top = drawn[0].axes[0].child_axes[0]
    ticks = dict(zip((t.get_text() for t in top.get_xticklabels()), top.get_xticks(), strict=True))
    assert ticks == {"0": 0, "1": 500, "2": 1000, "3": 2500, "4": 4000}


def test_labels_have_the_number_of_seeds(tmp_path, drawn):
    steps = range(1000, 21_000, 1000)
    seeds = [write_run(tmp_path / f"s{i}", steps, offset=2.0 * i) for i in range(3)]
    one = seeds[0] / "metrics.csv"
    learning_curves({"MERL": seeds, "DrQ-v2": [one]}, tmp_path / "curves.png", title="reach_duplo")
    assert {"reach_duplo", "MERL (3 seeds)", "DrQ-v2 (1 seed)"} == set(words(drawn[0]))
    axes = drawn[0].axes[0]
    assert len(axes.lines) == 3 + 1 + 1  # each seed, their mean, and the lone seed
    assert len(axes.collections) == 1  # one seed has no band
    mean = max(axes.lines, key=lambda line: line.get_linewidth())
    np.testing.assert_allclose(mean.get_ydata(), np.arange(2, 21, 2) + 2.0)
    band = axes.collections[0].get_datalim(axes.transData)
    assert (band.ymin, band.ymax) == (2, 24)


def test_success_over_minutes_with_references(tmp_path, drawn):
    run = write_run(tmp_path / "run", range(1000, 21_000, 1000))
    published = Curve(np.array([1.0, 9.0]), np.array([0.1, 0.9]))
    learning_curves(
        {"ours": [run, run], "published": [published]},
        tmp_path / "curves.png",
        x="minutes",
        name="eval/success_end",
        band="bootstrap",
        references={"goal": 0.8},
    )
    axes = drawn[0].axes[0]
    assert axes.get_xlim() == pytest.approx((0, 20_000 / 25 / 60))
    assert axes.get_xlabel() == "minutes of wall-clock"
    assert axes.get_ylabel() == "success at the end"
    assert "goal 80 %" in words(drawn[0])


def test_seeds_without_a_common_step_have_no_mean(tmp_path, drawn):
    early, late = (Curve(np.array([s, s + 1.0]), np.array([1.0, 2.0])) for s in (0.0, 5.0))
    learning_curves({"a": [early, late]}, tmp_path / "curves.png")
    assert len(drawn[0].axes[0].lines) == 2


def test_errors_name_the_missing_data(tmp_path):
    run = write_run(tmp_path / "run", [250])
    for runs, message in (
        ({}, "no run"),
        ({"MERL": []}, "MERL: no run"),
        ({"MERL": [run]}, "MERL: no eval/return over steps"),
        ({"MERL": [tmp_path / "none"]}, "no metrics"),
    ):
        with pytest.raises(MerlError, match=message):
            learning_curves(runs, tmp_path / "curves.png")
    with pytest.raises(MerlError, match="cannot be written"):
        learning_curve(run, tmp_path / "curve.abc")
    with pytest.raises(MerlError, match="cannot be written"):
        learning_curve(run, run / "config.json" / "curve.png")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_names_are_drawn_as_they_are(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    """A pair of dollars is no formula, and a letter that the font lacks is no warning."""
    figure = new_figure(2.0)
    axes = figure.add_subplot()
    axes.plot([1, 1000], [0, 1])
    headline(figure, "cost $a_b$ and $\\frac$ 机器人")
    text = save(figure, tmp_path / "names.svg").read_text()
    assert "cost $a_b$ and $\\frac$ 机器人" in text
    assert "mathdefault" not in text
    assert not [warning for warning in recwarn if "Glyph" in str(warning.message)]
