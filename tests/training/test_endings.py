"""Ends of a run: failing evaluations, videos and reports, and signals leave a saved run."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import merl
import unruly_envs
from merl.cli import main
from merl.report.curves import read_metrics
from merl.runs.checkpoint import Checkpoint
from merl.training.evaluator import ATTEMPTS
from merl.training.timing import Arithmetic, Timing
from unruly_envs import DEFAULT, unruly

_FLAGS = {
    "--agent": "ddpg",
    "--preset": "smoke",
    "--random-steps": 20,
    "--seed-steps": 20,
    "--updates-per-step": 0.2,
    "--replay.batch-size": 8,
    "--threads": 1,
    "--agent.precision": "fp32",
    "--agent.hidden-dim": 16,
    "--eval.every": 20,
    "--eval.episodes": 2,
    "--eval.video": "none",
    "--steps": 60,
}
FLAGS = [str(word) for flag in _FLAGS.items() for word in flag]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Run each test in a new folder, without timing and drawing."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "merl.training.setup.measure", lambda *_: Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
    )
    yield
    unruly.__dict__.update(DEFAULT)
    unruly_envs.made.clear()


def train(*flags: str, function: str = "make") -> int:
    line = ["train", f"unruly_envs:{function}", *FLAGS, "--eval.no-references", "--run-dir", "run"]
    return main([*line, *flags])


def saved() -> list[int]:
    return sorted(int(path.name) for path in Path("run/checkpoints").iterdir())


def evaluated() -> list[int]:
    metrics = read_metrics("run")
    has_return = np.isfinite(metrics.get("eval/return", np.full(len(metrics["step"]), np.nan)))
    return metrics["step"][has_return].astype(int).tolist()


@pytest.mark.parametrize(
    ("act", "every", "code", "message"),
    [
        (unruly_envs.fail, 20, 4, "raised OSError: the camera is gone (unruly_envs.py, line"),
        (unruly_envs.run_out_of_memory, 1000, 4, "raised MemoryError"),
        (unruly_envs.give_nan, 1000, 3, "reward is nan at step 1 of an evaluation"),
    ],
)
def test_a_failing_evaluation_leaves_a_saved_run_that_can_be_resumed(
    act: Any, every: int, code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    unruly.in_evaluation = act
    assert train("--eval.every", str(every)) == code
    step = min(every, 60)
    error = capsys.readouterr().err.strip()
    assert f"the evaluation at step {step} failed: " in error
    assert message in error
    assert f"merl resume {Path.cwd() / 'run'}`" in error
    assert len(error.splitlines()) == 1
    assert saved()[-1] == step
    # Resume repeats the evaluation; if it fails again, it is skipped, and the run completes.
    assert main(["resume", "run"]) == 0
    assert "the run continues without it" in " ".join(capsys.readouterr().out.split())
    assert saved()[-1] == 60
    assert evaluated() == []
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out


def test_resume_repeats_a_failed_evaluation() -> None:
    """The metrics equal those of a run without the failure."""
    unruly.in_evaluation = unruly_envs.fail
    assert train() == 4
    unruly.in_evaluation = None
    assert main(["resume", "run"]) == 0
    assert evaluated() == [20, 40, 60]
    resumed = read_metrics("run")
    Path("run").rename("resumed")
    assert train() == 0
    for name, values in read_metrics("run").items():
        if not name.startswith("time/"):
            np.testing.assert_array_equal(values, resumed[name], err_msg=name)


def test_resume_repeats_a_failed_last_evaluation() -> None:
    unruly.in_evaluation = unruly_envs.fail
    assert train("--eval.every", "1000") == 4
    unruly.in_evaluation = None
    assert merl.load_policy("run").step == 60
    assert main(["resume", "run"]) == 0
    assert evaluated() == [60]


def test_a_resumed_run_that_fails_before_its_first_step_keeps_the_scores() -> None:
    def fails(env: Any, seed: int | None) -> None:
        if seed is None:  # not in evaluations
            raise OSError("the arm is locked")

    def scores() -> dict[int, float | None]:
        found = map(Checkpoint.open, Path("run/checkpoints").iterdir())
        return {each.step: each.score for each in found}

    assert train() == 0
    before, best = scores(), Checkpoint.find(Path("run/checkpoints"), "best")
    assert before[60] is not None
    manifest = Path("run/checkpoints/00000060/manifest.json")
    written = manifest.stat().st_mtime_ns
    unruly.on_reset = fails
    assert main(["resume", "run", "--steps", "80"]) == 4
    assert scores() == before
    assert Checkpoint.find(Path("run/checkpoints"), "best") == best
    assert manifest.stat().st_mtime_ns > written


def test_an_evaluation_that_is_killed_repeatedly_is_skipped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Killed(BaseException):
        """An exception that no code handles, like SIGKILL."""

    def killed(env: Any, seen: Any) -> Any:
        raise Killed

    unruly.in_evaluation = killed
    monkeypatch.setattr("merl.envs.wrappers.failing", contextlib.nullcontext)
    with pytest.raises(Killed):
        train("--eval.every", "1000")
    for _ in range(ATTEMPTS - 1):
        with pytest.raises(Killed):
            main(["resume", "run"])
    assert main(["resume", "run"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "the evaluation at step 60 was started 3 times and never finished" in printed
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out


def test_an_exception_of_merl_in_an_evaluation_is_reported_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("merl.evaluation.evaluation.summarize", full)
    assert train() == 4
    error = capsys.readouterr().err
    assert "the evaluation at step 20 failed: OSError: [Errno 28] No space left" in error
    assert error.count("\n") == 1
    assert saved()[-1] == 20


def test_an_evaluation_episode_without_end_is_truncated(capsys: pytest.CaptureFixture[str]) -> None:
    def endless(env: Any, seen: Any) -> Any:
        env.taken = 1
        return seen

    unruly.in_evaluation = endless
    assert train("--eval.max-episode-steps", "30") == 0
    assert evaluated() == [20, 40, 60]
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("was cut after 30 steps and counts as truncated") == 1
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
    assert "was cut after 30 steps" in capsys.readouterr().err
    assert main(["evaluate", "run", "--episodes", "1", "--max-episode-steps", "7"]) == 0
    assert "was cut after 7 steps" in capsys.readouterr().err


def test_reference_episodes_without_end_are_truncated(capsys: pytest.CaptureFixture[str]) -> None:
    unruly.length = 10**9
    flags = ["--eval.references", "--eval.max-episode-steps", "5", "--eval.every", "1000"]
    assert train(*flags) == 0
    assert "random actions" in capsys.readouterr().out


def test_a_failing_report_does_not_fail_the_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise MemoryError

    for part in ("report.figures.learning_curve", "cli.summary.make_run_env"):
        monkeypatch.setattr(f"merl.{part}", broken)
    assert train("--eval.references") == 0
    printed = capsys.readouterr().out
    assert "the curve was not drawn: MemoryError" in printed
    assert "there is nothing to compare with: MemoryError" in printed
    assert f"merl resume {Path.cwd() / 'run'}" in " ".join(printed.split())


def test_a_video_without_a_frame_rate_has_25_frames_per_second(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unruly.metadata = None
    assert train("--eval.video", "each", "--action-repeat", "2") == 0
    assert len(list(Path("run/videos").glob("*.mp4"))) == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("no usable render_fps: its videos have 25 frames per second") == 1


def test_a_video_with_invalid_frames_is_dropped_with_one_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    frame = np.zeros((32, 32, 3), np.uint8)
    unruly.frame = lambda env: [frame] * 2 if env.evaluated else frame
    assert train("--eval.video", "each", "--action-repeat", "2") == 0
    assert evaluated() == [20, 40, 60]
    assert list(Path("run/videos").iterdir()) == []
    assert capsys.readouterr().out.count("there is no video of this evaluation") == 1


@pytest.mark.parametrize("source", ["numpy", "python", "own", "one object"])
def test_evaluations_do_not_change_the_random_numbers_of_training(source: str) -> None:
    """Another seed of the run gives other episodes."""

    def reseed(env: Any, seed: int | None) -> None:
        if seed is not None and source == "numpy":
            np.random.seed(seed % 2**32)  # noqa: NPY002
        if seed is not None and source == "own":
            env.rng = np.random.default_rng(seed)

    unruly.on_reset = reseed
    if source != "one object":
        name = "from_own_generator" if source == "own" else f"from_{source}"
        unruly.draw = getattr(unruly_envs, name)
    function = "one" if source in ("own", "one object") else "make"
    returns = {}
    for name, flags in {"often": [], "never": ["--eval.every", "0"], "1": ["--seed", "1"]}.items():
        unruly_envs.made.clear()
        assert train(*flags, function=function) == 0
        returns[name] = read_metrics("run")["train/return"].tolist()
        Path("run").rename(name)
    assert len(set(returns["often"])) == len(returns["often"])
    assert returns["often"] == returns["never"]
    assert not set(returns["often"]) & set(returns["1"])


@pytest.mark.parametrize("draw", ["from_numpy", "from_python"])
def test_resume_restores_the_global_generators(draw: str) -> None:
    unruly.draw = getattr(unruly_envs, draw)
    assert train() == 0
    uninterrupted = read_metrics("run")["train/return"]
    Path("run").rename("uninterrupted")
    assert train("--steps", "30", "--eval.every", "1000") == 0
    assert main(["resume", "run", "--steps", "60"]) == 0
    np.testing.assert_array_equal(read_metrics("run")["train/return"], uninterrupted)


def test_without_evaluations_the_environment_is_made_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train("--eval.every", "0", "--eval.video", "each", "--eval.references") == 0
    assert len(unruly_envs.made) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert "is trained and saved, and not evaluated" in printed
    assert "resume with" in printed
    assert "warning" not in printed
    assert evaluated() == []
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out
    assert main(["resume", "run", "--steps", "80"]) == 0
    assert saved()[-1] == 80
    assert main(["evaluate", "run", "--episodes", "1"]) == 0


def test_one_environment_object_for_training_and_evaluation_gives_a_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train(function="one") == 0
    assert "use the same environment object" in capsys.readouterr().err
    Path("run").rename("once")
    assert train("--eval.every", "0", function="one") == 0
    assert capsys.readouterr().err == ""


def test_an_environment_may_change_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(function="wanders") == 0
    assert Path.cwd() == Path("/")
    printed = " ".join(capsys.readouterr().out.split())
    assert f"merl resume {tmp_path}/run" in printed
    line = ["train", "unruly_envs:wanders", *FLAGS, "--eval.no-references"]
    for command in (
        ["resume", "run", "--steps", "80"],
        ["evaluate", "run", "--episodes", "1", "--json", "out.json", "--video", "film.mp4"],
        line,
    ):
        monkeypatch.chdir(tmp_path)
        assert main(command) == 0
    monkeypatch.chdir(tmp_path)
    assert json.loads(Path("out.json").read_text())["step"] == 80
    assert Path("film.mp4").is_file()
    assert saved()[-1] == 80
    assert Path("runs/unruly_envs-wanders-ddpg-smoke-s0/checkpoints").is_dir()
    policy = merl.load_policy("run")
    os.chdir("/")
    policy.make_env().close()


@pytest.mark.parametrize(
    ("number", "error"),
    [
        (signal.SIGINT, KeyboardInterrupt()),
        (signal.SIGINT, RuntimeError("rpc failed")),
        (signal.SIGTERM, SystemExit(1)),
    ],
)
def test_an_exception_caused_by_a_signal_counts_as_a_stop(
    number: int, error: BaseException, capsys: pytest.CaptureFixture[str]
) -> None:
    unruly.in_training = unruly_envs.interrupted(number, error)
    assert train() == 128 + number
    printed = capsys.readouterr()
    assert "and saved: resume with" in printed.out
    assert printed.err == ""
    unruly.in_training = None
    assert main(["resume", "run"]) == 0
    assert saved()[-1] == 60


def test_an_exception_caused_by_a_signal_in_an_evaluation_counts_as_a_stop() -> None:
    unruly.in_evaluation = unruly_envs.interrupted(signal.SIGINT, RuntimeError("rpc failed"))
    assert train("--eval.episodes", "5") == 130
    unruly.in_evaluation = None
    assert main(["resume", "run"]) == 0
    assert evaluated() == [20, 40, 60]


def test_ctrl_c_stops_the_run_despite_a_handler_of_the_environment(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGINT)
    unruly.in_training = unruly_envs.takes_over_signals
    assert train() == 130
    assert "and saved: resume with" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is before


def test_an_episode_without_end_is_saved_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run is interrupted after a save within the episode, and resumes from it."""
    monkeypatch.setattr("merl.training.meters.Interval.LEAST", 0.01)
    monkeypatch.setattr("merl.training.meters.LONG", 30)
    unruly.length = 10**9

    def killed(env: Any, seen: Any) -> Any:
        if env.taken > 40 and saved()[-1] > 30:
            raise SystemExit("killed")
        return seen

    unruly.in_training = killed
    assert train("--save-every", "0", "--eval.every", "0", "--steps", "100000") == 4
    printed = " ".join(capsys.readouterr().out.split())
    assert "no episode has ended in 30 steps" in printed
    unruly.in_training = None
    more = saved()[-1] + 10
    assert main(["resume", "run", "--steps", str(more)]) == 0
    assert saved()[-1] == more
    assert "stopped within an episode" in " ".join(capsys.readouterr().out.split())


def test_evaluations_with_different_start_observations_give_a_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """State that changes in `step`, e.g. running statistics, is not detected by resets alone."""

    def drift(env: Any, seen: Any) -> Any:
        env.drift = getattr(env, "drift", 0.0) + 1.0
        return seen

    unruly.in_evaluation = drift
    unruly.draw = lambda env: env.np_random.normal() + getattr(env, "drift", 0.0)
    assert train() == 0
    printed = capsys.readouterr()
    assert " ".join(printed.out.split()).count("start differently from those of the previous") == 1
    assert printed.err == ""


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("unclosable", r"close\(\) of the environment did not .*/run is trained and saved\n"),
        ("starts_a_thread", "ended without waiting for thread camera.*\n"),
    ],
)
def test_what_hangs_at_the_end_does_not_keep_the_process_alive(function: str, message: str) -> None:
    program = (
        "import sys; from merl.core import watching; watching.END_SECONDS = 0.3\n"
        "from merl.cli import main; sys.exit(main())"
    )
    line = ["train", f"unruly_envs:{function}", *FLAGS, "--eval.no-references", "--run-dir", "run"]
    done = subprocess.run(
        [sys.executable, "-c", program, *line],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        check=False,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(f"merl: warning: {message}", done.stderr)
    assert saved()[-1] == 60
