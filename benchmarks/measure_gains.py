"""Measure the gain of each optimisation of an update on the CPU.

    python benchmarks/measure_gains.py

Times the update of `merl bench update` (six layers, 84x84, batch 256), as it is and without one
optimisation at a time, in turns, on one thread. The times are processor time, which excludes other
load on the machine; the results are medians.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from statistics import median
from typing import Any, Literal
from unittest.mock import patch

import torch
import tyro
from torch import Tensor

from merl.agents import ddpg
from merl.agents.ddpg import DDPG
from merl.bench.measuring import circumstances
from merl.bench.update import learner_of, noise_batch
from merl.core.resources import keep_freed_memory
from merl.modalities import Image
from merl.networks import augmentation, representation
from merl.networks.encoders.frames import ConvEncoder

Change = Callable[[DDPG], AbstractContextManager[Any]]


def main(precision: Literal["bf16", "fp32"] = "bf16", repeats: int = 5) -> None:
    """Switch off each optimisation, and print the time of an update without it."""
    torch.set_num_threads(1)
    print(circumstances())
    batch = noise_batch(256)
    changes: dict[str, Change] = {
        "as it is": lambda _: nullcontext(),
        "freed memory given back to the system": lambda _: given_back(),
        "the shift by one gather": lambda _: patch.object(
            representation, "shift", augmentation._shift_by_index
        ),
        "pixels scaled one by one": lambda _: patch.object(ConvEncoder, "forward", scale_pixels),
        "channels first": channels_first,
        "gradients of all weights": lambda _: gradients_of_all(),
        "Adam weight by weight": weight_by_weight,
    }
    agents = {name: learner_of("merl", precision, torch.device("cpu")) for name in changes}
    taken: dict[str, list[float]] = {name: [] for name in changes}
    with ExitStack() as stack:
        keep_freed_memory()
        stack.callback(keep_freed_memory, False)
        for _ in range(repeats):
            for name, change in changes.items():
                with change(agents[name]):
                    agents[name].update(batch, step=0)
                    start = time.process_time()
                    agents[name].update(batch, step=0)
                    taken[name].append(time.process_time() - start)
    whole = median(taken["as it is"])
    for name, seconds in taken.items():
        print(f"| {name} | {1e3 * median(seconds):,.0f} ms | {median(seconds) / whole - 1:+.1%} |")


@contextmanager
def given_back() -> Iterator[None]:
    """Return freed memory to the system, as glibc does by default."""
    keep_freed_memory(False)
    try:
        yield
    finally:
        keep_freed_memory()


@contextmanager
def channels_first(agent: DDPG) -> Iterator[None]:
    """Keep weights and images in torch's default memory order."""
    agent.networks.encoders.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    as_input = Image.centred

    def contiguous(image: Image, stacks: Tensor, dtype: torch.dtype) -> Tensor:
        return as_input(image, stacks, dtype).contiguous()

    with patch.object(Image, "centred", contiguous):
        yield


def scale_pixels(encoder: ConvEncoder, stacks: Tensor) -> Tensor:
    """Encode images with their pixels scaled (x / 255 - 0.5) in fp32 before the first layer."""
    maps: Tensor = encoder.convolutions(encoder.frames.to_input(stacks))
    return maps.permute(0, 2, 3, 1).flatten(1)


@contextmanager
def gradients_of_all() -> Iterator[None]:
    """Compute the gradients of the actor's loss for the critic's weights too."""
    with (
        patch.object(ddpg, "step_optimizer", step_all),
        patch.object(ddpg, "frozen", lambda _: nullcontext()),
    ):
        yield


def step_all(optimizer: torch.optim.Optimizer, loss: Tensor, _: Any) -> None:
    """Make an optimizer step with gradients for all weights, the critic's included."""
    optimizer.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    optimizer.step()


@contextmanager
def weight_by_weight(agent: DDPG) -> Iterator[None]:
    """Use Adam in torch's default form on a CPU: not fused."""
    groups = [g for o in (agent.critic_optimizer, agent.actor_optimizer) for g in o.param_groups]
    for group in groups:
        group["fused"] = None
    try:
        yield
    finally:
        for group in groups:
            group["fused"] = True


if __name__ == "__main__":
    tyro.cli(main)
