"""All heads of a critic in the same kernels."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from merl.accelerate.joint_heads import join_heads
from merl.networks.critic import Critic
from merl.networks.heads import HeadSize, Norm


@pytest.mark.parametrize("layers", [1, 4])
@pytest.mark.parametrize("norm", ["layer", "none"])
@pytest.mark.parametrize("count", [2, 5])
def test_heads_at_once_equal_heads_one_by_one(layers: int, norm: Norm, count: int) -> None:
    """Compare values, and gradients of the action and of every weight, also in bf16."""
    torch.manual_seed(1)  # in bf16, a few seeds round a value to the other side of a ReLU
    critic = Critic(10, 4, HeadSize(layers, 32, norm), count=count).double()
    for parameter in critic.parameters():
        nn.init.normal_(parameter, 0.0, 0.3)
    latent, action = torch.randn(50, 10), torch.rand(50, 4, requires_grad=True)

    joined = copy.deepcopy(critic)
    join_heads(joined)

    def values_and_gradients(critic: Critic, dtype: torch.dtype) -> list[torch.Tensor]:
        critic.to(torch.float64 if dtype == torch.float64 else torch.float32)
        state = latent.to(next(critic.parameters()).dtype)
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            q = critic(state, action.to(state.dtype))
        inputs = [action, *critic.parameters()]
        product = torch.stack(q).prod(dim=0).sum()
        return [*q, *torch.autograd.grad(product, inputs)]

    for dtype, bound in ((torch.float64, 1e-12), (torch.float32, 1e-5), (torch.bfloat16, 1e-5)):
        one_by_one, at_once = (values_and_gradients(each, dtype) for each in (critic, joined))
        for a, b in zip(at_once, one_by_one, strict=True):
            assert a.shape == b.shape
            assert a.dtype == b.dtype
            assert (a - b).norm() <= bound * b.norm()
