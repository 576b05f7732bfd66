"""Available memory and disk space, with simulated system files."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from merl.core.resources import available_memory, free_disk, reserve_file

GIB = 1 << 30


def machine(root: Path, available: int, groups: str = "") -> Path:
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text(
        f"MemTotal: 99999999 kB\nMemAvailable:   {available // 1024} kB\nHugePages_Total: 0\n"
    )
    (root / "proc/self/cgroup").write_text(groups)
    return root


def group(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)


def test_memory_without_control_groups_is_that_of_the_machine(tmp_path):
    assert available_memory(machine(tmp_path, 8 * GIB)) == 8 * GIB


def test_cgroup_version_2_counts_file_cache_as_free(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/jobs/mine\n")
    mine = root / "sys/fs/cgroup/jobs/mine"
    cache = f"anon 5\ninactive_file {GIB}\nactive_file {GIB}\n"
    group(mine, memory__max=f"{6 * GIB}\n", memory__current=f"{5 * GIB}\n", memory__stat=cache)
    assert available_memory(root) == 3 * GIB


def test_the_smallest_limit_of_all_parent_groups_counts(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/jobs/mine\n")
    parent = root / "sys/fs/cgroup/jobs"
    group(parent / "mine", memory__max="max\n", memory__current="1\n", memory__stat="")
    group(parent, memory__max=f"{2 * GIB}", memory__current=f"{GIB}", memory__stat="anon 1\n")
    assert available_memory(root) == GIB


def test_cgroup_version_1(tmp_path):
    root = machine(tmp_path, 64 * GIB, "9:cpu,cpuacct:/x\n4:memory:/docker/abc\n0::/\n")
    # In a container the group has another name; only the root of the container exists.
    group(
        root / "sys/fs/cgroup/memory",
        memory__limit_in_bytes=f"{4 * GIB}\n",
        memory__usage_in_bytes=f"{3 * GIB}\n",
        memory__stat=f"inactive_file 7\ntotal_inactive_file {GIB}\ntotal_active_file 0\n",
    )
    assert available_memory(root) == 2 * GIB


def test_a_full_control_group_leaves_no_memory(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/\n")
    group(root / "sys/fs/cgroup", memory__max="5", memory__current="9", memory__stat="")
    assert available_memory(root) == 0


def test_without_system_files_memory_is_the_physical_memory(tmp_path):
    assert available_memory(tmp_path) > 100_000_000


def test_free_disk_of_a_folder_that_does_not_exist_yet(tmp_path):
    status = os.statvfs(tmp_path)
    assert free_disk(tmp_path / "a" / "b") == pytest.approx(
        status.f_bavail * status.f_frsize, rel=0.1
    )


@pytest.mark.parametrize("code", [None, errno.EOPNOTSUPP, errno.EINVAL])
def test_reserving_keeps_the_content_and_appends_zeros(tmp_path, monkeypatch, code):
    if code is not None:

        def refuse(*_: int) -> None:
            raise OSError(code, os.strerror(code))

        monkeypatch.setattr(os, "posix_fallocate", refuse)
    file = tmp_path / "file"
    file.write_bytes(b"abc")
    reserve_file(file, 3_000_000)
    assert file.read_bytes() == b"abc" + bytes(3_000_000 - 3)
    assert file.stat().st_blocks * 512 >= 3_000_000
    reserve_file(file, 10)  # never shorter
    assert file.stat().st_size == 3_000_000


def test_a_full_disk_restores_the_length_of_the_file(tmp_path, monkeypatch):
    def refuse(*_: int) -> None:
        raise OSError(errno.EOPNOTSUPP, "not supported")

    def full(file: int, data: bytes, offset: int) -> int:
        if offset > 2_000_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, data, offset)

    write = os.pwrite
    monkeypatch.setattr(os, "posix_fallocate", refuse)
    monkeypatch.setattr(os, "pwrite", full)
    file = tmp_path / "file"
    file.write_bytes(b"abc")
    with pytest.raises(OSError, match="No space left"):
        reserve_file(file, 5_000_000)
    assert file.read_bytes() == b"abc"


def test_keep_freed_memory_avoids_page_faults() -> None:
    program = """
import resource, sys
from merl.core.resources import keep_freed_memory
assert keep_freed_memory(sys.argv[1] == "keep")
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    block = b"x" * 50_000_000
    del block
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
    faults = {}
    for mode in ("keep", "default"):
        command = [sys.executable, "-c", program, mode]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        faults[mode] = int(done.stdout)
    assert faults["keep"] < 100
    assert faults["default"] > 1000
