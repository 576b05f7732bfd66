"""The site builds without warnings; links, commands and code of the documentation are right."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

import merl
from merl.cli import main
from merl.runs.run import Run
from merl.tasks import TASKS
from merl.training.trainer import Trainer

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
FRONT = (ROOT / "README.md", ROOT / "CONTRIBUTING.md")
OWN_AGENT = "small_agent:SmallAgent"
"""The agent of docs/howto/agent.md; tests/agents/test_own_agent.py trains it and sets its flag."""
FLAG = r"--(?:agent|env|eval|replay)\.[\w-]*\w"
"""A flag of a nested config, without the key that may follow (`--agent.encoders.wrist`)."""
PAGES = (*FRONT, *sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts))


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", DOCS, tmp_path],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
    )
    assert done.returncode == 0, done.stderr
    help_page = (tmp_path / "reference/cli.html").read_text()
    assert all(flag in help_page for flag in ("--agent.noise-std", "--episodes", "--trust"))


@pytest.mark.parametrize("page", FRONT, ids=name_of)
def test_links_of_pages_outside_the_site_lead_to_files_and_headings(page: Path) -> None:
    for target, heading in re.findall(
        r'(?:\]\(|src=")(?!https://)([^)"#]*)#?([^)"]*)', page.read_text()
    ):
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not heading or heading in anchors(file), f"{target}#{heading}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_pages_that_code_names_exist() -> None:
    named = {
        (path, page)
        for folder in ("src", "tests", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
        for page in re.findall(r"\bdocs/[\w/]+(?:\.md|/)", path.read_text())
    }
    assert len(named) > 10
    assert not [(path, page) for path, page in named if not (ROOT / page).exists()]


def commands() -> Iterator[tuple[str, list[str]]]:
    """Return page and arguments of each line `merl ...` in a block of code."""
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ").replace("$seed", "0")
        for line in re.findall(r"^(?:\$ | {4}(?:srun )?)merl (\w.*)", text, re.MULTILINE):
            words = takewhile(lambda word: word != "|", shlex.split(line, comments=True))
            arguments = [word for word in words if word != "..."]
            if OWN_AGENT not in arguments:
                yield name_of(page), arguments


def test_flags_of_the_config_exist(capsys: pytest.CaptureFixture[str]) -> None:
    for agent in ("merl", "sac"):
        with pytest.raises(SystemExit):
            main(["train", "--help", "--agent", agent])
    known = {"--agent.hidden", *re.findall(FLAG, capsys.readouterr().out)}  # of `OWN_AGENT`
    named = {(name_of(page), flag) for page in PAGES for flag in re.findall(FLAG, page.read_text())}
    assert len(known) > 50
    assert not [(page, flag) for page, flag in sorted(named) if flag not in known]


class AcceptedError(Exception):
    """The command line was parsed."""


@pytest.mark.parametrize(("page", "arguments"), list(commands()))
def test_commands_are_accepted(
    page: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parse = tyro.cli

    def accept(*_: Any, **__: Any) -> None:
        raise AcceptedError

    def parse_only(*args: Any, **options: Any) -> None:
        parse(*args, **options)
        raise AcceptedError

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Trainer, "__init__", accept)
    monkeypatch.setattr(Run, "open", accept)
    if arguments[0] not in ("train", "resume", "evaluate"):
        monkeypatch.setattr(tyro, "cli", parse_only)
    if "--help" in arguments:
        assert main(arguments) == 0
        return
    with pytest.raises(AcceptedError):
        main(arguments)


def python_of(page: str) -> dict[str, Any]:
    """Run the first block of Python of a how-to page; return its names."""
    (code, *_) = re.findall(r"```python\n(.*?)```", (DOCS / "howto" / page).read_text(), re.DOTALL)
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(code, page, "exec"), names)
    return names


def test_the_task_of_the_how_to_page_works(monkeypatch: pytest.MonkeyPatch) -> None:
    task = python_of("task.md")["Hover"]
    monkeypatch.setitem(TASKS, "hover", task)
    env = merl.make_env("hover", observations=("proprio",))
    env.reset(seed=0)
    _, reward, _, _, info = env.step(np.zeros(9, np.float32))
    assert 0 <= reward <= 1
    assert info["reward_terms"] == {"reaching": pytest.approx(reward)}
    assert info["distance"] > 0
    env.close()


def test_the_robot_of_the_how_to_page_is_an_environment() -> None:
    env = python_of("environment.md")["make_env"]()
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    observation, _, _, _, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert info["success"] in (True, False)
