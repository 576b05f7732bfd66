"""The cache of compiled kernels: damaged files and full disks."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp

from merl.core import MerlError
from merl.rendering import warp_runtime
from merl.rendering.warp_runtime import load_kernels, start_warp

RENDER = """
from merl.acting.run_env import make_run_env
from merl.experiments.presets import compose
make_run_env(compose("laptop", "reach_duplo", None, "matched")).reset()
import warp
print(warp.config.kernel_cache_dir)
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache with a damaged kernel."""
    start_warp()
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    kernel = tmp_path / "wp_merl.rendering.raster.cover_1" / "cover.o"
    kernel.parent.mkdir()
    kernel.touch()
    return kernel


def test_a_damaged_kernel_is_built_again(cache: Path) -> None:
    def load() -> int:
        if cache.exists():
            raise Exception("Failed to load CPU module")
        return 1

    other = cache.parent.with_name("wp_other")
    other.mkdir()
    assert load_kernels(load) == 1
    assert other.exists()
    assert Path(warp.config.kernel_cache_dir) == cache.parents[1]


def test_kernels_are_built_in_a_temporary_folder_if_the_cache_cannot_be_written(
    cache: Path,
) -> None:
    def load() -> str:
        if Path(warp.config.kernel_cache_dir) == cache.parents[1]:
            raise OSError(28, "No space left on device")
        return str(warp.config.kernel_cache_dir)

    assert load_kernels(load).startswith(str(cache.parents[1] / "merl-warp-"))


def test_kernels_that_cannot_be_built_are_one_line(cache: Path) -> None:
    def load() -> None:
        raise RuntimeError("no\ncompiler")

    with pytest.raises(
        MerlError, match=r"cannot be compiled: RuntimeError: no compiler \(.*\): free"
    ):
        load_kernels(load)


def test_a_cache_without_room_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LLVM ends the process if it cannot write a kernel."""
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "full"))
    reserve = warp_runtime.reserve_file

    def full(path: Path, size: int) -> None:
        if path.is_relative_to(tmp_path / "full"):
            raise OSError(28, "No space left on device")
        reserve(path, size)

    monkeypatch.setattr(warp_runtime, "reserve_file", full)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert warp_runtime._kernel_cache() == tmp_path / "home" / "merl" / "warp"
    assert [*(tmp_path / "home" / "merl" / "warp").iterdir()] == []


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".o", ".meta"])
def test_truncated_kernels_are_compiled_again(tmp_path: Path, suffix: str) -> None:
    start_warp()
    shutil.copytree(warp.config.kernel_cache_dir, tmp_path / warp.config.version)
    truncated = [*tmp_path.rglob(f"*{suffix}")]
    assert truncated
    sizes = {file: file.stat().st_size for file in truncated}
    for file, size in sizes.items():
        with file.open("r+b") as opened:
            opened.truncate(size // 2)
    done = subprocess.run(
        [sys.executable, "-c", RENDER],
        env={"WARP_CACHE_PATH": str(tmp_path), "PATH": "/usr/bin"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(tmp_path / warp.config.version)
    assert all(size == sizes.get(file, size) for file, size in _sizes(tmp_path, suffix).items())


def _sizes(folder: Path, suffix: str) -> dict[Path, int]:
    return {file: file.stat().st_size for file in folder.rglob(f"*{suffix}")}
