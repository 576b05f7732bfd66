"""The wheel works alone, and `install.sh` shows its progress."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def call(*command: str | Path, cwd: Path, **variables: str) -> str:
    """Call a program without the source in PYTHONPATH; return its output."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | variables
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    flags = ["--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder]
    call(sys.executable, "-m", "pip", "wheel", *flags, ROOT, cwd=folder, PYTHONPATH=build_path())
    (path,) = folder.iterdir()
    return path


def build_path() -> str:
    """Return the folder of hatchling, which may be outside this environment."""
    import hatchling

    return str(Path(hatchling.__path__[0]).parent)


def test_the_wheel_has_all_files_of_the_package_and_its_metadata(wheel: Path) -> None:
    assert wheel.name.startswith("merl_rl-")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        (metadata,) = (name for name in names if name.endswith("dist-info/METADATA"))
        lines = archive.read(metadata).decode().splitlines()
    files = (path.relative_to(ROOT / "src") for path in (ROOT / "src/merl").rglob("*"))
    of_the_package = {
        path.as_posix() for path in files if path.suffix in (".py", ".json", ".typed")
    }
    assert {"merl/py.typed", "merl/report/references.json"} < of_the_package <= names
    assert "merl/bench/merl_minimal.py" in names  # the reference of `merl bench update`
    for line in (
        "Name: merl-rl",
        "License-Expression: MIT",
        "Requires-Python: <3.13,>=3.11",
        "Description-Content-Type: text/markdown",
        "Classifier: Programming Language :: Python :: 3.12",
    ):
        assert line in lines
    described = "\n".join(lines[lines.index("") :])
    assert "another project" in described
    assert "![" not in described  # a package index does not show images and files of the repository
    assert "](docs" not in described


PROBE = """
from importlib.metadata import version
import merl
from merl.bench.update import load_example
from merl.report.references import references
load_example().MERL
print(merl.__file__, merl.__version__, version("merl-rl"), len(references("lift_box")))
"""


def test_the_wheel_works_in_an_environment_without_the_source(wheel: Path, tmp_path: Path) -> None:
    """The environment is new and has access only to the installed requirements."""
    call(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv", cwd=tmp_path)
    python = tmp_path / "venv/bin/python"
    pip = [sys.executable, "-m", "pip", "--python", python]
    call(*pip, "install", "--quiet", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    (packages,) = tmp_path.glob("venv/lib/python*/site-packages")
    # Python ignores `.pth` files in the folder that this file adds, so the source stays hidden.
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib"))

    file, version, recorded, measured = call(python, "-c", PROBE, cwd=tmp_path).split()
    assert Path(file).is_relative_to(packages.resolve())
    assert version == recorded
    assert int(measured) >= 3
    merl = tmp_path / "venv/bin/merl"
    assert "usage: merl COMMAND" in call(merl, "--help", cwd=tmp_path)
    tasks = call(merl, "tasks", cwd=tmp_path)
    assert all(f"merl train {task}" in tasks for task in ("reach_duplo", "move_box", "lift_box"))


PIP = """#!/bin/bash
echo "Collecting torch==2.13.0"
echo "  Downloading torch-2.13.0-cp311-cp311-manylinux_2_28_x86_64.whl.metadata (6.6 kB)"
echo "Downloading torch-2.13.0%2Bcpu-cp311-cp311-manylinux_2_28_x86_64.whl (190.5 MB)"
echo "Using cached six-1.17.0-py2.py3-none-any.whl (11 kB)"
echo "Installing collected packages: torch, six, merl-rl"
sleep 0.5
echo "Successfully installed merl-rl-0.1.0 six-1.17.0 torch-2.13.0+cpu"
echo "$@" > arguments
exit EXIT
"""


@pytest.mark.parametrize("code", [0, 1])
def test_install_shows_large_downloads_and_progress(code: int, tmp_path: Path) -> None:
    pip = tmp_path / "pip"
    pip.write_text(PIP.replace("EXIT", str(code)))
    pip.chmod(0o755)
    done = subprocess.run(
        ["bash", ROOT / "install.sh", pip, "--editable", ".[dev]"],
        cwd=tmp_path,
        env=os.environ | {"INSTALL_INTERVAL": "0.1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == code
    lines = [line.split(maxsplit=1)[1] for line in done.stdout.splitlines()]
    assert lines[0] == "torch 2.13.0+cpu (190.5 MB)"
    assert set(lines[1:-1]) == {"installing 3 packages"}
    assert len(lines) >= 4  # repeated while pip prints nothing
    assert lines[-1] == "installed"
    assert (tmp_path / "arguments").read_text().split()[-2:] == ["--editable", ".[dev]"]
