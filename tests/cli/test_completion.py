"""Tab completion of the command line, in bash itself."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from merl.cli import main

COMPLETE = """
source "$1"
shift
COMP_WORDS=("$@")
COMP_CWORD=$(($# - 1))
_tyro_merl
printf "%s\\n" "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "merl"
    with path.open("w") as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", file)
        assert main(["--tyro-print-completion", "bash"]) == 0
    return path


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["res"], ["resume"]),
        (["train", "reach_duplo", "--eval.ep"], ["--eval.episodes"]),
        (["train", "--agent.noise-c"], ["--agent.noise-correlation", "--agent.noise-clip"]),
        (["train", "--renderer", "r"], ["raster"]),
        (["evaluate", "run", "--vi"], ["--video"]),
        (["run", "policy.onnx", "--rate"], ["--rate-limit"]),
    ],
)
def test_bash_completes_commands_options_and_choices(
    script: Path, words: list[str], offered: list[str]
) -> None:
    command = ["bash", "-c", COMPLETE, "bash", script, "merl", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.split("\n")[:-1] == offered


def test_an_unknown_shell_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--tyro-print-completion", "cmd"]) == 2
    assert "needs a shell: choose from bash, zsh, fish" in capsys.readouterr().err
