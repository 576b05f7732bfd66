"""What a process may use, read from pretended system files."""

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


def test_without_control_groups_it_is_what_the_machine_has(tmp_path):
    assert available_memory(machine(tmp_path, 8 * GIB)) == 8 * GIB


def test_version_2_counts_file_cache_as_free(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/jobs/mine\n")
    mine = root / "sys/fs/cgroup/jobs/mine"
    cache = f"anon 5\ninactive_file {GIB}\nactive_file {GIB}\n"
    group(mine, memory__max=f"{6 * GIB}\n", memory__current=f"{5 * GIB}\n", memory__stat=cache)
    assert available_memory(root) == 3 * GIB


def test_the_tightest_of_all_parents_counts(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/jobs/mine\n")
    parent = root / "sys/fs/cgroup/jobs"
    group(parent / "mine", memory__max="max\n", memory__current="1\n", memory__stat="")
    group(parent, memory__max=f"{2 * GIB}", memory__current=f"{GIB}", memory__stat="anon 1\n")
    assert available_memory(root) == GIB


def test_version_1(tmp_path):
    root = machine(tmp_path, 64 * GIB, "9:cpu,cpuacct:/x\n4:memory:/docker/abc\n0::/\n")
    # Inside the container the group's own name is not there, only the container's root.
    group(
        root / "sys/fs/cgroup/memory",
        memory__limit_in_bytes=f"{4 * GIB}\n",
        memory__usage_in_bytes=f"{3 * GIB}\n",
        memory__stat=f"inactive_file 7\ntotal_inactive_file {GIB}\ntotal_active_file 0\n",
    )
    assert available_memory(root) == 2 * GIB


def test_a_group_that_is_full_leaves_nothing(tmp_path):
    root = machine(tmp_path, 64 * GIB, "0::/\n")
    group(root / "sys/fs/cgroup", memory__max="5", memory__current="9", memory__stat="")
    assert available_memory(root) == 0


def test_a_machine_that_tells_nothing_is_taken_at_its_physical_memory(tmp_path):
    assert available_memory(tmp_path) > 100_000_000


def test_free_disk_of_a_folder_that_does_not_exist_yet(tmp_path):
    status = os.statvfs(tmp_path)
    assert free_disk(tmp_path / "a" / "b") == pytest.approx(
        status.f_bavail * status.f_frsize, rel=0.1
    )


@pytest.mark.parametrize("code", [None, errno.EOPNOTSUPP, errno.EINVAL])
def test_reserving_keeps_what_is_there_and_adds_zeros(tmp_path, monkeypatch, code):
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


def test_reserving_where_the_system_has_no_such_call(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate")
    reserve_file(tmp_path / "file", 1000)
    assert (tmp_path / "file").read_bytes() == bytes(1000)


def test_a_full_disk_gives_the_file_its_old_length(tmp_path, monkeypatch):
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


def test_freed_memory_is_kept_for_the_next_of_its_size() -> None:
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
    for how in ("keep", "default"):
        command = [sys.executable, "-c", program, how]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        faults[how] = int(done.stdout)
    assert faults["keep"] < 100
    assert faults["default"] > 1000
