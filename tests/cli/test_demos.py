"""merl demos, and runs that learn from demonstrations."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from helpers import flat
from merl.cli import main
from merl.demos.demonstrations import Demonstrations
from merl.demos.recorder import Recorder
from merl.evaluation.demonstrating import record_episodes
from merl.report.film import LABEL, MARGIN, SIDE
from toy import DotEnv

TINY = ["--preset", "smoke", "--agent.keys", "proprio", "--eval.video", "none", "--threads", "1"]
TINY += ["--eval.every", "500", "--eval.episodes", "1", "--random-steps", "50"]
TINY += ["--seed-steps", "50", "--agent.precision", "fp32"]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two episodes of reach_duplo."""
    out = tmp_path_factory.mktemp("demos") / "reach"
    record = ["demos", "record", "reach_duplo", "--preset", "smoke", "--episodes", "2"]
    assert main([*record, "--out", str(out)]) == 0
    return out


def weights(run: Path) -> dict[str, torch.Tensor]:
    return load_file(sorted(run.glob("checkpoints/*"))[-1] / "weights.safetensors")


def test_recorded_episodes_are_successes_with_noise(
    demos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = Demonstrations.open(demos)
    assert [line.success for line in found.lines] == [True, True]
    assert list(found.observation_space) == ["image", "proprio", "state"]
    for episode in found.episodes():
        assert episode.observations["image"].shape == (251, 32, 32, 3)
        noise = episode.actions - episode.intended
        within = np.abs(episode.actions) < 1  # others are clipped
        assert 0.08 < noise[within].std() < 0.12
    assert main(["demos", "show", str(demos)]) == 0
    shown = flat(capsys.readouterr().out)
    assert "2 episodes of reach_duplo by expert, noise 0.1" in shown
    assert "success at the end in 2 of 2" in shown


@pytest.mark.parametrize("agent", ["merl", "sac", "bc"])
def test_a_run_learns_from_demonstrations_and_resumes_exactly(
    agent: str, demos: Path, tmp_path: Path
) -> None:
    train = ["train", "reach_duplo", "--agent", agent, *TINY, "--demos", str(demos)]
    clone = [] if agent == "bc" else ["--agent.clone-weight", "0.5", "--agent.clone-steps", "400"]
    clone += [] if agent == "bc" else ["--agent.clone-better"]
    runs = {name: tmp_path / name for name in ("whole", "halves", "without")}
    assert main([*train, *clone, "--steps", "500", "--run-dir", str(runs["whole"])]) == 0
    assert main([*train, *clone, "--steps", "250", "--run-dir", str(runs["halves"])]) == 0
    resume = [*train, *clone, "--steps", "500", "--run-dir", str(runs["halves"]), "--resume"]
    assert main(resume) == 0
    whole, halves = weights(runs["whole"]), weights(runs["halves"])
    for name, value in whole.items():
        torch.testing.assert_close(halves[name], value, rtol=0, atol=0)
    config = json.loads((runs["whole"] / "config.json").read_text())["config"]
    assert config["demos"] == str(demos)
    assert config["demos_hash"] == Demonstrations.open(demos).digest()
    assert config["demos_ratio"] == (1.0 if agent == "bc" else 0.5)
    if agent == "merl":
        other = [*train, "--steps", "500", "--run-dir", str(runs["without"])]
        assert main(other) == 0
        changed = weights(runs["without"])
        assert any(not torch.equal(changed[name], value) for name, value in whole.items())


def test_other_demonstrations_are_refused_on_resume(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy, run = tmp_path / "copy", tmp_path / "run"
    shutil.copytree(demos, copy)
    train = ["train", "reach_duplo", *TINY, "--demos", str(copy), "--run-dir", str(run)]
    assert main([*train, "--steps", "250"]) == 0
    moved = tmp_path / "moved"
    copy.rename(moved)
    assert main(["resume", str(run), "--steps", "300"]) == 2
    assert "copy holds no demonstrations" in capsys.readouterr().err
    again = ["train", "reach_duplo", *TINY, "--demos", str(moved), "--run-dir", str(run)]
    assert main([*again, "--steps", "300", "--resume"]) == 0
    file = moved / "00000.npz"
    file.write_bytes(file.read_bytes() + b" ")
    assert main([*again, "--steps", "400", "--resume"]) == 2
    error = capsys.readouterr().err
    assert "holds other demonstrations than those with which the run began" in error


def test_demonstrations_of_another_task_or_reward_are_refused(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", *TINY, "--run-dir", str(tmp_path / "run"), "--demos"]
    assert main([*train, str(demos), "move_box"]) == 2
    assert "holds demonstrations of reach_duplo, not of move_box" in capsys.readouterr().err
    index = json.loads((demos / "demos.json").read_text())
    index |= {"task": "move_box", "options": {"reward": "staged"}}
    shutil.copytree(demos, tmp_path / "demos")
    (tmp_path / "demos/demos.json").write_text(json.dumps(index))
    assert main([*train, str(tmp_path / "demos"), "move_box"]) == 2
    assert "recorded with reward staged, and the run has paper" in capsys.readouterr().err
    index["options"] = {"reward": "paper", "occluded": True}
    (tmp_path / "demos/demos.json").write_text(json.dumps(index))
    assert main([*train, str(tmp_path / "demos"), "move_box"]) == 2
    assert "recorded with occluded True, and the run has False" in capsys.readouterr().err
    assert main([*train, str(demos), "reach_duplo", "--action-repeat", "2"]) == 2
    assert "use --action-repeat 1" in capsys.readouterr().err


def test_an_environment_may_reuse_its_arrays() -> None:
    class Reusing(DotEnv):
        buffer = np.zeros(2, np.float32)

        def _observe(self) -> dict[str, np.ndarray]:
            self.buffer[:] = self.x, self.steps
            return {"joint": self.buffer}

    (episode,) = record_episodes(lambda _: np.full(1, 3.0), Reusing(), 1, failures=True)
    assert episode.intended.tolist() == episode.actions.tolist() == [[1.0]] * 10
    assert episode.observations["joint"][:, 1].tolist() == [*range(11)]


def test_a_policy_can_demonstrate(tmp_path: Path) -> None:
    record = ["demos", "record", "reach_duplo", "--from", "pretrained/reach_duplo"]
    record += ["--preset", "laptop", "--noise", "0", "--episodes", "1", "--failures"]
    assert main([*record, "--out", str(tmp_path / "out")]) == 0
    (episode,) = Demonstrations.open(tmp_path / "out").episodes()
    np.testing.assert_array_equal(episode.actions, episode.intended)
    assert episode.rewards.sum() > 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["demos", "recrod"], "merl demos 'recrod' is unknown: did you mean 'record'"),
        (["demos", "record", "reach"], "task 'reach' is unknown"),
        (["demos", "record", "reach_duplo", "--noise", "2"], "--noise must be at least 0"),
        (["demos", "show", "nowhere"], "nowhere holds no demonstrations"),
        (["train", "reach_duplo", *TINY, "--agent", "bc"], "learns from demonstrations alone"),
        (
            ["train", "reach_duplo", *TINY, "--agent.clone-weight", "1"],
            "agent.clone-weight 1.0 clones demonstrations",
        ),
        (
            ["train", "reach_duplo", *TINY, "--agent.clone-better"],
            "agent.clone-better is an option of the cloning term",
        ),
        (
            ["train", "reach_duplo", *TINY, "--demos", "nowhere"],
            "nowhere holds no demonstrations",
        ),
        (
            ["train", "reach_duplo", *TINY, "--demos-ratio", "1.5"],
            "demos-ratio must be above 0 and at most 1",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_an_exported_dataset_is_imported_and_learnt_from(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset, back = tmp_path / "dataset", tmp_path / "back"
    assert main(["demos", "export", str(demos), "--to", "lerobot", "--out", str(dataset)]) == 0
    assert "2 episodes, 500 steps" in flat(capsys.readouterr().out)
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert info["fps"] == 25  # a control step of the tasks is 0.04 s
    given = ["demos", "import", "reach_duplo", "--preset", "smoke", "--from", str(dataset)]
    assert main([*given, "--leave-out", "state", "--out", str(back)]) == 0
    shown = flat(capsys.readouterr().out)
    assert "the source compressed observation.images.image with loss" in shown
    line = f"merl train reach_duplo --preset smoke --agent.keys image proprio --demos {back}"
    assert line in shown
    assert list(Demonstrations.open(back).observation_space) == ["image", "proprio"]
    train = ["train", "reach_duplo", *TINY, "--steps", "60", "--run-dir", str(tmp_path / "run")]
    assert main([*train, "--eval.every", "0", "--demos", str(back)]) == 0
    capsys.readouterr()
    assert main([*given, "--image-size", "24", "--out", str(tmp_path / "other")]) != 0
    assert "resize its images with --resize" in flat(capsys.readouterr().err)
    assert not (tmp_path / "other").exists()
    assert main(["demos", "import", "reach_duplo", "--out", str(tmp_path / "other")]) != 0
    assert "needs the folder or file to convert: --from PATH" in flat(capsys.readouterr().err)


def test_another_environment_has_no_expert(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demos", "record", "Pendulum-v1"]) != 0
    assert "there is no expert for Pendulum-v1" in flat(capsys.readouterr().err)


def test_an_environment_of_the_working_folder(tmp_path: Path) -> None:
    env, folder = DotEnv(), tmp_path / "toy"
    recorder = Recorder(folder, "toy:DotEnv", "a test", env.observation_space, env.action_space)
    for episode in record_episodes(lambda _: np.zeros(1), env, 1, failures=True):
        recorder.add(episode)
    assert main(["demos", "export", str(folder), "--to", "robomimic"]) == 0
    (tmp_path / "my_arm.py").write_text("from toy import DotEnv\ndef make(): return DotEnv()\n")
    merl = str(Path(sys.executable).with_name("merl"))  # it does not search the working folder
    command = [merl, "demos", "import", "my_arm:make", "--from", "toy.hdf5", "--out", "out"]
    path = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(command, cwd=tmp_path, env=path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert Demonstrations.open(tmp_path / "out").steps == len(episode)


def test_a_film_strip_shows_what_the_cameras_saw(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film = tmp_path / "film.png"
    assert main(["demos", "show", str(demos), "--film", str(film)]) == 0
    assert f"frames: {film}" in flat(capsys.readouterr().out)
    strip = np.asarray(Image.open(film).convert("RGB"))
    episodes = [episode.observations["image"] for episode in Demonstrations.open(demos).episodes()]
    assert strip.shape[0] == len(episodes) * (SIDE + MARGIN)
    step = SIDE / 32  # pixels of the strip for each pixel of the camera
    for row, frames in enumerate(episodes):
        top = row * (SIDE + MARGIN)
        first = strip[top : top + SIDE, LABEL : LABEL + SIDE]
        centres = (np.arange(32) * step + step / 2).astype(int)
        np.testing.assert_array_equal(first[np.ix_(centres, centres)], frames[0])
