"""Memory and disk space that this process may use, and how to reserve them."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import sys
from collections.abc import Iterator
from contextlib import chdir
from importlib import import_module
from pathlib import Path

_CANNOT_RESERVE = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
_ZEROS = bytes(1 << 20)


def available_memory(root: Path = Path("/")) -> int:
    """Return the memory in bytes that this process can still allocate without swapping.

    The minimum of the available memory of the machine and the remaining memory of each control
    group (cgroup) of the process, version 1 or 2, including all parent groups. File cache counts as
    available, since the kernel frees it on demand.

    Args:
        root: the folder that contains `proc` and `sys`; other than `/` only in tests.
    """
    return min([_machine_memory(root), *_cgroup_memory(root)])


def keep_freed_memory(keep: bool = True) -> bool:
    """Let the C library keep freed memory for later tensors instead of returning it to the system.

    Every update frees and allocates the same large blocks. By default glibc maps each block anew,
    and the system provides its pages one by one, filled with zeros. That costs a tenth of the
    processor time of an update of the paper's size, and more if other runs share the machine
    (docs/explanation/benchmarks.md).

    Args:
        keep: False restores the values that glibc chooses after large blocks were freed.

    Returns:
        Whether the C library supports this; glibc does.
    """
    mmap_threshold, mmap_max, trim_threshold, top_pad = -3, -4, -1, -2  # malloc.h
    # glibc raises the thresholds to these values when a large block is first freed, unless the
    # program has set them before.
    grown = {mmap_threshold: 32 << 20, trim_threshold: 64 << 20, top_pad: 128 << 10}
    values = (
        {mmap_max: 0, trim_threshold: -1, top_pad: 64 << 20} if keep else {mmap_max: 65_536} | grown
    )
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return all(mallopt(name, value) for name, value in values.items())


def free_disk(directory: Path) -> int:
    """Return the bytes that this user can still write on the disk of `directory`.

    The folder does not have to exist yet.
    """
    status = os.statvfs(existing_parent(directory))
    return status.f_bavail * status.f_frsize


def existing_parent(path: Path) -> Path:
    """Return the absolute path if it exists, else its nearest parent that exists."""
    path = path.absolute()
    while not _exists(path):
        path = path.parent
    return path


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # the name is too long, or a folder is not searchable
        return False


def reserve_file(path: Path, size: int) -> None:
    """Extend the file to at least `size` bytes and reserve the disk space of every new byte.

    A file of which only the length is set is sparse: writing to its memory map on a full disk kills
    the process with SIGBUS. New bytes are zero; old bytes are kept.

    Raises:
        OSError: the space cannot be reserved: the disk is full (ENOSPC), a quota is reached, or
            similar. The file then has the length that it had before (0 if it is new).
    """
    # Not in append mode: pwrite and the emulation of posix_fallocate would ignore the offset.
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        before = os.fstat(file).st_size
        if size > before:
            try:
                _allocate(file, before, size)
            except BaseException:
                os.ftruncate(file, before)
                raise
    finally:
        os.close(file)


def reserve_holes(file: int) -> None:
    """Reserve the disk space of a file that has holes, as a copy of a reserved file may have.

    Raises:
        OSError: the disk is full. File systems that cannot reserve space are left as they are.
    """
    found = os.fstat(file)
    if found.st_blocks * 512 >= found.st_size:
        return
    try:
        os.posix_fallocate(file, 0, found.st_size)
    except OSError as error:
        if error.errno not in _CANNOT_RESERVE:
            raise


def _allocate(file: int, start: int, end: int) -> None:
    """Reserve the bytes from `start` to `end`; write zeros if the system has no better way."""
    try:
        os.posix_fallocate(file, start, end - start)
        return
    except OSError as error:
        if error.errno not in _CANNOT_RESERVE:
            raise
    while start < end:
        start += os.pwrite(file, _ZEROS[: end - start], start)
    os.fsync(file)


def _machine_memory(root: Path) -> int:
    """Return MemAvailable in bytes if the kernel reports it, else all physical memory."""
    try:
        text = (root / "proc/meminfo").read_text()
    except OSError:
        text = ""
    found = re.search(r"^MemAvailable:\s+(\d+) kB$", text, re.MULTILINE)
    if found:
        return 1024 * int(found[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _cgroup_memory(root: Path) -> Iterator[int]:
    """Yield the remaining memory in bytes of each control group with a memory limit."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    mount = root / "sys/fs/cgroup"
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if not controllers:  # version 2
            base, limit, usage, prefix = mount, "memory.max", "memory.current", ""
        elif "memory" in controllers.split(","):
            base, prefix = mount / "memory", "total_"
            limit, usage = "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        # In a container the group may have its name on the host: then only its parents exist here.
        group = base / name.strip("/")
        for folder in (group, *group.parents):
            if not folder.is_relative_to(base):
                break
            left = _left_in(folder / limit, folder / usage, folder / "memory.stat", prefix)
            if left is not None:
                yield left


def _left_in(limit: Path, usage: Path, stat: Path, prefix: str) -> int | None:
    """Return limit - usage + file cache in bytes; None without a limit or such a group."""
    try:
        most = limit.read_text().strip()
        used = int(usage.read_text())
        statistics = stat.read_text()
    except OSError:
        return None
    if most == "max":
        return None
    counts = re.findall(rf"^{prefix}(?:in)?active_file (\d+)$", statistics, re.MULTILINE)
    return max(0, int(most) - max(0, used - sum(map(int, counts))))


def load_matplotlib() -> None:
    """Import Matplotlib without the `matplotlibrc` of the working folder.

    Matplotlib reads that file first. The folder may be an untrusted run folder, and the file may
    name programs to start.
    """
    if "matplotlib" in sys.modules or not Path("matplotlibrc").exists():
        return
    with chdir(Path(__file__).parent):
        import_module("matplotlib")
