"""The package's update against the reference, from the same state, sample and random numbers."""

from __future__ import annotations

from dataclasses import replace

import pytest
import reference
import torch
from bridge import (
    Case,
    beyond,
    double,
    draws_of,
    error,
    errors,
    fill_adam_state,
    gradients_of,
    moments_of,
    named_cases,
    sample_of,
    state_of,
    weather,
    weights_of,
)
from torch import Tensor

from merl import modalities
from merl.accelerate.joint_heads import join_heads
from merl.accelerate.speed_up import compile_forward, speed_up
from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.drqv2 import DrQV2Config
from merl.agents.merl import MERLConfig
from merl.networks import augmentation, representation

SIZES = {"conv_channels": 8, "hidden_dim": 32, "precision": "fp32"}
SMALL = MERLConfig(latent_dim=48, **SIZES)
STATE = {"state": 9}
MLP = {"encoders": {"proprio": "mlp"}, "mlp_dim": 20}
TWO_CAMERAS = {"front": (24, 28, 3), "wrist": (26, 20, 1)}

CASES = [
    Case("final", SMALL),
    Case("six-layers", replace(SMALL, head_layers=6)),
    Case("averaged-fusion", replace(SMALL, target="heads_and_fusion")),
    Case("mlp-proprioception", replace(SMALL, **MLP)),
    Case("strides-2211", replace(SMALL, conv_strides=(2, 2, 1, 1))),
    Case("two-cameras", SMALL, images=TWO_CAMERAS),
    Case("two-vectors", SMALL, vectors={"joints": 5, "touch": 2}),
    Case("simnorm", replace(SMALL, fusion_layer="simnorm")),
    Case("attention", replace(SMALL, fusion_layer="attention")),
    Case(
        "every-kind",
        replace(SMALL, fusion_layer="attention"),
        depths={"depth": (20, 22, 1)},
        histories={"force": (11, 3)},
    ),
    Case("without-fusion-norm", replace(SMALL, fusion_norm=False)),
    Case("without-head-norm", replace(SMALL, head_norm=False)),
    Case("without-fusion", replace(SMALL, latent_dim=0)),
    Case("shared-fusion", replace(SMALL, fusion="shared")),
    Case("fusion-shared-by-both", replace(SMALL, fusion="shared_by_both")),
    Case(
        "shared-and-averaged",
        replace(SMALL, fusion="shared_by_both", target="heads_and_fusion", head_layers=4),
    ),
    Case(
        "privileged-critic",
        replace(SMALL, privileged=("state",)),
        vectors={"proprio": 7, "state": 9},
    ),
    Case(
        "decreasing-noise",
        replace(SMALL, noise_std=1.0, noise_std_end=0.1, noise_steps=1000),
        step=400,
    ),
    Case(
        "decaying-step-size",
        replace(SMALL, learning_rate=1e-3, learning_rate_end=1e-4, learning_rate_steps=1000),
        step=400,
    ),
    Case(
        "hl-gauss",
        replace(SMALL, critic_loss="hl_gauss", critic_bins=21, critic_low=1.0, critic_high=2.5),
    ),
    Case(
        "hl-gauss-below-zero",
        replace(SMALL, critic_loss="hl_gauss", critic_low=-3.0),
        images={},
    ),
    Case("ensemble", replace(SMALL, critics=5)),
    Case("ensemble-hl-gauss", replace(SMALL, critics=3, critic_loss="hl_gauss", critic_bins=21)),
    Case("proprio", replace(SMALL, modalities=("vector",)), images={}),
    Case("merl-state", replace(SMALL, keys=("state",)), images={}, vectors=STATE),
    Case("drqv2", replace(DrQV2Config(), **SIZES, latent_dim=50), vectors={}, step=250_000),
    Case("ddpg", replace(DDPGConfig(), **SIZES), images={}, vectors=STATE),
    Case(
        "other-numbers",
        replace(SMALL, tau=0.3, noise_std=0.5, noise_clip=0.4, shift_pad=2, learning_rate=3e-3),
    ),
    Case(
        "all-at-once",
        replace(SMALL, head_layers=6, target="heads_and_fusion", **MLP),
        images=TWO_CAMERAS,
    ),
]
PAPER_3, PAPER_6 = (
    Case(
        f"paper-{layers}-layers",
        MERLConfig(head_layers=layers, precision="fp32"),
        images={"image": (84, 84, 3)},
        vectors={"proprio": 24},
        batch=16,
    )
    for layers in (3, 6)
)


def prepared(case: Case, dtype: torch.dtype) -> DDPG:
    """Make an agent as in mid-training: no weights are zero, one, or equal to each other."""
    agent = case.agent()
    if dtype == torch.float64:
        double(agent)
    weather(agent)
    fill_adam_state(agent)
    return agent


def learn(agent: DDPG, case: Case, seed: int, dtype: torch.dtype) -> dict[str, Tensor]:
    draws = draws_of(case.chance_of(seed), case.config, dtype, case.step)
    return case.learn(agent, case.batch_of(seed, dtype), draws)


def expect(
    state: reference.State, case: Case, seed: int
) -> tuple[reference.State, reference.Report]:
    return reference.update(state, sample_of(case.batch_of(seed)), case.chance_of(seed), case.spec)


def check_in_double_precision(case: Case, updates: int) -> None:
    agent = prepared(case, torch.float64)
    state = state_of(agent)
    for seed in range(updates):
        metrics = learn(agent, case, seed, torch.float64)
        state, report = expect(state, case, seed)
        assert error(metrics["critic_loss"], report.critic_loss) < 1e-8
        assert error(metrics["actor_loss"], report.actor_loss) < 1e-8
        assert error(metrics["target_q"], report.y.mean()) < 1e-8
        assert not beyond(errors(gradients_of(agent), report.gradients), 1e-8)
    assert not beyond(errors(weights_of(agent), state.weights), 1e-9)
    for optimizer, truth in (
        (agent.critic_optimizer, state.critic_adam),
        (agent.actor_optimizer, state.actor_adam),
    ):
        moments = moments_of(optimizer, agent)
        assert moments.t == truth.t
        assert not beyond(errors(moments.m, truth.m), 1e-8)
        assert not beyond(errors(moments.v, truth.v), 1e-8)


@named_cases(*CASES)
def test_five_updates_equal_the_reference(case: Case) -> None:
    check_in_double_precision(case, updates=5)


def test_update_at_the_papers_size() -> None:
    check_in_double_precision(PAPER_3, updates=1)


@pytest.mark.long
@named_cases(PAPER_3, PAPER_6)
def test_five_updates_at_the_papers_size(case: Case) -> None:
    check_in_double_precision(replace(case, batch=32), updates=5)


def test_first_updates_of_an_untrained_agent() -> None:
    """Adam's bias correction is largest at its first step."""
    case = CASES[0]
    agent = double(case.agent())
    state = state_of(agent)
    for seed in range(2):
        learn(agent, case, seed, torch.float64)
        state, _ = expect(state, case, seed)
    assert not beyond(errors(weights_of(agent), state.weights), 1e-9)


@named_cases(*CASES)
def test_update_in_single_precision(case: Case) -> None:
    check_single_precision(case)


@pytest.mark.long
@named_cases(PAPER_3, PAPER_6)
def test_update_in_single_precision_at_the_papers_size(case: Case) -> None:
    """Use few images, and require two of three batches to agree.

    If the input of a ReLU is 0 within rounding, it can be active in one arithmetic and inactive in
    the other, which changes a gradient by 1e-4 to 1e-3. An image passes 200,000 ReLUs; this happens
    once in some tens of images, and depends on the processor.
    """
    few = replace(case, batch=2)
    agrees = [not beyond(single_precision_errors(few, seed), 1e-4) for seed in range(3)]
    assert sum(agrees) >= 2


def check_single_precision(case: Case) -> None:
    assert not beyond(single_precision_errors(case, 0), 1e-4)


def single_precision_errors(case: Case, seed: int) -> dict[str, float]:
    """Return the errors of the losses and the gradients of an update."""
    agent = prepared(case, torch.float32)
    state = state_of(agent)
    metrics = learn(agent, case, seed, torch.float32)
    _, report = expect(state, case, seed)
    losses = {
        "critic_loss": error(metrics["critic_loss"], report.critic_loss),
        "actor_loss": error(metrics["actor_loss"], report.actor_loss),
    }
    return losses | errors(gradients_of(agent), report.gradients)


def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let cases make agents with the networks of a GPU, as far as their config asks for it."""
    make = Case.agent

    def agent(case: Case, *args: int) -> DDPG:
        made = make(case, *args)
        for critic in (made.networks.critic, made.critic_target["critic"]):
            join_heads(critic)
        speed_up(made)
        if case.config.torch_compile == "yes":
            compile_forward(made.networks.encoders)
        return made

    monkeypatch.setattr(Case, "agent", agent)


HEADS_AT_ONCE = [
    case for case in CASES if case.name in ("six-layers", "without-head-norm", "ensemble")
]


@named_cases(*HEADS_AT_ONCE)
def test_update_with_heads_at_once_as_on_a_gpu(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    as_on_a_gpu(monkeypatch)
    check_in_double_precision(case, updates=5)
    check_single_precision(case)


@pytest.mark.long
@pytest.mark.parametrize("on_a_gpu", [False, True])
def test_update_compiled(on_a_gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """This test takes a minute and needs a C++ compiler."""
    case = replace(CASES[0], config=replace(SMALL, torch_compile="yes"))
    if on_a_gpu:
        as_on_a_gpu(monkeypatch)
        monkeypatch.setattr(representation, "shift", augmentation._shift_by_index)
        monkeypatch.setattr(modalities, "_minus_128", modalities._minus_128_at_once)
    check_in_double_precision(case, updates=5)
    # In bf16, compiled code rounds elsewhere, but uses fp32 where eager mode does.
    gradients = []
    for compiled in ("no", "yes"):
        config = replace(SMALL, torch_compile=compiled, precision="bf16")
        agent = prepared(replace(case, config=config, batch=64), torch.float32)
        learn(agent, replace(case, config=config, batch=64), 0, torch.float32)
        gradients.append(gradients_of(agent))
    assert not beyond(errors(*gradients), 5e-3)


@named_cases(*CASES)
def test_update_in_bf16(case: Case) -> None:
    """Losses agree to 1 %, and every network's gradient has a cosine above 0.9 with the true one.

    A tighter bound would test the rounding: the actor's gradient is a small difference of large
    terms, and bf16 has eight binary digits.
    """
    case = replace(case, config=replace(case.config, precision="bf16"), batch=64)
    agent = prepared(case, torch.float32)
    state = state_of(agent)
    metrics = learn(agent, case, 0, torch.float32)
    _, report = expect(state, case, 0)
    for name, truth in (("critic_loss", report.critic_loss), ("actor_loss", report.actor_loss)):
        assert (metrics[name] - truth).abs() < 0.01 * (1 + truth.abs())
    found = gradients_of(agent)
    assert found.keys() == report.gradients.keys()
    for symbol in (*reference.critic_learns(case.spec), *reference.ACTOR_LEARNS):
        names = reference.of(found, [symbol])  # the identity has no zeta
        if names:
            g, truth = (
                torch.cat([of[n].flatten() for n in names]) for of in (found, report.gradients)
            )
            assert torch.cosine_similarity(g, truth, dim=0) > 0.9, symbol
            assert 0.7 < g.norm() / truth.norm() < 1.4, symbol


# -- the comparison detects errors ---------------------------------------------------------------


def largest_error(case: Case, spec: reference.Spec, updates: int = 1) -> float:
    """Return the largest error of a gradient or a weight if the reference follows `spec`."""
    agent = prepared(case, torch.float64)
    state = state_of(agent)
    for seed in range(updates):
        learn(agent, case, seed, torch.float64)
        state, report = reference.update(
            state, sample_of(case.batch_of(seed)), case.chance_of(seed), spec
        )
    found = errors(gradients_of(agent), report.gradients) | errors(weights_of(agent), state.weights)
    return max(found.values())


def test_comparison_includes_actions_beyond_the_clamp(monkeypatch: pytest.MonkeyPatch) -> None:
    case, beyond_the_clamp = CASES[0], []

    def plain_clamp(a: Tensor) -> Tensor:
        beyond_the_clamp.append(float((a.abs() > 1).double().mean()))
        return a.clamp(-1, 1)

    assert largest_error(case, case.spec) < 1e-8
    monkeypatch.setattr(reference, "clamp_straight_through", plain_clamp)
    assert largest_error(case, case.spec) > 1e-4
    assert all(0.02 < share < 0.5 for share in beyond_the_clamp)


@pytest.mark.parametrize(
    "change",
    [
        {"averaged": ("phi_1", "phi_2")},  # the agent averages the fusion too
        {"clip": 10.0},
        {"sigma": 0.19},
        {"tau": 0.0101},
        {"squash": "simnorm"},
        {"learning_rate": 1.01e-4},
    ],
    ids=lambda change: next(iter(change)),
)
def test_comparison_detects_another_value(change: dict[str, object]) -> None:
    case = next(case for case in CASES if case.name == "averaged-fusion")
    assert largest_error(case, case.spec) < 1e-8
    assert largest_error(case, replace(case.spec, **change)) > 1e-8


# -- random numbers ------------------------------------------------------------------------------


def test_update_is_plan_followed_by_draw_and_learn() -> None:
    case, agent, twin = CASES[0], CASES[0].agent(), CASES[0].agent()
    for seed in range(2):
        batch = case.batch_of(seed)
        plan = twin.plan(0)
        found = agent.update(batch, step=0)
        expected = twin.learn(batch, twin.draw(len(batch.action), plan), plan)
        assert found.keys() == expected.keys()
        assert all(torch.equal(found[name], expected[name]) for name in found)
    assert all(map(torch.equal, weights_of(agent).values(), weights_of(twin).values()))


def test_draw_returns_clipped_noise_and_independent_shifts() -> None:
    """Of a normal with sigma 0.2, clipped at 1.5 sigma, 13.4 % are on the bounds."""
    case = replace(CASES[5], batch=4000)
    batch = replace(CASES[5], batch=1).batch_of(0)
    batch = replace(batch, action=torch.zeros(case.batch, 6))
    agent = case.agent()
    draws = agent.draw(len(batch.action), agent.plan(0))
    for noise in (draws.next_noise, draws.actor_noise):
        assert noise.shape == batch.action.shape
        assert noise.abs().max() == pytest.approx(0.3)
        assert (noise.abs() >= 0.3 - 1e-6).float().mean() == pytest.approx(0.1336, abs=0.01)
        assert noise.std() == pytest.approx(0.1764, abs=0.003)
    for shifts in (draws.shifts, draws.next_shifts):
        assert shifts.keys() == case.images.keys()
        assert all(s.shape == (case.batch, 2) for s in shifts.values())
    independent = [draws.next_noise, draws.actor_noise]
    independent += [s[k] for s in (draws.shifts, draws.next_shifts) for k in s]
    for i, x in enumerate(independent):
        for y in independent[:i]:
            columns = torch.stack([x[:, 0].double(), y[:, 0].double()])
            assert torch.corrcoef(columns)[0, 1].abs() < 0.08


def test_no_shift_is_drawn_if_shift_pad_is_0() -> None:
    case = replace(CASES[0], config=replace(SMALL, shift_pad=0))
    agent = case.agent()
    assert agent.draw(case.batch, agent.plan(0)).shifts == {}
    agent = double(case.agent())
    state = state_of(agent)
    batch = case.batch_of(0, torch.float64)
    chance = case.chance_of(0)
    case.learn(
        agent,
        batch,
        replace(draws_of(chance, case.config, torch.float64), shifts={}, next_shifts={}),
    )
    _, report = reference.update(state, sample_of(batch), chance, case.spec)
    assert not beyond(errors(gradients_of(agent), report.gradients), 1e-8)
