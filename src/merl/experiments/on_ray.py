"""Run planned runs as tasks of Ray Core, on this machine or on a cluster.

The folder of the sweep must be on a file system that all machines share: a run whose machine is
lost resumes on another one from its own checkpoint.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from merl.core import MerlError
from merl.core.signals import Interrupt
from merl.experiments.experiment import PlannedRun
from merl.experiments.sweep import Outcome, Settings, execute

SAVING = 120.0
"""Seconds in which cancelled runs may save."""


def run_on_ray(
    runs: Sequence[PlannedRun],
    settings: Settings,
    ended: Callable[[Outcome], None],
    tick: Callable[[Sequence[PlannedRun]], None],
    *,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
) -> int | None:
    """Run the runs as tasks of Ray.

    Args:
        runs: the runs.
        settings: how they are run; a task whose worker is lost is retried as often as a crash.
        ended: called when a run has ended.
        tick: called about every second with the runs that have not ended.
        address: address of a cluster; None starts one on this machine.
        cpus: processors of each run.
        gpus: GPUs of each run; a fraction shares one.

    Returns:
        The signal that stopped the sweep, after all runs have saved; None if none did.

    Raises:
        MerlError: Ray is not installed, the cluster does not answer, or it lacks the processors or
            GPUs of a run.
    """
    try:
        import ray
    except ImportError:
        raise MerlError("--ray needs ray: pip install 'merl-rl[ray]', or use --jobs") from None
    try:
        ray.init(address=address or "local", include_dashboard=False, log_to_driver=False)
    except Exception as error:  # Ray's own errors and those of its connections
        where = address or "on this machine"
        raise MerlError(f"Ray {where} cannot be reached: {_line(error)}") from None
    try:
        for name, need in (("CPU", cpus), ("GPU", gpus)):
            has = max((node["Resources"].get(name, 0.0) for node in ray.nodes()), default=0.0)
            if need > has:
                raise MerlError(
                    f"a run needs {need:g} {name}s, and no machine of the cluster has more than "
                    f"{has:g}: lower --{name.lower()}s"
                )
        task = ray.remote(execute).options(
            num_cpus=cpus, num_gpus=gpus, max_retries=settings.retries
        )
        begin = time.monotonic()
        waiting = {task.remote(run, settings, folder=Path.cwd()): run for run in runs}
        with Interrupt().listening() as interrupt:
            while waiting and interrupt.number is None:
                done, _ = ray.wait([*waiting], timeout=1.0)
                for reference in done:
                    run = waiting.pop(reference)
                    ended(_outcome(ray, reference, run.name, begin))
                tick([*waiting.values()])
            for reference in waiting:
                ray.cancel(reference, force=False)
            if waiting:
                ray.wait([*waiting], num_returns=len(waiting), timeout=SAVING)
            return interrupt.number
    finally:
        ray.shutdown()


def _outcome(ray: Any, reference: Any, name: str, begin: float) -> Outcome:
    """Return how a task ended; only its worker knows how long it took."""
    try:
        outcome: Outcome = ray.get(reference)
        return outcome
    except Exception as failed:  # the worker or its machine was lost too often
        return Outcome(name, f"lost by Ray: {_line(failed)}", time.monotonic() - begin)


def _line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
