"""The trained policies that come with merl."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

import merl
from merl.cli import main
from merl.core import MerlError
from merl.runs.run_folder import PRETRAINED

NAMES = sorted(path.name for path in PRETRAINED.iterdir() if path.is_dir())
FEW = {"lift_box": 120.0, "move_box": 100.0, "reach_duplo": 150.0}
"""A return that a policy reaches in the mean of few episodes; random actions are far below."""


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_solves_its_task_and_its_card_says_how_well(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", f"pretrained/{name}", "--episodes", "4", "--json", "it.json"]) == 0
    episodes = json.loads(Path("it.json").read_text())["episodes"]
    assert sum(episode["return"] for episode in episodes) / len(episodes) > FEW[name]
    assert "success at the end" in (PRETRAINED / name / "card.md").read_text()
    assert not {*tmp_path.iterdir()} - {tmp_path / "it.json"}


def test_the_policies_are_small_and_name_no_path() -> None:
    files = [path for path in PRETRAINED.rglob("*") if path.is_file()]
    sizes = {path: path.stat().st_size for path in files}
    assert max(sizes.values()) < 3_000_000
    assert sum(sizes.values()) < 10_000_000
    for name in NAMES:
        config = json.loads((PRETRAINED / name / "config.json").read_text())
        assert config["config"]["run_dir"] is None
        assert config["module_folders"] == {}


def test_a_policy_cannot_be_resumed(capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in PRETRAINED.rglob("*")}
    assert main(["resume", "pretrained/reach_duplo", "--steps", "900000"]) == 2
    message = capsys.readouterr().err
    assert "pretrained/reach_duplo is a trained policy" in message
    assert "Traceback" not in message
    assert before == {path: path.stat().st_mtime_ns for path in PRETRAINED.rglob("*")}


def test_an_unknown_policy_is_refused_with_a_suggestion() -> None:
    with pytest.raises(MerlError, match=r"no policy 'pretrained/reach_dublo': did you mean"):
        merl.load_policy("pretrained/reach_dublo")


def test_a_folder_of_the_user_has_precedence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(PRETRAINED / "reach_duplo", tmp_path / "pretrained/mine")
    monkeypatch.chdir(tmp_path)
    assert merl.load_policy("pretrained/mine").step == 800_000
