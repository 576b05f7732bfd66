"""The command merl export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.filesize import decimal

from merl.cli.console import make_console, say
from merl.cli.parsing import PolicyOptions, check_writable, parse
from merl.cli.running import open_policy
from merl.evaluation.export import export_policy
from merl.evaluation.exported import SUFFIXES, Form


@dataclass(frozen=True)
class ExportOptions(PolicyOptions):
    """Write a trained policy to one file that runs without merl."""

    to: Form = "onnx"
    """onnx, for ONNX Runtime and others; torch, a program of torch.export; or numpy, a Python file
    that needs NumPy alone."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The file; by default policy.onnx, policy.pt2 or policy.py. A card (JSON) is written
    beside it."""


def export(args: list[str]) -> int:
    """Export a policy: merl export RUN [--to onnx|torch|numpy] [--out FILE]."""
    options = parse(ExportOptions, "merl export", args)
    out = (options.out or Path(f"policy{SUFFIXES[options.to]}")).absolute()
    if out.suffix != SUFFIXES[options.to]:
        out = out.with_name(out.name + SUFFIXES[options.to])
    check_writable(out)
    console = make_console()
    policy = open_policy(options)
    with console.status("exporting", spinner="line"):
        card = export_policy(policy, out, options.to)
    size, times = decimal(out.stat().st_size), card["milliseconds"]
    say(
        console,
        f"{out}: {size}; an action takes {times['p50']} ms (99 %: {times['p99']} ms) on one thread",
    )
    for kind in ("inputs", "outputs"):
        for name, told in card[kind].items():
            shape = tuple(told["shape"])
            console.print(f"  {kind[:-1]} {name}: {told['dtype']} {shape}")
    say(console, f"card: {out}.json")
    return 0
