"""Child processes do not import modules from the working folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from merl import cli
from merl.core.python_path import working_folder_hidden
from merl.core.resources import load_matplotlib
from merl.envs.user_env import load_module

VARIABLE = "PYTHONSAFEPATH"


def test_a_child_process_does_not_import_from_the_working_folder(tmp_path: Path) -> None:
    (tmp_path / "ctypes.py").write_text("open('imported', 'w')")
    for hidden in (True, False):
        if hidden:
            with working_folder_hidden():
                subprocess.run([sys.executable, "-c", "import ctypes"], cwd=tmp_path, check=True)
        else:
            subprocess.run([sys.executable, "-c", "import ctypes"], cwd=tmp_path, check=True)
        assert (tmp_path / "imported").exists() != hidden


def test_commands_run_with_the_working_folder_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    seen = []
    monkeypatch.setattr("merl.cli.tasks.tasks", lambda args: seen.append(os.environ[VARIABLE]) or 0)
    assert cli.main(["tasks"]) == 0
    assert seen == ["1"]
    assert VARIABLE not in os.environ


def test_a_users_environment_has_the_users_search_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    module = f"import os; value = os.environ.get({VARIABLE!r})"
    (tmp_path / "own_arm_of_test.py").write_text(module)
    with working_folder_hidden():
        assert load_module("own_arm_of_test:make", tmp_path).value is None


def test_matplotlib_does_not_read_the_working_folders_settings(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_text("figure.dpi: 7")
    code = "import merl.report.drawing, matplotlib; print(matplotlib.rcParams['figure.dpi'])"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert float(done.stdout) != 7
    load_matplotlib()  # no effect after Matplotlib is imported
