"""Reference of SAC's update, written from Haarnoja et al. (2018b), to test the package against.

Layers, Adam and names are those of `reference`; the equations are the paper's (section 5 and
appendix C): equation 5 for the critic, 9 for the actor, 18 for the temperature, and appendix C for
the density of a squashed Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from reference import (
    Chance,
    Modalities,
    Moments,
    Sample,
    Spec,
    State,
    Weights,
    adam,
    average,
    critic_learns,
    critic_loss,
    encode,
    gradients,
    h,
    mlp,
    of,
    q_actor,
    q_target,
    tanh,
)
from torch import Tensor

LEAST, GREATEST = -10.0, 2.0  # of log sigma


@dataclass(frozen=True)
class SoftState:
    """State of the agent, log alpha, and the state of its Adam."""

    agent: State
    log_alpha: Tensor
    alpha_adam: Moments


@dataclass(frozen=True)
class SoftReport:
    """Intermediate results of one update."""

    y: Tensor
    critic_loss: Tensor
    actor_loss: Tensor
    alpha_loss: Tensor
    entropy: Tensor
    gradients: Weights


def policy(w: Weights, r: Modalities, noise: Tensor, spec: Spec) -> tuple[Tensor, Tensor]:
    """Return an action a = tanh(u), u = mu + sigma noise, and log pi(a | o), equation 26."""
    out = mlp(w, "theta", h(w, "psi_actor", r, spec), spec)
    half = out.shape[-1] // 2
    mu, raw = out[:, :half], out[:, half:]
    sigma = torch.exp(LEAST + (GREATEST - LEAST) * (tanh(raw) + 1) / 2)
    u = mu + sigma * noise
    density = torch.exp(-(noise**2) / 2) / (sigma * math.sqrt(2 * math.pi))
    # 1 - tanh(u)^2 = 1 / cosh(u)^2, which is not zero where tanh rounds to 1
    return tanh(u), (torch.log(density) + 2 * torch.log(torch.cosh(u))).sum(-1)


def update(
    state: SoftState, sample: Sample, chance: Chance, spec: Spec, target_entropy: float
) -> tuple[SoftState, SoftReport]:
    """Update critic, target, actor (on features from before the critic's step), temperature."""
    w = state.agent.weights
    alpha = state.log_alpha.exp()
    r_next = encode(w, sample.o_next, chance.shift_next, spec)
    a_next, log_pi_next = policy(w, r_next, chance.noise_next, spec)
    latent_next = h(w, "psi_critic", r_next, spec)
    soft = q_target(w, latent_next, a_next, chance, spec)
    y = (sample.r + sample.discount * (soft - alpha * log_pi_next)).detach()
    features = encode(w, sample.o, chance.shift, spec)

    def eq_5(w: Weights) -> Tensor:
        return critic_loss(w, encode(w, sample.o, chance.shift, spec), sample.a, y, spec)

    loss_1, g_1 = eq_5(w), gradients(eq_5, w, of(w, critic_learns(spec)))
    w, critic_adam = adam(w, state.agent.critic_adam, g_1, spec)
    w = average(w, spec)

    def eq_9(w: Weights) -> Tensor:
        a, log_pi = policy(w, features, chance.noise, spec)
        latent = h(w, "psi_critic", features, spec).detach()
        return (alpha * log_pi - q_actor(w, latent, a, spec)).mean()

    loss_2, g_2 = eq_9(w), gradients(eq_9, w, of(w, ("psi_actor", "theta")))
    log_pi = policy(w, features, chance.noise, spec)[1]
    w, actor_adam = adam(w, state.agent.actor_adam, g_2, spec)

    eq_18: Callable[[Weights], Tensor] = lambda t: (  # noqa: E731
        -t["log_alpha"].exp() * (log_pi + target_entropy)
    ).mean()
    temperature = {"log_alpha": state.log_alpha}
    loss_3, g_3 = eq_18(temperature), gradients(eq_18, temperature, ["log_alpha"])
    moved, alpha_adam = adam(temperature, state.alpha_adam, g_3, spec)

    agent = replace(state.agent, weights=w, critic_adam=critic_adam, actor_adam=actor_adam)
    report = SoftReport(y, loss_1, loss_2, loss_3, -log_pi.mean(), g_1 | g_2 | g_3)
    return SoftState(agent, moved["log_alpha"], alpha_adam), report
