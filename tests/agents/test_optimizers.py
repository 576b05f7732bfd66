"""merl's Adam is torch's, and starts without the compiler."""

from __future__ import annotations

import subprocess
import sys

import torch

from merl.agents.optimizers import adam

STEP = """
import sys, torch
from merl.agents.optimizers import adam, load_optimizer, step_optimizer
weight = torch.nn.Parameter(torch.ones(3))
optimizer = adam([weight], 0.1)
step_optimizer(optimizer, (weight**2).sum(), [weight])
load_optimizer(optimizer, optimizer.state_dict())
assert (weight < 1).all()
print("torch._dynamo" in sys.modules)
"""


def test_adam_takes_the_steps_of_torchs_own() -> None:
    start = torch.randn(5, generator=torch.Generator().manual_seed(0))
    ends = []
    for make in (adam, lambda weights, rate: torch.optim.Adam(weights, rate, fused=True)):
        weight = torch.nn.Parameter(start.clone())
        optimizer = make([weight], 0.1)
        for _ in range(4):
            optimizer.zero_grad()
            (weight**4).sum().backward()
            optimizer.step()
        ends.append((weight.detach(), optimizer.state_dict()))
    (one, state), (other, expected) = ends
    assert one.equal(other)
    assert state["state"][0]["exp_avg"].equal(expected["state"][0]["exp_avg"])
    assert not one.equal(start)


def test_adam_does_not_import_the_compiler() -> None:
    done = subprocess.run([sys.executable, "-c", STEP], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
