"""The command line end to end, mostly with preset `smoke`."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import hashlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from matplotlib.image import imread
from rich.console import Console

import merl
from helpers import flat, wait_for
from merl.cli import main
from merl.envs.registration import ENV_IDS
from merl.evaluation.evaluation import EVALUATION_SEED
from merl.report.figures import learning_curve

MERL = [sys.executable, "-m", "merl.cli"]
SMALL_VIDEO = ["--render-size", "64"]
"""Flags for use with `small_videos()`; rendering an episode at full size takes half a minute."""


@contextlib.contextmanager
def small_videos() -> Iterator[None]:
    """Allow rendering below the minimum size of a video; the video enlarges the frames."""
    with pytest.MonkeyPatch.context() as patch:
        for module in ("merl.training.setup", "merl.evaluation.policy"):
            patch.setattr(f"{module}.MIN_SIDE", 16)
        yield


def folder_name() -> str:
    """Return a name that needs quotes, in characters that this locale supports."""
    name = "a run, [größer]"
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return "a run, [larger]"
    return name


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train a whole `smoke` run once; return its folder."""
    folder = tmp_path_factory.mktemp("runs") / folder_name()
    arguments = ["train", "reach_duplo", "--preset", "smoke", "--run-dir", str(folder)]
    arguments += ["--log", "tensorboard"]
    out, err = io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        small_videos(),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr("merl.report.figures.learning_curve", learning_curve)
        assert main([*arguments, "--threads", "1", *SMALL_VIDEO]) == 0
    shown = flat(out.getvalue())
    assert shown.startswith("preset smoke (as requested")
    for text in ("take about", "MB for 1,000 steps", "random actions", "best known", "too early"):
        assert text in shown
    assert f"merl resume '{folder}' --steps" in out.getvalue()
    assert f"learning curve: {folder}/curve.png" in out.getvalue()
    assert "Traceback" not in err.getvalue()
    return folder


def rows(run: Path) -> list[dict[str, str]]:
    with (run / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_run_writes_the_documented_files(run: Path) -> None:
    record = json.loads((run / "config.json").read_text())
    assert record["config"]["env"]["renderer"] == "raster"
    assert record["config"]["agent"]["precision"] in ("fp32", "bf16")
    assert record["versions"]["mujoco"] == "3.17.0"
    assert (record["task"], record["preset"], record["seed"]) == ("reach_duplo", "smoke", 0)
    assert (run / "curve.png").stat().st_size > 10_000
    assert list((run / "tensorboard").iterdir())
    assert [path.name for path in sorted((run / "checkpoints").iterdir())] == [
        "00000500",
        "00001000",
    ]


def test_metrics_have_a_row_for_every_episode_and_evaluation(run: Path) -> None:
    table = rows(run)
    assert [int(row["step"]) for row in table] == [250, 500, 750, 1000]
    assert [row["eval/return"] != "" for row in table] == [False, True, False, True]
    assert all(row["train/return"] != "" for row in table)
    assert table[-1]["learn/critic_loss"] != ""
    for name in ("eval/success_end", "eval/success_any", "eval/reward/reaching", "eval/return_low"):
        assert table[-1][name] != ""


def test_the_video_shows_a_whole_episode_with_motion(run: Path) -> None:
    (path,) = (run / "videos").glob("*.mp4")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate == 25
    assert len(frames) == 250
    assert min(frames[0].shape[:2]) >= 480
    assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).mean() > 0.5


def test_evaluate_equals_a_loop_with_load_policy(run: Path, tmp_path: Path) -> None:
    output, video = tmp_path / "out.json", tmp_path / "film.mp4"
    arguments = ["evaluate", str(run), "--episodes", "2", "--json", str(output)]
    with small_videos():
        assert main([*arguments, "--video", str(video)]) == 0
    assert video.stat().st_size > 1000
    evaluation = json.loads(output.read_text())
    assert evaluation["step"] == 1000

    policy = merl.load_policy(run)
    env = merl.make_env("reach_duplo", renderer="raster", image_size=32)
    for index, episode in enumerate(evaluation["episodes"]):
        assert episode["seed"] == EVALUATION_SEED + index
        observation, _ = env.reset(seed=episode["seed"])
        policy.reset()
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, _ = env.step(policy(observation))
            total, over = total + float(reward), terminated or truncated
        assert total == episode["return"]
    env.close()


def test_shorter_episodes_are_not_compared_with_whole_ones(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["evaluate", str(run), "--episodes", "1", "--max-episode-steps"]
    shown = []
    for limit in ("20", "250"):
        assert main([*command, limit]) == 0
        shown.append(capsys.readouterr().out)
    assert ["scripted expert" in each for each in shown] == [False, True]


def test_evaluating_a_hostile_folder_imports_nothing_from_it(run: Path, tmp_path: Path) -> None:
    """Evaluate one of merl's own tasks in the run's folder, which is also its module folder."""
    folder = tmp_path / "hostile"
    shutil.copytree(run, folder)
    record = json.loads((folder / "config.json").read_text())
    del record["checksum"]
    record["module_folders"] = {"reach_duplo": str(folder)}
    (folder / "config.json").write_text(json.dumps(record))
    for name in ("dm_control", "mujoco", "warp", "torch", "av", "rich", "sitecustomize"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("open('imported', 'w')")
    command = [*MERL, "evaluate", ".", "--episodes", "1"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert not (folder / "imported").exists()


def test_a_policy_rejects_incomplete_observations(run: Path) -> None:
    policy = merl.load_policy(run)
    with pytest.raises(merl.core.MerlError, match="lacks 'proprio'"):
        policy({"image": np.zeros((32, 32, 3), np.uint8)})
    with pytest.raises(merl.core.MerlError, match=r"shape \(48, 48, 3\)"):
        policy({"image": np.zeros((48, 48, 3), np.uint8), "proprio": np.zeros(24, np.float32)})


def test_evaluating_with_the_other_renderer_warns(
    run: Path, caplog: pytest.LogCaptureFixture
) -> None:
    policy = merl.load_policy(run)
    with _tolerating_missing_gl():
        policy.make_env(renderer="gl", observations=("proprio",)).close()
    assert "trained with renderer 'raster'" in caplog.text


def test_evaluating_with_gl_uses_one_sample(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, made = merl.load_policy(run), list[dict[str, object]]()
    env_config = dataclasses.replace(policy.config.env, samples=2)
    policy.config = dataclasses.replace(policy.config, env=env_config)
    monkeypatch.setattr(
        "merl.evaluation.policy.make_run_env", lambda config, _, **changes: made.append(changes)
    )
    policy.make_env(renderer="gl")
    policy.make_env(renderer="raster")
    assert made == [{"renderer": "gl", "samples": 1}, {"renderer": "raster"}]


def _tolerating_missing_gl():  # type: ignore[no-untyped-def]
    """Ignore that making the environment fails after the warning, where OpenGL is missing."""
    return contextlib.suppress(merl.core.MerlError)


def test_a_finished_run_is_not_trained_again(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "metrics.csv").read_bytes()
    assert main(["resume", str(run)]) == 0
    assert "is done: 1,000 of 1,000 steps" in capsys.readouterr().out
    assert (run / "metrics.csv").read_bytes() == before


def train_arguments(folder: Path, *more: str, task: str = "reach_duplo") -> list[str]:
    short = ["--eval.episodes", "1", "--eval.video", "none", "--threads", "1"]
    where = ["--preset", "smoke", "--run-dir", str(folder), "--agent.precision", "fp32"]
    return ["train", task, *where, *short, *more]


def train_the_dot(folder: Path, *more: str) -> list[str]:
    """Return arguments for an environment with fast steps and episodes of 20 steps."""
    short = ["--random-steps", "20", "--seed-steps", "40", "--eval.no-references"]
    return train_arguments(folder, *short, *more, task="merl.envs.dot:whole")


def last_saved(run: Path) -> int:
    """Return the step of the last checkpoint; 0 without one."""
    folder = run / "checkpoints"
    names = [path.name for path in folder.iterdir()] if folder.is_dir() else []
    return max((int(name) for name in names if name.isdigit()), default=0)


def weights(run: Path) -> dict[str, torch.Tensor]:
    from safetensors.torch import load_file

    last = max(path for path in (run / "checkpoints").iterdir() if path.name.isdigit())
    return load_file(last / "weights.safetensors")


def assert_same(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_resume_at_an_episode_end_is_bit_exact(tmp_path: Path) -> None:
    """An uninterrupted and a resumed run have the same weights and the same metrics."""
    every = ["--eval.every", "250", "--random-steps", "100", "--seed-steps", "150"]
    assert main(train_arguments(tmp_path / "whole", *every, "--steps", "500")) == 0
    assert main(train_arguments(tmp_path / "parts", *every, "--steps", "250")) == 0
    assert main(["resume", str(tmp_path / "parts"), "--steps", "500"]) == 0
    assert_same(tmp_path / "whole", tmp_path / "parts")
    timeless = [
        [{k: v for k, v in row.items() if not k.startswith("time/")} for row in rows(tmp_path / n)]
        for n in ("whole", "parts")
    ]
    assert timeless[0] == timeless[1]


def test_same_seed_same_weights(tmp_path: Path) -> None:
    few = ["--random-steps", "100", "--seed-steps", "150", "--steps", "250"]
    for name in ("one", "two"):
        assert main(train_arguments(tmp_path / name, *few)) == 0
    assert_same(tmp_path / "one", tmp_path / "two")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_saves_and_prints_how_to_resume(tmp_path: Path, number: int, code: int) -> None:
    folder = tmp_path / "run"
    command = [*MERL, *train_the_dot(folder, "--steps", "2000000")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        wait_for(lambda: (folder / "metrics.csv").exists() and len(rows(folder)) >= 4, process)
        process.send_signal(number)
        out, err = process.communicate()
    finally:
        process.kill()
    assert process.returncode == code, err
    assert "Traceback" not in err
    assert f"merl resume {folder}" in out
    saved = last_saved(folder)
    assert saved >= 80
    assert main(["resume", str(folder), "--steps", str(saved + 50)]) == 0
    steps = [int(row["step"]) for row in rows(folder)]
    assert steps == sorted(set(steps))
    assert steps[-1] == saved + 50


def test_only_one_process_may_train_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    command = [*MERL, *train_the_dot(folder, "--steps", "2000000", "--eval.every", "100")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: last_saved(folder) > 0, process)
        assert main(["resume", str(folder)]) == 2
        assert f"process {process.pid} is training in" in capsys.readouterr().err
    finally:
        process.kill()
        process.wait()
    last = last_saved(folder)
    assert main(["resume", str(folder), "--steps", str(last + 20)]) == 0
    record = json.loads((folder / "config.json").read_text())
    assert record["config"]["steps"] == last + 20
    assert [part["step"] for part in record["resumed"]] == [last]
    assert main(["resume", str(folder)]) == 0
    assert "is done" in capsys.readouterr().out

    before = (folder / "config.json").read_bytes()
    assert main(["resume", str(folder), "--steps", "33"]) == 2
    assert "--steps 33 is less than" in capsys.readouterr().err
    shutil.rmtree(folder / "replay")
    assert main(["resume", str(folder), "--steps", "3000000"]) == 2
    assert "replay is gone" in capsys.readouterr().err
    assert (folder / "config.json").read_bytes() == before
    assert not (folder / "replay").exists()


def test_minutes_limit_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = train_the_dot(tmp_path / "run", "--steps", "2000000", "--minutes", "0.02")
    assert main(arguments) == 0
    shown = flat(capsys.readouterr().out)
    assert "2,000,000 steps of merl.envs.dot:whole on cpu in at most 0.02 minutes" in shown
    assert f"resume {tmp_path / 'run'}" in shown
    row = rows(tmp_path / "run")[-1]
    assert row["eval/return"] != ""
    assert int(row["step"]) < 2_000_000


def test_commands_and_paths_are_not_wrapped_on_a_narrow_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=60, markup=False)
    monkeypatch.setattr("merl.cli.running.make_console", lambda: console)
    folder = tmp_path / "a folder with a name that is longer than a narrow terminal" / "run"
    folder.parent.mkdir()
    assert main(train_the_dot(folder, "--steps", "60")) == 0
    assert isinstance(console.file, io.StringIO)
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", console.file.getvalue())
    assert f"merl resume '{folder}' --steps 120" in shown
    assert f"learning curve: {folder}/curve.png" in shown
    outlook = shown[shown.index("preset smoke") : shown.index("the replay takes")]
    assert all(len(line) <= 60 for line in outlook.splitlines())
    assert flat(outlook).startswith("preset smoke (as requested; the whole pipeline in under")


def test_a_run_without_updates_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(train_the_dot(tmp_path / "run", "--steps", "40")) == 0
    assert "nothing will be learnt" in flat(capsys.readouterr().out)


def test_an_unused_observation_is_not_computed(tmp_path: Path) -> None:
    arguments = train_arguments(tmp_path / "run", "--steps", "300", "--agent.keys", "proprio")
    assert main(arguments) == 0
    record = json.loads((tmp_path / "run" / "config.json").read_text())
    assert list(record["observation_space"]) == ["proprio"]


BAD = {
    "evaluate some-run --video films/a.gif": "films/a.mp4",
    "train": "missing from merl train: TASK",
    "train reach_dulpo": "did you mean 'reach_duplo'",
    "train reach_duplo --stepz 4": "unrecognized options: --stepz: did you mean '--steps'",
    "train --stepz 4 reach_duplo": "unrecognized options: --stepz",
    "resume --stepz 4 somewhere": "unrecognized options: --stepz",
    "train reach_duplo --preset lptop": "did you mean 'laptop'",
    "train reach_duplo --preset=": "preset '' is unknown",
    "train reach_duplo --steps 0": "steps must be at least 1",
    "train reach_duplo --steps -5": ", not -5",
    "train reach_duplo --steps five": "--steps takes INT: invalid literal",
    "train reach_duplo --steps": "--steps needs a value",
    "train reach_duplo --threads few": "--threads takes {None}|INT: invalid literal for int()",
    "train reach_duplo --preset": "--preset needs a value",
    "train reach_duplo --agent sac --agent.temprature 1": "did you mean '--agent.temperature'",
    "train reach_duplo twice": "unrecognized options: twice: merl train --help lists all options",
    "train Pendulum-v1 --preset smoke --image-size 40": "--image-size is for merl's own tasks: ",
    "train reach_duplo --env.image-layout chw": "--env.image-layout is for your own environment",
    "bench": "missing from merl bench: update|env|replay|train",
    "bench env --repeats 0": "--repeats must be at least 1, not 0",
    "train reach_duplo --steps 100 --replay.batch-size 101": "batch-size 101 is more than the 100",
    "train reach_duplo --replay.capacity 8 --replay.batch-size 16": "batch",
    "train reach_duplo --steps 10000000000000000000000": "at most 1,000,000,000,000",
    "train reach_duplo --occluded": "reach_duplo has no occluded form: choose from move_box",
    "train reach_duplo --replay.n-step 0": "n-step must be at least 1 and at most 1,000, not 0",
    "train reach_duplo --replay.n-step 100000000000": "at most 1,000, not 100000000000",
    "train reach_duplo --replay.frame-stack 100000": (
        "frame-stack must be at least 1 and at most 100, not 100000"
    ),
    "train reach_duplo --replay.batch-size 1000000 --steps 1000000": "1000000 would take",
    "train reach_duplo --agent.hidden-dim 60000": "networks of agent.* would take",
    "train reach_duplo --agent.hidden-dim 100000000": "hidden-dim must be at least 1 and at most",
    "train reach_duplo --agent.shift-pad 32": "pixels: use at most 31",
    "train reach_duplo --threads 1000000": "but this machine has",
    "train reach_duplo --render-size 100000": (
        "render-size must be at least 16 and at most 2,048, not 100000"
    ),
    f"train reach_duplo --run-dir {'a' * 300}": "cannot be used: File name too long",
    "train reach_duplo --agent ddpg --agent.fusion shared": "which agent.latent-dim 0 disables",
    "train reach_duplo --agent.latent-dim 0 --agent.no-fusion-norm": "norm False is an option of",
    "train reach_duplo --agent.tau 0": "above 0 and at most 1, not 0.0",
    "train reach_duplo --agent.tau 1.01": "above 0 and at most 1, not 1.01",
    "train reach_duplo --agent.tau nan": "finite and above 0 and at most 1, not nan",
    "train reach_duplo --agent.latent-dim 3": "leaves 1 for each of 2 modalities",
    "train reach_duplo --observations state": "--agent.keys state",
    "train reach_duplo --updates-per-step inf": "must be finite and at least 0, not inf",
    "train reach_duplo --num-envs 0": "num-envs must be at least 1 and at most 1,024, not 0",
    "train reach_duplo --agent.keys joints": "the observation has ['depth', 'image', 'proprio'",
    "train reach_duplo --image-size 8": "16",
    "train reach_duplo --renderer wrap": "choose from gl, raster",
    "train reach_duplo --renderer raster --samples 5": (
        "samples must be at least 1 and at most 4, not 5"
    ),
    "train reach_duplo --renderer gl --samples 2": "use renderer raster, or samples 1",
    "train reach_duplo --start around": "reach_duplo has no start 'around', only 'above'",
    "train move_box --preset smoke --start around --occluded": "occluded needs --start above",
    "train reach_duplo --reward staged": "only 'paper'",
    "train move_box --preset smoke --reward near": "choose from paper, staged",
    "train reach_duplo --minutes 0": "minutes must be above 0",
    "trian reach_duplo": "did you mean 'train'",
    "evaluate nowhere": "is not a run",
    "resume nowhere": "is not a run",
    "bench enw": "did you mean 'env'",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_line_and_writes_nothing(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    smoke = [] if "--preset" in line or not line.startswith("train r") else ["--preset", "smoke"]
    assert main([*line.split(), *smoke]) == 2
    error = capsys.readouterr().err
    assert error.startswith("merl: error: ")
    assert error.count("\n") == 1
    assert BAD[line] in error
    assert list(tmp_path.iterdir()) == []


UNWRITABLE = {
    "nowhere/figures.json": "No such file or directory",
    ".": "Is a directory",
    "a" * 300: "File name too long",
}


@pytest.mark.parametrize("name", UNWRITABLE)
@pytest.mark.parametrize("command", ["bench update", "evaluate nothing"])
def test_an_unwritable_output_file_is_reported_before_the_work(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("merl.cli.bench.BENCHES", {"update": ()})  # calling a bench would fail
    assert main([*command.split(), "--json", name]) == 2
    error = capsys.readouterr().err
    assert f"merl: error: {name} cannot be written: {UNWRITABLE[name]}: " in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_failed_command_does_not_change_its_output_file(tmp_path: Path) -> None:
    numbers, link = tmp_path / "numbers.json", tmp_path / "link.json"
    numbers.write_text("of another run")
    link.symlink_to(tmp_path / "elsewhere")
    for path in (numbers, link, tmp_path / "new.json"):
        assert main(["evaluate", str(tmp_path / "none"), "--json", str(path)]) == 2
    assert numbers.read_text() == "of another run"
    assert link.is_symlink()
    assert not (tmp_path / "new.json").exists()


def test_none_is_not_offered_as_a_choice(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "nowhere", "--renderer", "wrap"]) == 2
    error = capsys.readouterr().err
    assert "choose from gl, raster\n" in error
    assert "None" not in error


def test_a_run_continues_if_compiling_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no compiler\n  at all")

    monkeypatch.setattr(torch, "compile", fail)
    monkeypatch.setattr("merl.training.timing.worth_compiling", lambda *_: True)  # as on a GPU
    assert main(train_the_dot(tmp_path / "run", "--steps", "60")) == 0
    printed = capsys.readouterr()
    assert "updates are not compiled because compiling fails: no compiler" in flat(printed.out)
    assert "Traceback" not in printed.err


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_device_cuda_without_cuda_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["train", "reach_duplo", "--preset", "smoke", "--device", "cuda"]) == 2
    error = capsys.readouterr().err
    assert "no CUDA device was found" in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").write_text("precious")
    assert main(["train", "reach_duplo", "--preset", "smoke", "--run-dir", str(tmp_path)]) == 2
    assert "already exists" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("opengl", [{"MUJOCO_GL": "disabled"}, {"MUJOCO_GL": "glfw"}])
def test_gl_without_opengl_suggests_raster(tmp_path: Path, opengl: dict[str, str]) -> None:
    arguments = ["train", "reach_duplo", "--preset", "smoke", "--renderer", "gl"]
    done = subprocess.run(
        [*MERL, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env=os.environ | opengl | {"DISPLAY": ":77"},  # a display that does not exist
        timeout=600,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "--renderer raster" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_training_works_with_opengl_disabled(tmp_path: Path) -> None:
    arguments = train_arguments(tmp_path / "run", "--steps", "260", "--seed-steps", "240")
    done = subprocess.run(
        [*MERL, *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"MUJOCO_GL": "disabled"},
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_tasks_are_listed_with_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks", "--pictures", str(tmp_path / "pictures")]) == 0
    printed = capsys.readouterr().out
    for task, env_id in ENV_IDS.items():
        assert f"\n    merl train {task} --preset laptop\n" in printed
        make = f"import gymnasium; env = gymnasium.make('merl:{env_id}')"
        assert f"\n    {make}\n" in printed
        made: dict[str, Any] = {}
        exec(make, made)
        made["env"].close()
        assert imread(tmp_path / "pictures" / f"{task}.png").shape == (480, 480, 3)
    assert "reaching + vertical + floating + lifting" in printed
    lines = [line.strip() for line in printed.splitlines()]
    assert "merl train move_box --preset laptop --occluded" in lines
    (tmp_path / "file").write_text("in the way")
    assert main(["tasks", "--pictures", str(tmp_path / "file")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_training_from_the_state_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Preset state on a box task, shortened: no image but the video's, and all reward terms."""
    sizes = ["--steps", "250", "--random-steps", "100", "--seed-steps", "230"]
    folder = tmp_path / "run"
    arguments = ["train", "lift_box", "--preset", "state", *sizes, "--eval.episodes", "1"]
    with small_videos():
        assert main([*arguments, "--occluded", "--run-dir", str(folder), *SMALL_VIDEO]) == 0
    assert "no motion" in capsys.readouterr().out
    record = json.loads((folder / "config.json").read_text())
    assert list(record["observation_space"]) == ["state"]
    assert record["config"]["env"]["occluded"] is True
    last = rows(folder)[-1]
    terms = ("reaching", "vertical", "floating", "lifting")
    assert sum(float(last[f"eval/reward/{term}"]) for term in terms) == pytest.approx(
        float(last["eval/return"])
    )
    assert 0 <= float(last["eval/success_share"]) <= 1
    assert list((folder / "videos").iterdir())


def test_a_closed_output_pipe_is_not_an_error() -> None:
    process = subprocess.Popen(
        [*MERL, "train", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    process.stdout.close()
    process.stdout = None
    _, error = process.communicate(timeout=600)
    assert "Traceback" not in error
    assert process.returncode == 141


def test_ctrl_c_before_training_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("merl.training.setup.measure", stop)
    assert main(["train", "reach_duplo", "--preset", "smoke"]) == 130
    assert "nothing was written" in flat(capsys.readouterr().out)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda record: record.update(observation_space=[]), "cannot be read"),
        (lambda record: record["config"].update(env=None), "env is None"),
        (
            lambda record: record["config"]["agent"].update(latent_dim=128.0),
            "latent-dim must be a whole number, not 128.0",
        ),
        (
            lambda record: record["config"]["agent"].update(tau=5),
            "tau must be above 0 and at most 1",
        ),
        (
            lambda record: record["config"]["agent"].update(conv_strides=[2, "1"]),
            "strides must be a whole number, not '1'",
        ),
        (
            lambda record: record["config"].update(seed=True),
            "seed must be a whole number, not True",
        ),
        (lambda record: record["config"]["env"].update(goal="near"), "goal is unknown to this"),
        (
            lambda record: record["config"]["env"].update(renderer="warp"),
            "renderer 'warp' is unknown: choose from gl, raster",
        ),
        (lambda record: record.pop("machine"), "it has no 'machine'"),
        (lambda record: record.update(resumed=3), "cannot be read"),
        (lambda record: record.update(format=99), "it has format 99"),
    ],
)
def test_a_damaged_config_is_reported_in_one_line(  # type: ignore[no-untyped-def]
    run: Path, tmp_path: Path, damage, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    record = json.loads((run / "config.json").read_text())
    del record["checksum"]
    damage(record)
    (tmp_path / "run" / "config.json").write_text(json.dumps(record))
    for command in ("evaluate", "resume"):
        assert main([command, str(tmp_path / "run")]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "config.json cannot be read: " in error
        assert message in error


@pytest.mark.parametrize("traceback", ["", "1"])
def test_an_error_of_the_disk_that_no_code_expects_is_one_line(
    traceback: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: list[str]) -> int:
        raise OSError(116, "Stale file handle", "/data/file")

    monkeypatch.setattr("merl.cli.tasks.tasks", fail)
    monkeypatch.setenv("MERL_TRACEBACK", traceback)
    assert main(["tasks"]) == 2
    *others, last = capsys.readouterr().err.splitlines()
    assert last == "merl: error: /data/file: Stale file handle"
    assert bool(others) == bool(traceback)


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert main(["--version"]) == 0
    shown = capsys.readouterr().out
    assert "evaluate" in shown
    assert merl.__version__ in shown
    with pytest.raises(SystemExit) as stop:
        main(["train", "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert "--agent.tau" in shown
    assert "Wrong" not in shown


@pytest.mark.parametrize(
    "state",
    [{}, {"progress": 3}, {"progress": {"evaluated": 1}, "replay": {"open": False}}],
    ids=["empty", "progress is a number", "incomplete"],
)
def test_an_incomplete_state_is_reported_in_one_line(
    run: Path, tmp_path: Path, state: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    for checkpoint in (copy / "checkpoints").iterdir():
        file, manifest = checkpoint / "state.json", checkpoint / "manifest.json"
        file.write_text(json.dumps(state))
        content = json.loads(manifest.read_text())
        del content["checksum"]
        content["files"]["state.json"] = {
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
        manifest.write_text(json.dumps(content))
    capsys.readouterr()
    assert main(["resume", str(copy), "--steps", "2000"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "cannot be loaded" in error
