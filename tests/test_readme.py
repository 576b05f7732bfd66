"""The README's commands work in their order after `make train`, and its links exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from merl.cli import COMMANDS, main
from merl.config import Source, TrainConfig
from merl.runs.run_folder import run_path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def commands() -> list[list[str]]:
    """Return the arguments of each line `$ merl ...` in the console blocks, in order."""
    blocks = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [shlex.split(line, comments=True)[2:] for line in lines if line.startswith("$ merl ")]


def test_each_command_names_a_run_of_an_earlier_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    runs: set[Path] = set()

    def begin(config: TrainConfig, source: Source, what: str) -> int:
        runs.add(run_path(config, source).absolute())
        return 0

    monkeypatch.setattr("merl.cli.train.begin", begin)
    makefile = (ROOT / "Makefile").read_text()
    (make_command,) = re.findall(r"\$\(BIN\)/merl (train .*)", makefile)
    assert main(make_command.replace("$(MINUTES)", "10").split()) == 0
    named = []
    for command, *arguments in commands():
        assert command in COMMANDS
        if command == "train" and "--help" not in arguments:
            assert main([command, *arguments]) == 0
        if command in ("resume", "evaluate"):
            named.append(Path(arguments[0]).absolute())
            assert named[-1] in runs
    assert len(named) >= 4
    loaded = re.findall(r'load_policy\("(.*?)"\)', README)
    assert loaded
    assert {Path(run).absolute() for run in loaded} <= runs


def test_readme_explains_torch_without_cuda_and_the_package_name() -> None:
    assert "--index-url https://download.pytorch.org/whl/cpu" in README
    assert "merl-rl" in README
    assert "another project" in README


def test_images_and_links_exist() -> None:
    for target in re.findall(r'(?:\]\(|src=")([^)"#]+)', README):
        assert target.startswith("https://") or (ROOT / target).exists(), target
