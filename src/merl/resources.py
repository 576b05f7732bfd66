"""What this process may use: memory and disk, and how to reserve a file's space before its use."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
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


def free_disk(directory: Path) -> int:
    """Bytes that this user can write where `directory` lies or will lie."""
    status = os.statvfs(existing_parent(directory))
    return status.f_bavail * status.f_frsize


def existing_parent(path: Path) -> Path:
    """The path itself if it exists, else its nearest parent that does."""
    path = path.absolute()
    while not path.exists():
        path = path.parent
    return path


def reserve_file(path: Path, size: int) -> None:
    """Make the file `size` bytes long, with every byte of it backed by the disk.

    A file that is only given a length is sparse: writing to its memory map on a full disk kills the
    process with SIGBUS. New bytes are zero, old ones are kept.

    Raises:
        OSError: the disk is full (ENOSPC), a quota is reached, and the like. The file then has the
            length that it had before (0 if it is new).
    """
    with path.open("ab") as file:
        before = os.fstat(file.fileno()).st_size
        if size <= before:
            return
        try:
            try:
                os.posix_fallocate(file.fileno(), before, size - before)
            except (AttributeError, OSError) as error:
                unsupported = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)
                if isinstance(error, OSError) and error.errno not in unsupported:
                    raise
                file.truncate(before)
                for start in range(before, size, len(_ZEROS)):
                    file.write(_ZEROS[: size - start])
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            os.ftruncate(file.fileno(), before)
            raise


def _machine_memory(root: Path) -> int:
    """MemAvailable where the kernel tells it, else all physical memory."""
    try:
        lines = (root / "proc/meminfo").read_text().splitlines()
    except OSError:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    sizes = {
        name: int(rest.split()[0]) for name, _, rest in (line.partition(":") for line in lines)
    }
    return 1024 * sizes["MemAvailable"]


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
            files = (mount, "memory.max", "memory.current", "")
        elif "memory" in controllers.split(","):
            files = (mount / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_")
        else:
            continue
        base, limit, usage, prefix = files
        group = base / name.strip("/")
        # Inside a container the name may be that outside of it: then only the parents exist here.
        for folder in (group, *group.parents):
            if not folder.is_relative_to(base):
                break
            left = _left_in(folder / limit, folder / usage, folder / "memory.stat", prefix)
            if left is not None:
                yield left


def _left_in(limit: Path, usage: Path, stat: Path, prefix: str) -> int | None:
    """Limit minus use plus file cache; None where there is no limit or no such group."""
    try:
        text = limit.read_text().strip()
        if text == "max":
            return None
        used = int(usage.read_text())
        counts = dict(line.split() for line in stat.read_text().splitlines())
    except OSError:
        return None
    cache = sum(int(counts.get(f"{prefix}{kind}_file", 0)) for kind in ("active", "inactive"))
    return max(0, int(text) - max(0, used - cache))
