"""What this process may use: memory, threads and disk, and how it holds on to them."""

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

_ZEROS = bytes(1 << 20)


def available_memory(root: Path = Path("/")) -> int:
    """Memory that this process can still take without swapping or being killed, in bytes.

    The smallest of what the machine has available and what each control group around the process
    (version 1 and 2, with all parents) leaves it. File cache counts as available: the kernel gives
    it back when asked.

    Args:
        root: where `proc` and `sys` are found; another folder only in tests.
    """
    return min([_machine_memory(root), *_cgroup_memory(root)])


def keep_freed_memory(keep: bool = True) -> bool:
    """Have the C library keep what is freed for the next tensors, in place of giving it back.

    An update frees and takes the same large blocks every time. By default glibc maps each of them
    anew, and the system hands out its pages one by one, zeroed: a tenth of the processor time of an
    update of the paper's size, more where other runs share the machine (docs/bench.md).

    Args:
        keep: False for what glibc does by itself once it has met large blocks.

    Returns:
        Whether the C library has it: glibc does.
    """
    mmap_threshold, mmap_max, trim_threshold, top_pad = -3, -4, -1, -2  # malloc.h
    # The thresholds grow to these at the first free of a large block, unless they were ever set.
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
    """Bytes that this user can write where `directory` lies or will lie."""
    status = os.statvfs(existing_parent(directory))
    return status.f_bavail * status.f_frsize


def existing_parent(path: Path) -> Path:
    """The path itself if it exists, else its nearest parent that does."""
    path = path.absolute()
    while not _is_there(path):
        path = path.parent
    return path


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # too long a name, or a folder that may not be searched
        return False


def reserve_file(path: Path, size: int) -> None:
    """Make the file at least `size` bytes long, with every new byte backed by the disk.

    A file that is only given a length is sparse: writing to its memory map on a full disk kills the
    process with SIGBUS. New bytes are zero, old ones are kept.

    Raises:
        OSError: the disk is full (ENOSPC), a quota is reached, and the like. The file then has the
            length that it had before (0 if it is new).
    """
    # Not in append mode: there neither posix_fallocate's emulation nor pwrite keeps to its offset.
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


def _allocate(file: int, start: int, end: int) -> None:
    """Reserve the bytes from `start` to `end`, by writing zeros where nothing better is known."""
    try:
        os.posix_fallocate(file, start, end - start)
        return
    except AttributeError:  # macOS
        pass
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS):
            raise
    while start < end:
        start += os.pwrite(file, _ZEROS[: end - start], start)
    os.fsync(file)


def _machine_memory(root: Path) -> int:
    """MemAvailable where the kernel tells it, else all physical memory."""
    try:
        text = (root / "proc/meminfo").read_text()
    except OSError:
        text = ""
    found = re.search(r"^MemAvailable:\s+(\d+) kB$", text, re.MULTILINE)
    if found:
        return 1024 * int(found[1])
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _cgroup_memory(root: Path) -> Iterator[int]:
    """What each control group that limits memory has left, in bytes."""
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
        # Inside a container the name may be the one outside of it: then only parents exist here.
        group = base / name.strip("/")
        for folder in (group, *group.parents):
            if not folder.is_relative_to(base):
                break
            left = _left_in(folder / limit, folder / usage, folder / "memory.stat", prefix)
            if left is not None:
                yield left


def _left_in(limit: Path, usage: Path, stat: Path, prefix: str) -> int | None:
    """Limit minus use plus file cache, in bytes; None where there is no limit or no such group."""
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
    """Import Matplotlib without the `matplotlibrc` of the working folder, which it reads first.

    That folder may be the run of a stranger, and such a file may name programs to start.
    """
    if "matplotlib" in sys.modules or not Path("matplotlibrc").exists():
        return
    with chdir(Path(__file__).parent):
        import_module("matplotlib")
