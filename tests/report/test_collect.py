"""Runs are read, grouped by seed and named; what cannot be read is skipped with a note."""

from __future__ import annotations

import fcntl
from pathlib import Path

import pytest

from merl.core import MerlError
from merl.report.collect import collect, read_run
from runs_on_disk import COLUMNS, write_run

UP, RATES = [10.0, 20.0, 30.0], [0.0, 0.5, 0.9]


def test_runs_that_differ_in_their_seed_are_one_group(tmp_path: Path) -> None:
    for seed in (10, 2):
        write_run(tmp_path / f"reach_duplo-merl-s{seed}", UP, RATES, seed=seed)
    write_run(tmp_path / "reach_duplo-wide-s2", UP, RATES, seed=2, latent_dim=256)
    groups, notes = collect([tmp_path])
    assert [(group.label, group.seeds) for group in groups] == [("merl", [2, 10]), ("wide", [2])]
    assert notes == ["reach_duplo: wide has one seed: no interval over seeds"]


def test_seeds_that_start_with_policies_of_their_own_are_one_group(tmp_path: Path) -> None:
    for seed, start in enumerate(("runs/a-s0-bc", "runs/a-s1-2-bc")):
        write_run(tmp_path / f"reach_duplo-a-s{seed}", UP, RATES, seed=seed, start_from=start)
    write_run(tmp_path / "reach_duplo-b-s0", UP, RATES, start_from="runs/a-small-bc")
    groups, _ = collect([tmp_path])
    labels = [(group.label, group.seeds) for group in groups]
    assert labels == [("a", [0, 1]), ("b", [0])]


def test_missing_seeds_are_named(tmp_path: Path) -> None:
    for seed in (0, 1, 2):
        write_run(tmp_path / f"reach_duplo-merl-s{seed}", UP, RATES, seed=seed)
        if seed != 1:
            write_run(tmp_path / f"reach_duplo-wide-s{seed}", UP, RATES, seed=seed, tau=0.1)
    _, notes = collect([tmp_path])
    assert notes == ["reach_duplo: wide lacks seed 1, which others have"]


def test_options_that_change_no_learning_do_not_split_a_group(tmp_path: Path) -> None:
    short = write_run(tmp_path / "a-s0", UP[:2], RATES[:2])
    longer = write_run(tmp_path / "a-s1", UP, RATES, seed=1)
    (group,), notes = collect([short, longer])
    assert len(group.runs) == 2
    assert any("unequal length: their mean ends at step 2,000" in note for note in notes)


def test_equal_names_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / str(i) / "mine", UP, RATES, tau=tau) for i, tau in enumerate((1, 2))
    ]
    groups, _ = collect(runs)
    assert [group.label for group in groups] == ["mine (agent.tau 1)", "mine (agent.tau 2)"]


def test_labels_have_as_many_values_as_tell_them_apart(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / str(i) / "mine", UP, RATES, a=a, b=a, c=a, d=d)
        for i, (a, d) in enumerate(((1, 5), (1, 6), (3, 5)))
    ]
    groups, _ = collect(runs)
    assert [group.label for group in groups] == [
        "mine (agent.a 1, agent.b 1, agent.c 1, agent.d 5)",
        "mine (agent.a 1, agent.b 1, agent.c 1, agent.d 6)",
        "mine (agent.a 3, agent.b 3, agent.c 3)",
    ]


def test_tasks_are_never_mixed(tmp_path: Path) -> None:
    write_run(tmp_path / "move_box-merl-s0", UP, RATES, task="move_box")
    write_run(tmp_path / "reach_duplo-merl-s0", UP, RATES)
    groups, _ = collect([tmp_path])
    assert [(group.task, group.label) for group in groups] == [
        ("move_box", "merl"),
        ("reach_duplo", "merl"),
    ]


def test_csv_files_are_runs_named_by_task_variant_and_seed(tmp_path: Path) -> None:
    for seed in (0, 1):
        (tmp_path / f"move_box-sac-s{seed}.csv").write_text(f"{COLUMNS}\n1000,60,1,5,0.5\n")
    (group,), _ = collect([tmp_path])
    assert (group.task, group.label, group.seeds) == ("move_box", "sac", [0, 1])


def test_the_evaluation_of_a_sweep_is_the_final_result(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "a-s0", UP, RATES, final=(25.0, 0.5)))
    assert (run.final("return"), run.final("success_end")) == (25.0, 0.5)
    plain = read_run(write_run(tmp_path / "a-s1", UP, RATES))
    assert (plain.final("return"), plain.final("success_end")) == (30.0, 0.9)


def test_an_evaluation_from_before_the_last_steps_does_not_count(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a-s0", UP, RATES, final=(25.0, 0.5))
    content = (run / "evaluation.json").read_text()
    (run / "evaluation.json").write_text(content.replace('"step": 3000', '"step": 2000'))
    assert read_run(run).final("return") == 30.0


def test_the_metrics_of_a_run_are_the_run(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, UP, RATES, tau=i) for i, name in enumerate(("a", "b"))]
    files = [run / "metrics.csv" for run in runs]
    groups, _ = collect([*files, *runs, tmp_path])
    assert [group.label for group in groups] == ["a", "b"]
    assert [len(group.runs) for group in groups] == [1, 1]


def test_forms_of_a_task_are_not_mixed(tmp_path: Path) -> None:
    plain = write_run(tmp_path / "a-s0", UP, RATES, task="move_box")
    staged = write_run(tmp_path / "b-s0", UP, RATES, task="move_box")
    config = (staged / "config.json").read_text()
    (staged / "config.json").write_text(config.replace('"reward": "paper"', '"reward": "staged"'))
    groups, _ = collect([plain, staged])
    assert [group.task for group in groups] == ["move_box", "move_box staged"]


@pytest.mark.parametrize("value", ['"x"', "5", "null"])
def test_a_record_that_cannot_be_used_is_skipped(tmp_path: Path, value: str) -> None:
    good, bad = (write_run(tmp_path / name, UP, RATES) for name in ("good-s0", "bad-s0"))
    config = (bad / "config.json").read_text()
    (bad / "config.json").write_text(config.replace('"occluded": false', f'"occluded": {value}'))
    groups, notes = collect([good, bad])
    if value != "null":
        assert len(groups[0].runs) == 1
        assert any("bad-s0" in note for note in notes)


def test_seeds_that_occur_twice_are_named(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / str(i) / "a-s0", UP, RATES) for i in range(2)]
    _, notes = collect(runs)
    assert "reach_duplo: a has seed 0 more than once: each run counts" in notes


def test_infinite_numbers_are_skipped(tmp_path: Path) -> None:
    good, bad = (write_run(tmp_path / name, UP, RATES) for name in ("good-s0", "bad-s0"))
    (bad / "metrics.csv").write_text(f"{COLUMNS}\n1000,60,1,inf,0.5\n")
    groups, notes = collect([good, bad])
    assert len(groups) == 1
    assert any("bad-s0 contains infinite numbers" in note for note in notes)


def test_references_are_those_of_the_evaluated_form(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "a-s0", UP, RATES))
    assert run.references["random actions"] == pytest.approx(7.8, abs=0.05)
    assert read_run(write_run(tmp_path / "b", UP, RATES, task="mine:make")).references == {}


def test_a_run_that_is_training_is_named(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a-s0", UP, RATES)
    with (run / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        _, notes = collect([run])
    assert "a-s0 is still training: at step 3,000" in notes


def test_what_cannot_be_read_is_skipped_by_name(tmp_path: Path) -> None:
    good = write_run(tmp_path / "good-s0", UP, RATES)
    broken = write_run(tmp_path / "broken-s0", UP, RATES)
    (broken / "metrics.csv").write_text("step,eval/return\n1,x\n")
    none = write_run(tmp_path / "none-s0", [], [])
    without = write_run(tmp_path / "without-s0", UP, RATES)
    (without / "metrics.csv").unlink()
    empty = tmp_path / "empty"
    empty.mkdir()
    garbled = write_run(tmp_path / "garbled-s0", UP, RATES)
    (garbled / "config.json").write_bytes(b"\xff{")
    (garbled / "evaluation.json").write_text('{"episodes": [3, {"return": "x"}]}')
    groups, notes = collect([good, broken, none, without, empty, garbled])
    assert [run.name for group in groups for run in group.runs] == ["good-s0", "garbled-s0"]
    skipped = [note for note in notes if note.startswith("skipped: ")]
    for name, why in (
        ("broken-s0", "not a file of metrics"),
        ("none-s0", "no evaluation yet"),
        ("without-s0", "No such file"),
        ("empty", "holds no run"),
    ):
        assert any(name in note and why in note for note in skipped), name
    assert len(skipped) == 4


def test_nothing_to_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MerlError, match="no run can be read: skipped"):
        collect([tmp_path])
    with pytest.raises(MerlError, match="missing does not exist: name run folders"):
        collect([tmp_path / "missing"])
