"""Where a result comes from."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import merl
from merl.runs.provenance import commit


def test_the_commit_is_merls_own_not_that_of_the_project_around_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.example"]
    git += ["-c", "commit.gpgsign=false"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "one"], check=True)
    command = [*git, "rev-parse", "--short=12", "HEAD"]
    head = subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    for folder, expected in (("src/merl", head), (".venv/lib/python3/site-packages/merl", None)):
        file = tmp_path / folder / "__init__.py"
        file.parent.mkdir(parents=True)
        monkeypatch.setattr(merl, "__file__", str(file))
        assert commit() == expected
