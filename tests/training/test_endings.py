"""However a run ends, what was learnt is saved: evaluations, videos and reports that fail."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import merl
import unruly_envs
from merl.cli import main
from merl.report.curves import read_metrics
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
FLAGS = [str(part) for flag in _FLAGS.items() for part in flag]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """In a folder of its own; nothing is timed or drawn, and no references are measured."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "merl.training.setup.measure", lambda *_: Timing({Arithmetic("fp32", 1): 1e-3}, 1e-3)
    )
    monkeypatch.setattr("merl.report.figures.learning_curve", lambda run, to, **_: to)
    yield
    unruly.__dict__.update(DEFAULT)
    unruly_envs.made.clear()


def train(*flags: str, which: str = "make") -> int:
    line = ["train", f"unruly_envs:{which}", *FLAGS, "--eval.no-references", "--run-dir", "run"]
    return main([*line, *flags])


def saved() -> list[int]:
    return sorted(int(path.name) for path in Path("run/checkpoints").iterdir())


def evaluated() -> list[int]:
    metrics = read_metrics("run")
    there = np.isfinite(metrics.get("eval/return", np.full(len(metrics["step"]), np.nan)))
    return metrics["step"][there].astype(int).tolist()


@pytest.mark.parametrize(
    ("act", "every", "code", "says"),
    [
        (unruly_envs.fail, 20, 4, "raised OSError: the camera is gone (unruly_envs.py, line"),
        (unruly_envs.run_out_of_memory, 1000, 4, "raised MemoryError"),
        (unruly_envs.give_nan, 1000, 3, "reward is nan at step 1 of an evaluation"),
    ],
)
def test_an_evaluation_that_fails_leaves_a_saved_run_that_can_be_resumed(
    act: Any, every: int, code: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    unruly.in_evaluation = act
    assert train("--eval.every", str(every)) == code
    step = min(every, 60)
    error = capsys.readouterr().err.strip()
    assert f"the evaluation at step {step} failed: " in error
    assert says in error
    assert f"merl resume {Path.cwd() / 'run'}`" in error
    assert len(error.splitlines()) == 1
    assert saved()[-1] == step
    # It is repeated once; one that still fails is left out, and the run comes to its end.
    assert main(["resume", "run"]) == 0
    assert "the run continues without it" in " ".join(capsys.readouterr().out.split())
    assert saved()[-1] == 60
    assert evaluated() == []
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out


def test_a_resumed_run_repeats_the_evaluation_that_failed() -> None:
    """And is what it would have been without the failure."""
    unruly.in_evaluation = unruly_envs.fail
    assert train() == 4
    unruly.in_evaluation = None
    assert main(["resume", "run"]) == 0
    assert evaluated() == [20, 40, 60]
    failed = read_metrics("run")
    Path("run").rename("failed")
    assert train() == 0
    for name, values in read_metrics("run").items():
        if not name.startswith("time/"):
            np.testing.assert_array_equal(values, failed[name], err_msg=name)


def test_a_run_whose_last_evaluation_failed_is_evaluated_when_resumed() -> None:
    unruly.in_evaluation = unruly_envs.fail
    assert train("--eval.every", "1000") == 4
    unruly.in_evaluation = None
    assert merl.load_policy("run").step == 60
    assert main(["resume", "run"]) == 0
    assert evaluated() == [60]


def test_an_evaluation_that_is_killed_again_and_again_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Killed(BaseException):
        """Nobody handles it, as SIGKILL."""

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
    said = " ".join(capsys.readouterr().out.split())
    assert "the evaluation at step 60 was begun 3 times and never finished" in said
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out


def test_an_exception_of_merls_own_in_an_evaluation_is_one_line(
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


def test_an_evaluation_without_end_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    def endless(env: Any, seen: Any) -> Any:
        env.taken = 1
        return seen

    unruly.in_evaluation = endless
    assert train("--eval.max-episode-steps", "30") == 0
    assert evaluated() == [20, 40, 60]
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("was cut after 30 steps and counts as truncated") == 1
    assert main(["evaluate", "run", "--episodes", "1"]) == 0
    assert "was cut after 30 steps" in capsys.readouterr().err
    assert main(["evaluate", "run", "--episodes", "1", "--max-episode-steps", "7"]) == 0
    assert "was cut after 7 steps" in capsys.readouterr().err


def test_references_without_end_are_cut(capsys: pytest.CaptureFixture[str]) -> None:
    unruly.length = 10**9
    flags = ["--eval.references", "--eval.max-episode-steps", "5", "--eval.every", "1000"]
    assert train(*flags) == 0
    assert "random actions" in capsys.readouterr().out


def test_a_report_that_fails_costs_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise MemoryError

    for part in ("report.figures.learning_curve", "cli.summary.floors"):
        monkeypatch.setattr(f"merl.{part}", broken)
    assert train("--eval.references") == 0
    said = capsys.readouterr().out
    assert "the curve was not drawn: MemoryError" in said
    assert "there is nothing to compare with: MemoryError" in said
    assert f"merl resume {Path.cwd() / 'run'}" in " ".join(said.split())


def test_a_video_without_a_frame_rate_has_25_frames_a_second(
    capsys: pytest.CaptureFixture[str],
) -> None:
    unruly.metadata = None
    assert train("--eval.video", "each", "--action-repeat", "2") == 0
    assert len(list(Path("run/videos").glob("*.mp4"))) == 3
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("no usable render_fps: its videos have 25 frames per second") == 1


def test_a_video_of_wrong_frames_is_dropped_with_one_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    frame = np.zeros((32, 32, 3), np.uint8)
    unruly.frame = lambda env: [frame] * 2 if env.evaluated else frame
    assert train("--eval.video", "each", "--action-repeat", "2") == 0
    assert evaluated() == [20, 40, 60]
    assert list(Path("run/videos").iterdir()) == []
    assert capsys.readouterr().out.count("there is no video of this evaluation") == 1


@pytest.mark.parametrize("how", ["numpy", "python", "own", "one object"])
def test_evaluations_do_not_change_what_training_draws(how: str) -> None:
    """And other seeds give other episodes."""

    def reseed(env: Any, seed: int | None) -> None:
        if seed is not None and how == "numpy":
            np.random.seed(seed % 2**32)  # noqa: NPY002
        if seed is not None and how == "own":
            env.rng = np.random.default_rng(seed)

    unruly.on_reset = reseed
    if how != "one object":
        unruly.draw = getattr(unruly_envs, {"own": "from_own_generator"}.get(how, f"from_{how}"))
    which = "one" if how in ("own", "one object") else "make"
    returns = {}
    for name, flags in {"often": [], "never": ["--eval.every", "0"], "1": ["--seed", "1"]}.items():
        unruly_envs.made.clear()
        assert train(*flags, which=which) == 0
        returns[name] = read_metrics("run")["train/return"].tolist()
        Path("run").rename(name)
    assert len(set(returns["often"])) == len(returns["often"])
    assert returns["often"] == returns["never"]
    assert not set(returns["often"]) & set(returns["1"])


@pytest.mark.parametrize("how", ["from_numpy", "from_python"])
def test_a_resumed_run_draws_on_from_the_global_generators(how: str) -> None:
    unruly.draw = getattr(unruly_envs, how)
    assert train() == 0
    whole = read_metrics("run")["train/return"]
    Path("run").rename("whole")
    assert train("--steps", "30", "--eval.every", "1000") == 0
    assert main(["resume", "run", "--steps", "60"]) == 0
    np.testing.assert_array_equal(read_metrics("run")["train/return"], whole)


def test_without_evaluations_the_environment_is_made_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train("--eval.every", "0", "--eval.video", "each", "--eval.references") == 0
    assert len(unruly_envs.made) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "is trained and saved, and not evaluated" in said
    assert "resume with" in said
    assert "warning" not in said
    assert evaluated() == []
    assert main(["resume", "run"]) == 0
    assert "is done" in capsys.readouterr().out
    assert main(["resume", "run", "--steps", "80"]) == 0
    assert saved()[-1] == 80
    assert main(["evaluate", "run", "--episodes", "1"]) == 0


def test_one_object_for_training_and_evaluation_is_warned_of(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert train(which="one") == 0
    assert "use the same environment object" in capsys.readouterr().err
    Path("run").rename("once")
    assert train("--eval.every", "0", which="one") == 0
    assert capsys.readouterr().err == ""


def test_an_environment_may_change_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(which="wanders") == 0
    assert Path.cwd() == Path("/")
    said = " ".join(capsys.readouterr().out.split())
    assert f"merl resume {tmp_path}/run" in said
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
def test_a_simulator_that_dies_of_the_signal_does_not_make_it_a_failure(
    number: int, error: BaseException, capsys: pytest.CaptureFixture[str]
) -> None:
    unruly.in_training = unruly_envs.interrupted(number, error)
    assert train() == 128 + number
    said = capsys.readouterr()
    assert "and saved: resume with" in said.out
    assert said.err == ""
    unruly.in_training = None
    assert main(["resume", "run"]) == 0
    assert saved()[-1] == 60


def test_a_simulator_that_dies_of_the_signal_in_an_evaluation_neither() -> None:
    unruly.in_evaluation = unruly_envs.interrupted(signal.SIGINT, RuntimeError("rpc failed"))
    assert train("--eval.episodes", "5") == 130
    unruly.in_evaluation = None
    assert main(["resume", "run"]) == 0
    assert evaluated() == [20, 40, 60]


def test_a_handler_of_the_environments_does_not_make_ctrl_c_useless(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGINT)
    unruly.in_training = unruly_envs.takes_over_signals
    assert train() == 130
    assert "and saved: resume with" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is before


def test_an_episode_without_end_is_saved_and_warned_of(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is killed once it has been saved, as by SIGKILL."""
    monkeypatch.setattr("merl.training.meters.Interval.LEAST", 0.01)
    monkeypatch.setattr("merl.training.trainer.LONG", 30)
    unruly.length = 10**9

    def killed(env: Any, seen: Any) -> Any:
        if env.taken > 40 and saved()[-1] > 30:
            raise SystemExit("killed")
        return seen

    unruly.in_training = killed
    # As if there were no time to save: what is on the disk is from before.
    monkeypatch.setattr("merl.training.trainer.EnvironmentFailed", ZeroDivisionError)
    assert train("--save-every", "0", "--eval.every", "0", "--steps", "100000") == 4
    said = " ".join(capsys.readouterr().out.split())
    assert "no episode has ended in 30 steps" in said
    unruly.in_training = None
    more = saved()[-1] + 10
    assert main(["resume", "run", "--steps", str(more)]) == 0
    assert saved()[-1] == more
    assert "stopped in an episode" in " ".join(capsys.readouterr().out.split())


def test_evaluations_that_start_otherwise_each_time_are_warned_of(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """As with statistics that are taken in `step`: two resets at the start do not show them."""

    def drift(env: Any, seen: Any) -> Any:
        env.drift = getattr(env, "drift", 0.0) + 1.0
        return seen

    unruly.in_evaluation = drift
    unruly.draw = lambda env: env.np_random.normal() + getattr(env, "drift", 0.0)
    assert train() == 0
    said = capsys.readouterr()
    assert " ".join(said.out.split()).count("do not start as those of the one before") == 1
    assert said.err == ""
