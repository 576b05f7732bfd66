"""Provenance of a result: package versions, commit, machine."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

import merl

PACKAGES = (
    "torch",
    "numpy",
    "gymnasium",
    "dm_control",
    "mujoco",
    "warp-lang",
    "lz4",
)


def package_versions(*others: str) -> dict[str, str]:
    """Return the versions of Python, of `PACKAGES` and of further packages."""
    found = {"python": platform.python_version()}
    for name in (*PACKAGES, *others):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "missing"
    return found


def machine() -> dict[str, Any]:
    """Describe the machine: processor, cores, CPU instructions, GPU."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "processor": _processor_name(),
        "cores": len(os.sched_getaffinity(0)),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "gpu": gpu,
    }


def _processor_name() -> str:
    """Return the model name of the processor, or else a generic name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def commit() -> str | None:
    """Return the commit of the source; None if merl does not run from its own Git checkout."""
    source = Path(merl.__file__).parent
    if not (source.parents[1] / ".git").exists():  # perhaps that of the project around a .venv
        return None
    command = ["git", "-C", str(source), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
