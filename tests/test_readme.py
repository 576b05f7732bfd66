"""README and tutorial: their commands work in their order after `make train`."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from merl.cli import COMMANDS, main
from merl.config import Source, TrainConfig
from merl.runs.run_folder import PRETRAINED, run_path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TUTORIAL = "".join(
    (ROOT / "docs/tutorial" / page).read_text() for page in ("first_run.md", "results.md")
)


def commands(text: str) -> list[list[str]]:
    """Return the arguments of each line `$ merl ...` in the console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [shlex.split(line, comments=True)[2:] for line in lines if line.startswith("$ merl ")]


@pytest.mark.parametrize(("text", "least"), [(README, 1), (TUTORIAL, 2)])
def test_each_command_names_a_run_of_an_earlier_command(
    text: str, least: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runs = {Path("pretrained", path.name).absolute() for path in PRETRAINED.iterdir()}

    def begin(config: TrainConfig, source: Source, what: str) -> int:
        runs.add(run_path(config, source).absolute())
        return 0

    monkeypatch.setattr("merl.cli.train.begin", begin)
    makefile = (ROOT / "Makefile").read_text()
    (make_command,) = re.findall(r"\$\(BIN\)/merl (train .*)", makefile)
    assert main(make_command.replace("$(MINUTES)", "10").split()) == 0
    named = []
    for command, *arguments in commands(text):
        assert command in COMMANDS
        if command == "train":
            assert main([command, *arguments]) == 0
        if command in ("resume", "evaluate"):
            named.append(Path(arguments[0]).absolute())
    named += [Path(run).absolute() for run in re.findall(r'load_policy\("(.*?)"\)', text)]
    assert len(named) >= least
    assert set(named) <= runs


@pytest.mark.parametrize("text", [README, TUTORIAL])
def test_torch_without_cuda_and_the_package_name_are_explained(text: str) -> None:
    assert "--index-url https://download.pytorch.org/whl/cpu" in text
    assert "merl-rl" in text
    assert "another" in text


def test_the_readme_is_short_and_its_picture_is_small() -> None:
    assert len(README.split()) <= 500
    assert (ROOT / "docs/images/trained_arm.webp").stat().st_size <= 1_500_000
