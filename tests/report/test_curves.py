import subprocess
import sys

import numpy as np
import pytest

from merl.core import MerlError
from merl.report.curves import Curve, aggregate, curve_of, read_metrics

METRICS = "step,train/return,eval/return,time/seconds\n10,1.5,,60\n20,,7,120\n30,nan,9.25,240\n"


@pytest.fixture
def run(tmp_path):
    (tmp_path / "metrics.csv").write_text(METRICS)
    return tmp_path


def line(steps, values):
    return Curve(np.array(steps, dtype=float), np.array(values, dtype=float))


def test_empty_cells_are_read_as_nan(run):
    metrics = read_metrics(run)
    assert list(metrics) == ["step", "train/return", "eval/return", "time/seconds"]
    np.testing.assert_array_equal(metrics["step"], [10, 20, 30])
    np.testing.assert_array_equal(metrics["train/return"], [1.5, np.nan, np.nan])
    np.testing.assert_array_equal(metrics["eval/return"], [np.nan, 7, 9.25])


def test_a_file_is_read_like_its_folder(run):
    np.testing.assert_equal(read_metrics(run / "metrics.csv"), read_metrics(run))


@pytest.mark.parametrize(
    "incomplete", ["4", "40", "40,1", "40,1,2,3", '40,"', "\0\0\0", "40,1,2,300.2"]
)
def test_an_incomplete_last_line_is_skipped(run, incomplete):
    (run / "metrics.csv").write_text(METRICS + incomplete)
    np.testing.assert_array_equal(read_metrics(run)["step"], [10, 20, 30])


@pytest.mark.parametrize("text", ["", "st", "step\n", "step,eval/return\n"])
def test_a_run_without_rows_has_an_empty_curve(run, text):
    (run / "metrics.csv").write_text(text)
    assert len(read_metrics(run)["step"]) == 0
    assert len(curve_of(read_metrics(run), "eval/return").steps) == 0


@pytest.mark.parametrize("text", [METRICS + "40,1\n", METRICS + "40,a,2,3\n", "frame,x\n1,2\n"])
def test_a_malformed_file_is_reported(run, text):
    (run / "metrics.csv").write_text(text)
    with pytest.raises(MerlError, match=r"metrics\.csv is not a file of metrics"):
        read_metrics(run)


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(MerlError, match=r"no metrics in .*metrics\.csv"):
        read_metrics(tmp_path)


def test_a_curve_skips_empty_cells(run):
    steps, values = curve_of(read_metrics(run), "eval/return")
    np.testing.assert_array_equal(steps, [20, 30])
    np.testing.assert_array_equal(values, [7, 9.25])
    assert len(curve_of(read_metrics(run), "eval/unknown").steps) == 0


def test_a_curve_over_another_column(run):
    over_time = curve_of(read_metrics(run), "eval/return", "time/seconds")
    np.testing.assert_array_equal(over_time.steps, [120, 240])


def test_aggregate_of_seeds_on_the_same_steps():
    together = aggregate([line([0, 10], [1, 4]), line([0, 10], [3, 8]), line([0, 10], [2, 0])])
    np.testing.assert_array_equal(together.steps, [0, 10])
    np.testing.assert_array_equal(together.values, [[1, 4], [3, 8], [2, 0]])
    np.testing.assert_array_equal(together.mean, [2, 4])
    np.testing.assert_array_equal(together.low, [1, 0])
    np.testing.assert_array_equal(together.high, [3, 8])


def test_aggregate_interpolates_and_never_extrapolates():
    together = aggregate([line([0, 10, 20], [0, 10, 20]), line([5, 15], [1, 3])])
    np.testing.assert_array_equal(together.steps, [5, 10, 15])
    np.testing.assert_array_equal(together.values, [[5, 10, 15], [1, 2, 3]])


def test_aggregate_with_a_bootstrap_band():
    together = aggregate([line([0], [0]), line([0], [0]), line([0], [3])], band="bootstrap")
    assert (together.low[0], together.mean[0], together.high[0]) == (0, 1, 3)


@pytest.mark.parametrize("curves", [[], [line([], [])], [line([0, 1], [0, 1]), line([2], [0])]])
def test_aggregate_refuses_curves_without_a_common_step(curves):
    with pytest.raises(ValueError, match="seeds"):
        aggregate(curves)


def test_reports_need_neither_torch_nor_mujoco_nor_training():
    code = (
        "import sys, merl.report.figures\n"
        "heavy = {'torch', 'mujoco', 'dm_control', 'merl.training', 'matplotlib.pyplot'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
