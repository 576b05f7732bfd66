"""The numbers of a report, at values computed by hand."""

from __future__ import annotations

import csv
import fcntl
import math
from pathlib import Path

import pytest

from merl.report.collect import Group, collect
from merl.report.summary import Estimate, comparisons, overall, row_of, write_table
from runs_on_disk import write_run


def groups_of(folder: Path) -> list[Group]:
    return collect([folder])[0]


@pytest.fixture
def two_variants(tmp_path: Path) -> Path:
    """Write two variants with three seeds each."""
    for seed in (0, 1, 2):
        rates = [0.0, 0.5 if seed else 0.2, 0.9 if seed else 0.7]
        write_run(tmp_path / f"reach_duplo-a-s{seed}", [0, 100, 200 + seed], rates, seed=seed)
        rates = [0.0, 0.1, 0.2]
        write_run(tmp_path / f"reach_duplo-b-s{seed}", [0, 50, 100], rates, seed=seed, tau=0.1)
    return tmp_path


def test_results_of_a_group(two_variants: Path) -> None:
    row = row_of(groups_of(two_variants)[0])
    results = row.results
    assert (row.steps, row.minutes.mean, row.spread) == (3000, 3.0, 1.0)
    final = results["final return"]
    assert (final.mean, final.low, final.high, final.count) == (201.0, 200.0, 202.0, 3)
    assert results["mean return"].mean == pytest.approx((50 + 150.5) / 2)
    assert results["final success"].mean == pytest.approx((0.7 + 0.9 + 0.9) / 3)
    assert results["steps to 50% success"].mean == pytest.approx((3000 + 2000 + 2000) / 3)
    assert results["minutes to 50% success"].mean == pytest.approx(7 / 3)
    late = results["steps to 80% success"]
    assert (late.mean, late.count, late.seeds) == (3000.0, 2, 3)
    assert math.isnan(late.low)  # the interval of those that arrived would be too good
    assert late.text(",.0f") == "3,000 (2 of 3 seeds)"
    never = row_of(groups_of(two_variants)[1]).results["steps to 50% success"]
    assert never.text() == "never"


def test_a_run_whose_metrics_have_no_row_has_the_result_of_its_evaluation(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / f"a-s{i}", [], [], seed=i, final=(5.0, 1.0)) for i in range(2)]
    row = row_of(groups_of(tmp_path)[0])
    assert (row.steps, row.results["final return"].mean) == (0, 5.0)
    with (runs[0] / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "a-s0 is still training: at step 0" in collect([tmp_path])[1]


def test_one_seed_has_no_interval() -> None:
    one = Estimate.of([5.0])
    assert math.isnan(one.low)
    assert one.text() == "5"
    assert Estimate.of([4.0, 6.0]).text() == "5 [4, 6]"


def test_the_first_group_is_compared_with_the_others(two_variants: Path) -> None:
    (found,) = comparisons(groups_of(two_variants))
    assert (found.ours, found.theirs, found.pairs) == ("a", "b", 3)
    assert found.better.mean == found.better.low == 1.0
    assert (found.difference, found.p) == (101.0, 0.25)


def test_single_seeds_are_compared_without_an_interval(tmp_path: Path) -> None:
    write_run(tmp_path / "reach_duplo-a-s0", [10], [0])
    write_run(tmp_path / "reach_duplo-b-s1", [5], [0], seed=1, tau=0.1)
    (found,) = comparisons(groups_of(tmp_path))
    assert found.better.mean == 1.0
    assert math.isnan(found.better.low)
    assert (found.pairs, math.isnan(found.p)) == (0, True)


def test_scores_are_0_for_random_actions_and_1_for_the_expert(tmp_path: Path) -> None:
    for seed in (0, 1):
        write_run(tmp_path / f"reach_duplo-a-s{seed}", [7.8 + seed * 221.8], [0], seed=seed)
    (found,) = overall(groups_of(tmp_path))
    assert found.scores[:, 0] == pytest.approx([0, 1], abs=0.01)
    assert found.mean.mean == pytest.approx(0.5, abs=0.01)
    assert found.gap.mean == pytest.approx(0.5, abs=0.01)


def test_variants_with_one_seed_or_without_references_have_no_score(tmp_path: Path) -> None:
    write_run(tmp_path / "reach_duplo-a-s0", [10], [0])
    assert overall(groups_of(tmp_path)) == []
    own = tmp_path / "own"
    for seed in (0, 1):
        write_run(own / f"mine-a-s{seed}", [10], [0], seed=seed, task="mine:make")
    assert overall(groups_of(own)) == []


def test_the_table_has_every_result_with_its_interval(two_variants: Path) -> None:
    path = two_variants / "table.csv"
    write_table([row_of(group) for group in groups_of(two_variants)], path)
    with path.open() as file:
        first, second = csv.DictReader(file)
    assert (first["variant"], first["seeds"], first["final return"]) == ("a", "3", "201.0")
    assert (first["final return low"], first["final return high"]) == ("200.0", "202.0")
    assert second["steps to 50% success"] == ""
    assert second["steps to 50% success seeds"] == "0"
