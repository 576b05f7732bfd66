"""Damaged and disguised files in a run folder: named in one line, and never learnt from."""

from __future__ import annotations

import errno
import logging
import os
import random
import shutil
import stat
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file
from test_recovery import EPISODE, assert_same, line, saved, started, wait_until_saved

from disguises import DISGUISES, at_most
from faults import Faults, with_faults
from merl.cli import main
from merl.runs.checkpoint import Checkpoint

CAPACITY = 200
FURTHER = 60
"""Steps by which a run is trained further."""
VARIANTS = {"raw": (), "compressed": ("--replay.compress",)}


@pytest.fixture(scope="module", params=VARIANTS)
def runs(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Return a finished run, and one that was killed after its ring had wrapped."""
    folder = tmp_path_factory.mktemp("runs")
    more = ("--replay.capacity", str(CAPACITY), *VARIANTS[request.param])
    assert main(line(folder / "finished", "--steps", "300", *more)) == 0
    with started(line(folder / "killed", "--steps", "100000", *more)) as process:
        wait_until_saved(folder / "killed", process, 280)
    return {name: folder / name for name in ("finished", "killed")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    assert main(line(folder, "--steps", "200", "--keep", "1", "--replay.compress")) == 0
    return folder


def files_of(run: Path) -> list[Path]:
    return sorted(path.relative_to(run) for path in run.rglob("*") if path.is_file())


def copy_of(run: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    return shutil.copytree(run, copy)


def resume(run: Path, *more: str) -> int:
    return main(["resume", str(run), "--steps", str(saved(run)[-1] + FURTHER), *more])


def weights(run: Path) -> bytes:
    newest = run / f"checkpoints/{saved(run)[-1]:08d}/weights.safetensors"
    return b"".join(tensor.numpy().tobytes() for _, tensor in sorted(load_file(newest).items()))


def flip(file: Path, dice: random.Random) -> bool:
    """Flip a bit, or replace a byte; return whether the file has any."""
    data = bytearray(file.read_bytes())
    if data:
        at = dice.randrange(len(data))
        data[at] = dice.choice(
            [data[at] ^ 1 << dice.randrange(8), data[at] ^ dice.randrange(1, 256)]
        )
        file.write_bytes(data)
    return bool(data)


def one_line(text: str) -> bool:
    errors = [each for each in text.splitlines() if each.startswith("merl: error:")]
    return len(errors) == 1 and "Traceback" not in text


@pytest.mark.parametrize("which", ["killed", pytest.param("finished", marks=pytest.mark.long)])
def test_a_flipped_bit_is_named_or_changes_nothing(
    runs: dict[str, Path], which: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, dice = runs[which], random.Random(which)
    expected = copy_of(run, tmp_path)
    end = saved(expected)[-1] + FURTHER
    assert resume(expected) == 0
    right = weights(expected)
    found = {"sound": 0, "damaged": 0}
    for name in files_of(run):
        for trial in range(2):
            copy = copy_of(run, tmp_path)
            if not flip(copy / name, dice):
                continue
            capsys.readouterr()
            code = main(["check", str(copy)])
            out, err = capsys.readouterr()
            assert code in (0, 1, 2), (name, out, err)
            if code == 1:
                assert "DAMAGED: " in out, name
                known = {"replay": str(copy / "replay"), "checkpoints": str((copy / name).parent)}
                assert known.get(name.parts[0], str(copy / name)) in out.partition("DAMAGED")[2]
            elif code == 2:
                assert one_line(err)
                assert name.name in err
            kind = "damaged" if code else "sound"
            found[kind] += 1
            if trial or f"{saved(run)[0]:08d}" in name.parts:  # the oldest checkpoint is not read
                continue
            code = main(["resume", str(copy), "--steps", str(end)])
            err = capsys.readouterr().err
            if code == 0:
                assert weights(copy) == right, (name, kind)
            else:
                assert (code, kind, one_line(err)) == (2, "damaged", True), (name, err)
    assert min(found.values()) > 2, found


@pytest.mark.parametrize(
    "name", ["observation.image", "position", "timestep", "action", "observation.image.span"]
)
def test_damaged_episodes_can_be_left_out(
    runs: dict[str, Path],
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    copy = copy_of(runs["finished"], tmp_path)
    files = [*copy.rglob(f"replay/*/{name}.bin")]
    if not files:
        return  # a raw replay has no spans
    data = bytearray(files[0].read_bytes())
    at = len(data) // 3
    spans = files[0].with_suffix(".span.bin")
    if spans.exists():  # a byte of a frame
        at = int(np.fromfile(spans, "<i8")[0]) + 1
    data[at] ^= 4
    files[0].write_bytes(data)
    before = {path: (copy / path).read_bytes() for path in files_of(copy)}
    assert resume(copy) == 2
    err = capsys.readouterr().err
    assert one_line(err)
    assert f"{files[0]} is damaged in block 0 (timesteps " in err
    assert "--damaged skip" in err
    assert {path: (copy / path).read_bytes() for path in before} == before
    assert main(["check", str(copy)]) == 1
    assert f"DAMAGED: {files[0]} is damaged in block 0" in capsys.readouterr().out
    assert resume(copy, "--damaged", "skip") in (0, 2)
    err = capsys.readouterr().err
    assert "left out of the replay" in err or "no step without damage" in err


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_damaged_last_checkpoint_costs_nothing_but_its_steps(
    variant: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The ring overwrites half of its steps between two checkpoints, and more after the last."""
    more = ("--replay.capacity", "64", *VARIANTS[variant])
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert main(line(whole, "--steps", "400", *more)) == 0
    with started(line(parts, "--steps", "100000", *more)) as process:
        wait_until_saved(parts, process, 200)
    last = saved(parts)[-1]
    assert last < 400
    file = parts / f"checkpoints/{last:08d}/weights.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    assert main(["resume", str(parts), "--steps", "400"]) == 0
    out, err = capsys.readouterr()
    assert "checkpoint skipped" in err
    assert "overwritten" not in err
    assert f"resumes at step {last - EPISODE}" in out
    assert_same(whole, parts)
    assert all(Checkpoint.open(path) for path in (parts / "checkpoints").iterdir())


@pytest.mark.parametrize("disguise", DISGUISES, ids=lambda each: each.__name__)
def test_a_file_that_is_not_what_it_seems_is_refused_or_not_needed(
    finished: Path,
    disguise: Callable[[Path], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in files_of(finished):
        commands = {"check": (), "resume": ("--steps", "220")}
        if name.suffix in (".json", ".csv", ".safetensors") and name.parts[0] != "replay":
            commands |= {"evaluate": ("--episodes", "1"), "report": ("--output", str(tmp_path))}
        for command, options in commands.items():
            copy = copy_of(finished, tmp_path)
            (copy / name).unlink()
            disguise(copy / name)
            with at_most(60):
                code = main([command, str(copy), *options])
            err = capsys.readouterr().err
            assert code in (0, 1, 2), (command, name, err)
            assert code < 2 or one_line(err), (command, name, err)


def test_a_name_that_is_not_text_does_not_matter(
    finished: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    copy = copy_of(finished, tmp_path)
    for place in ("", "checkpoints/", "replay/"):
        (copy / place / os.fsdecode(b"\xff\xfe")).touch()
        (copy / place / os.fsdecode(b"\xff")).mkdir()
    with caplog.at_level(logging.WARNING):
        assert main(["check", str(copy)]) == 0
        assert resume(copy) == 0


def test_check_does_not_call_a_file_damaged_that_cannot_be_read(
    finished: Path, tmp_path: Path
) -> None:
    copy = copy_of(finished, tmp_path)
    check = lambda: main(["check", str(copy)])  # noqa: E731
    whole = with_faults(check, Faults(copy))
    assert whole.code == 0
    assert len(whole.names) > 20
    for at, name in enumerate(whole.names, 1):
        ended = with_faults(check, Faults(copy, at, errno.EIO, lasts=at % 2 == 0))
        assert "DAMAGED" not in ended.out, (name, ended.out)
        assert ended.code == 2, (name, ended.out, ended.err)
        assert one_line(ended.err), (name, ended.err)


def test_check_names_missing_metrics_without_which_a_run_resumes(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = copy_of(finished, tmp_path)
    (copy / "metrics.csv").unlink()
    assert main(["check", str(copy)]) == 1
    (found,) = [each for each in capsys.readouterr().out.splitlines() if "DAMAGED" in each]
    assert found.startswith(f"DAMAGED: {copy / 'metrics.csv'} is gone: the metrics so far are lost")
    assert resume(copy) == 0
    assert main(["check", str(copy)]) == 0


def test_check_changes_nothing_and_refuses_a_run_in_training(
    runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = copy_of(runs["killed"], tmp_path)
    before = {path: (copy / path).read_bytes() for path in files_of(copy)}
    for path in (copy, *copy.rglob("*")):
        path.chmod(path.stat().st_mode & ~(stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))
    assert main(["check", str(copy)]) == 0
    assert f"{copy / 'replay'} is sound" in capsys.readouterr().out
    for path in (copy, *copy.rglob("*")):
        path.chmod(path.stat().st_mode | stat.S_IWUSR)
    assert {path: (copy / path).read_bytes() for path in files_of(copy)} == before
    end = str(saved(copy)[-1] + 100_000)
    with started(["resume", str(copy), "--steps", end]) as process:
        wait_until_saved(copy, process, saved(copy)[-1])
        assert main(["check", str(copy)]) == 2
    assert "is training in" in capsys.readouterr().err
