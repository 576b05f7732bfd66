"""Measure the speed of merl on a GPU.

    python benchmarks/measure_gpu.py --out FOLDER

Six parts. Each result is written at once; if a part fails, its error is printed and the others run:

agrees    checks that a recorded update equals the update that is launched operation by operation,
          except for the GPU's order of additions, and that none of 100 more updates waits for the
          GPU
launches  counts the operations of an update, which determine its time without a CUDA graph, and
          much of it with one; the count is the same on a CPU
gains     times the whole update, sampled on the GPU, as it is and with one change at a time
profile   lists the kernels of an update and their times
update    merl bench update
train     merl bench train: the whole loop, with one environment and with several
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Literal
from unittest.mock import patch

import torch
import tyro
from rich.console import Console
from torch.autograd import DeviceType  # type: ignore[attr-defined]
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from measure_gains import Change, channels_first
from merl.accelerate.cuda_graph import Recorded, UpdateOnDevice
from merl.accelerate.device_replay import DeviceReplay
from merl.accelerate.joint_heads import join_heads
from merl.agents.ddpg import DDPG
from merl.bench import train, update
from merl.bench.measuring import circumstances, spread
from merl.core import MerlError
from merl.networks.critic import Critic
from merl.training.setup import choose_device


@dataclasses.dataclass(frozen=True)
class Form:
    """A form of the update: as it is by default, or with a change."""

    precision: Literal["bf16", "fp32"] = "bf16"
    compiled: bool = False
    graph: bool = True
    change: Change = nullcontext


def main(
    out: Path = Path("gpu"),
    parts: tuple[Literal["agrees", "launches", "gains", "profile", "update", "train"], ...] = (
        "agrees",
        "launches",
        "gains",
        "profile",
        "update",
        "train",
    ),
    agent: Literal["merl", "drqv2"] = "merl",
    batch_size: int = 256,
    updates: int = 100,
    repeats: int = 7,
) -> None:
    """Measure all parts.

    Args:
        out: the folder for the results.
        parts: the parts to measure.
        agent: the agent in agrees, launches, gains and profile.
        batch_size: B, in all parts except train.
        updates: updates in a turn, in gains.
        repeats: turns of each variant.
    """
    out.mkdir(parents=True, exist_ok=True)
    console = Console(markup=False)
    console.print(circumstances())
    for name, part in {
        "agrees": lambda: agrees(agent, batch_size),
        "launches": lambda: launches(agent),
        "gains": lambda: gains(agent, batch_size, updates, repeats),
        "profile": lambda: profiles(agent, batch_size),
        "update": lambda: shown(update, repeats=repeats, batch_size=batch_size),
        "train": lambda: loop(min(repeats, 3)),
    }.items():
        if name not in parts:
            continue
        try:
            found = part()  # type: ignore[no-untyped-call]
        except Exception as error:
            traceback.print_exc()
            console.print(f"{name} failed: {type(error).__name__}: {error}")
            continue
        (out / f"{name}.json").write_text(json.dumps(found, indent=1))


def shown(bench: Any, **asked: Any) -> Any:
    """Run a bench; print its table and return its result."""
    result = bench.run(**asked)
    Console(markup=False).print(bench.table(result))
    return result


def loop(repeats: int) -> Any:
    """Time the whole loop; with preset laptop if OpenGL is missing."""
    try:
        return shown(train, repeats=repeats)
    except MerlError as error:
        print(f"{error}; now with preset laptop", file=sys.stderr)
        return shown(train, repeats=repeats, preset="laptop")


def agrees(agent: str, batch_size: int) -> dict[str, float]:
    """Return the largest relative distance of a weight after the same updates, recorded or not."""
    found = {}
    for form in (Form(precision="fp32"), Form(), Form(compiled=True)):
        recorded, learner = work_of(agent, batch_size, form)
        launched, other = work_of(agent, batch_size, dataclasses.replace(form, graph=False))
        for _ in range(5):
            recorded(0)
            launched(0)
        pairs = zip(learner.networks.parameters(), other.networks.parameters(), strict=True)
        with torch.no_grad():
            apart = max(float((a - b).norm() / b.norm().clamp(min=1e-9)) for a, b in pairs)
        if torch.cuda.is_available():
            torch.cuda.set_sync_debug_mode("error")
        try:
            for _ in range(100 if torch.cuda.is_available() else 1):
                recorded(0)
        finally:
            if torch.cuda.is_available():
                torch.cuda.set_sync_debug_mode("default")
        name = f"{form.precision}{', compiled' if form.compiled else ''}"
        print(f"{name}: weights differ by {apart:.2g} of their norm; no update waits for the GPU")
        found[name] = apart
    return found


class Launches(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts the operations that compute something."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.count = 0

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        name = operation.name()
        makes_no_kernel = any(part in name for part in ("empty", "profiler", "detach"))
        self.count += not (operation.is_view or makes_no_kernel)
        return operation(*args, **(kwargs or {}))


def launches(agent: str) -> dict[str, int]:
    """Count the operations of an update in bf16, with the twin critics one by one and at once."""
    batch, counts = update.noise_batch(8), {}
    for name, at_once in (("one by one", False), ("at once", True)):
        learner = update.learner_of(agent, "bf16", torch.device("cpu"))
        for critic in critics(learner) if at_once else ():
            join_heads(critic)
        learner.update(batch, step=0)
        with Launches() as launches:
            learner.update(batch, step=0)
        counts[name] = launches.count
        print(f"twin critics {name}: {launches.count} operations")
    return counts


def gains(agent: str, batch_size: int, updates: int, repeats: int) -> dict[str, Any]:
    """Time all forms in turns; return their updates per second."""
    forms = {
        "as it is": Form(),
        "without a CUDA graph": Form(graph=False),
        "twin critics one by one": Form(change=one_by_one),
        "channels first": Form(change=channels_first),
        "compiled": Form(compiled=True),
        "fp32": Form(precision="fp32"),
        "fp32, compiled": Form(precision="fp32", compiled=True),
    }
    works: dict[str, tuple[UpdateOnDevice, DDPG]] = {}
    for name, form in forms.items():
        try:
            start = time.perf_counter()
            works[name] = work_of(agent, batch_size, form)
            print(f"{name}: ready in {time.perf_counter() - start:.1f} s", file=sys.stderr)
        except Exception as error:
            print(f"{name}: skipped, {type(error).__name__}: {error}", file=sys.stderr)
    rates: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, (work, learner) in works.items():
            with forms[name].change(learner):
                rates[name].append(updates / seconds(partial(work, 0), updates))
    whole = median(rates.get("as it is", [float("nan")]))
    for name, each in rates.items():
        print(f"| {name} | {median(each):,.1f} | {median(each) / whole:.2f} |")
    found = {name: spread(each) for name, each in rates.items()}
    return {"updates_per_s": found, "batch_size": batch_size, "agent": agent} | circumstances()


def critics(learner: DDPG) -> Iterator[Critic]:
    """Yield the critic and its target."""
    for critic in (learner.networks.critic, learner.critic_target["critic"]):
        assert isinstance(critic, Critic)
        yield critic


@contextmanager
def one_by_one(learner: DDPG) -> Iterator[None]:
    """Let the critics compute their heads one by one."""
    with ExitStack() as stack:
        for critic in critics(learner):
            forward = partial(Critic.forward, critic)
            stack.enter_context(patch.object(critic, "forward", forward))
        yield


def work_of(agent: str, batch_size: int, form: Form) -> tuple[UpdateOnDevice, DDPG]:
    """Return an update in the given form, recorded, and the agent that learns by it."""
    device = choose_device("auto")
    learner = update.learner_of(agent, form.precision, device, compiled=form.compiled)
    replay = DeviceReplay(update.noise_replay(), device)
    work = UpdateOnDevice(learner, replay, batch_size, seed=0)
    if not form.graph:
        work._recorded.WARM_UP = sys.maxsize
    with form.change(learner):
        for _ in range(Recorded.WARM_UP + 2):
            work(0)
        wait()
    return work, learner


def profiles(agent: str, batch_size: int) -> dict[str, Any]:
    """Profile an update; on a GPU also the compiled one."""
    found = {"not compiled": kernels(agent, batch_size, compiled=False)}
    if torch.cuda.is_available():
        found["compiled"] = kernels(agent, batch_size, compiled=True)
    return found | circumstances()


def kernels(agent: str, batch_size: int, *, compiled: bool, updates: int = 20) -> dict[str, Any]:
    """Profile an update: its kernels (on a CPU its operations), the longest first."""
    on_gpu = torch.cuda.is_available()
    # Times of kernels inside a graph are not always reliable: launch them one by one.
    work, _ = work_of(agent, batch_size, Form(graph=False, compiled=compiled))
    kind = ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU
    with profile(activities=[kind]) as profiled:
        seconds(partial(work, 0), updates)
    rows = []
    for event in profiled.key_averages():
        if on_gpu and event.device_type != DeviceType.CUDA:
            continue  # the host's time
        own = event.self_device_time_total if on_gpu else event.self_cpu_time_total
        rows.append((own / updates, event.count / updates, event.key))
    rows.sort(reverse=True)
    count, total = sum(row[1] for row in rows), sum(row[0] for row in rows)
    form = "compiled" if compiled else "not compiled"
    print(f"{form}: {count:.0f} kernels, {total:,.0f} us an update")
    for microseconds, often, name in rows[:25]:
        print(f"{microseconds:10,.1f} us {often:6.1f} x  {name[:100]}")
    return {"microseconds": total, "kernels": count, "longest": rows[:60]}


def seconds(work: Callable[[], object], times: int) -> float:
    """Return the seconds that `times` calls of `work` take, with the GPU's work."""
    wait()
    start = time.perf_counter()
    for _ in range(times):
        work()
    wait()
    return time.perf_counter() - start


def wait() -> None:
    """Wait until the GPU has done its work."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


if __name__ == "__main__":
    tyro.cli(main)
