"""Test cases, their data, and the conversion of names and states from package to reference."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest
import reference
import torch
from gymnasium import spaces
from torch import Tensor, nn

from merl.agents import make_agent
from merl.agents.bc import BCConfig
from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.agents.sac import SACConfig
from merl.core import Batch, UpdateNoise

STACK = 3
ACTIONS = 6
GAMMA = 0.99


@dataclass(frozen=True)
class Case:
    """A test case: config of the agent, shapes of the modalities, batch size, environment step."""

    name: str
    config: AgentConfig
    images: Mapping[str, tuple[int, int, int]] = field(
        default_factory=lambda: {"image": (24, 28, 3)}
    )
    vectors: Mapping[str, int] = field(default_factory=lambda: {"proprio": 7})
    depths: Mapping[str, tuple[int, int, int]] = field(default_factory=dict)
    histories: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    batch: int = 8
    step: int = 0

    @property
    def observation_space(self) -> spaces.Dict:
        images = {k: spaces.Box(0, 255, shape, np.uint8) for k, shape in self.images.items()}
        vectors = {
            k: spaces.Box(-np.inf, np.inf, shape, np.float32)
            for k, shape in {**self._vector_shapes, **self.histories}.items()
        }
        depths = {k: spaces.Box(0.0, 2.0, shape, np.float32) for k, shape in self.depths.items()}
        return spaces.Dict(images | vectors | depths)

    @property
    def _vector_shapes(self) -> dict[str, tuple[int, ...]]:
        return {key: (n,) for key, n in self.vectors.items()}

    @property
    def spec(self) -> reference.Spec:
        """The config as the reference's `Spec`."""
        c = self.config
        fusion = ("psi_critic",) if c.target == "heads_and_fusion" else ()
        return reference.Spec(
            modalities=(*self.images, *self.depths, *self.vectors, *self.histories),
            mlps=tuple(key for key, name in c.encoders.items() if name == "mlp"),
            strides=c.conv_strides,
            layers=c.head_layers,
            head_norm=c.head_norm,
            fused=c.latent_dim > 0,
            fusion_norm=c.fusion_norm,
            shared={"decoupled": "", "shared": "critic", "shared_by_both": "both"}[c.fusion],
            critic_alone=c.privileged,
            squash=c.fusion_layer,
            pad=c.shift_pad,
            sigma=c.noise(self.step),
            clip=c.noise_clip,
            tau=c.tau,
            learning_rate=c.step_size(self.step),
            averaged=(*fusion, *(f"phi_{k + 1}" for k in range(c.critics))),
            critics=c.critics,
            bins=c.critic_bins if c.critic_loss == "hl_gauss" else 0,
            low=c.critic_low,
            high=100.0 if c.critic_high is None else c.critic_high,
        )

    def agent(self, seed: int = 0, actions: int = ACTIONS) -> DDPG:
        """Make the agent with the package."""
        return make_agent(
            {SACConfig: "sac", BCConfig: "bc"}.get(type(self.config), "merl"),
            self.config,
            self.observation_space,
            spaces.Box(-1, 1, (actions,), np.float32),
            frame_stack=STACK,
            seed=seed,
            device=torch.device("cpu"),
        )

    def learn(
        self, agent: DDPG, batch: Batch, noise: UpdateNoise | None = None
    ) -> dict[str, Tensor]:
        """Make an update at the step of the case."""
        return agent.update(batch, noise, step=self.step)

    def batch_of(self, seed: int, dtype: torch.dtype = torch.float32) -> Batch:
        """Return a random batch, with discounts of zero and above zero."""
        rng = np.random.default_rng(seed)

        def observation() -> dict[str, Tensor]:
            images = {
                k: torch.from_numpy(_images(rng, (self.batch, STACK, *shape)))
                for k, shape in self.images.items()
            }
            vectors = {
                k: _tensor(rng.normal(size=(self.batch, *shape)), dtype)
                for k, shape in {**self._vector_shapes, **self.histories}.items()
            }
            depths = {
                k: torch.from_numpy(
                    rng.integers(-9999, 9999, (self.batch, STACK, *shape), np.int16)
                )
                for k, shape in self.depths.items()
            }
            return images | depths | vectors

        steps = rng.integers(1, 4, self.batch)  # m, less than n = 3 where an episode ends sooner
        discount = np.where(np.arange(self.batch) % 3 == 0, 0.0, GAMMA**steps)
        return Batch(
            observation=observation(),
            action=_tensor(rng.uniform(-1, 1, (self.batch, ACTIONS)), dtype),
            reward=_tensor(rng.uniform(0, 3, self.batch), dtype),
            discount=_tensor(discount, dtype),
            next_observation=observation(),
        )

    def chance_of(self, seed: int, dtype: torch.dtype = torch.float64) -> reference.Chance:
        generator = torch.Generator().manual_seed(seed)

        def shifts() -> dict[str, Tensor]:
            size = (self.batch, 2)
            return {
                k: torch.randint(0, 2 * self.config.shift_pad + 1, size, generator=generator)
                for k in (*self.images, *self.depths)
            }

        def noise() -> Tensor:
            return torch.randn(self.batch, ACTIONS, generator=generator).to(dtype)

        pair = (1, 2)
        if self.config.critics > 2:
            pair = (1 + seed % self.config.critics, 1 + (seed + 2) % self.config.critics)
        return reference.Chance(shifts(), shifts(), noise(), noise(), pair)


def named_cases(*cases: Case) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


def _images(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    brightness = rng.uniform(40, 215, (*shape[:2], 1, 1, shape[-1]))
    return np.clip(brightness + rng.normal(0, 30, shape), 0, 255).astype(np.uint8)


def _tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(dtype)


# -- the package's state, made as general as in mid-training ------------------------------------


def double(agent: DDPG) -> DDPG:
    """Convert the agent to float64, including Adam's moments."""
    agent.networks.double()
    agent.critic_target.double()
    for optimizer in (agent.critic_optimizer, agent.actor_optimizer):
        for state in optimizer.state.values():
            state |= {name: state[name].double() for name in ("exp_avg", "exp_avg_sq")}
    return agent


@torch.no_grad()
def weather(agent: DDPG, seed: int = 0) -> None:
    """Perturb biases and norms (not 0 and 1), target (not the critic), actions (to the clamp)."""
    generator = torch.Generator().manual_seed(seed)
    for module in (agent.networks, agent.critic_target):
        for p in module.parameters():
            size = 0.3 * p.std() if p.ndim > 1 else 0.1
            p += size * torch.randn(p.shape, generator=generator).to(p.dtype)
    agent.networks.actor.layers[-1].weight.mul_(3.0)


@torch.no_grad()
def fill_adam_state(agent: DDPG, steps: int = 7, seed: int = 0) -> None:
    """Set Adam's state; the second moments span many decades, so that epsilon matters too."""
    generator = torch.Generator().manual_seed(seed)
    for optimizer in (agent.critic_optimizer, agent.actor_optimizer):
        for p in [p for group in optimizer.param_groups for p in group["params"]]:
            # In the memory order of the parameter: a fused Adam reads both as raw memory.
            m, v = torch.empty_like(p), torch.empty_like(p)
            v.copy_(10 ** (-16 + 14 * torch.rand(p.shape, generator=generator)))
            m.copy_(v.sqrt() * torch.randn(p.shape, generator=generator))
            step = torch.tensor(float(steps))
            optimizer.state[p] = {"step": step, "exp_avg": m, "exp_avg_sq": v}


# -- from the package's names to the reference's -------------------------------------------------

_NAMES = [
    (
        r"encoders\.by_key\.(\w+)\.convolutions\.(\d+)\.",
        lambda m: f"xi.{m[1]}.{int(m[2]) // 2 + 1}.",
    ),
    (
        r"encoders\.by_key\.(\w+)\.layers\.(\d+)\.",
        lambda m: f"zeta.{m[1]}.{int(m[2]) // 2 + 1}.",
    ),
    (r"encoders\.by_key\.(\w+)\.(\d+)\.", lambda m: f"zeta.{m[1]}.{int(m[2]) // 2 + 1}."),
    (r"(critic|actor)_fusion\.projections\.(\w+)\.", r"psi_\1.\2."),
    (r"(critic|actor)_fusion\.norms\.(\w+)\.", r"psi_\1.\2.norm."),
    (r"(critic|actor)_fusion\.attention\.", r"psi_\1.attention."),
    (r"critic\.q(\d+)\.(\d+)\.(linear\.)?", lambda m: f"phi_{m[1]}.{int(m[2]) + 1}."),
    (r"actor\.layers\.(\d+)\.(linear\.)?", lambda m: f"theta.{int(m[1]) + 1}."),
    (r"norm\.weight", "norm.scale"),
    (r"norm\.bias", "norm.shift"),
]


def reference_name(name: str) -> str:
    for pattern, replacement in _NAMES:
        name = re.sub(pattern, replacement, name)
    return name


def named(agent: DDPG) -> dict[str, nn.Parameter]:
    """Return every parameter of the agent under the reference's name."""
    networks = {reference_name(name): p for name, p in agent.networks.named_parameters()}
    averages = {
        f"bar_{reference_name(name)}": p for name, p in agent.critic_target.named_parameters()
    }
    return networks | averages


def weights_of(agent: DDPG) -> reference.Weights:
    return {name: p.detach().to(torch.float64, copy=True) for name, p in named(agent).items()}


def gradients_of(agent: DDPG) -> reference.Weights:
    return {n: p.grad.to(torch.float64) for n, p in named(agent).items() if p.grad is not None}


def moments_of(optimizer: torch.optim.Optimizer, agent: DDPG) -> reference.Moments:
    states = {n: optimizer.state[p] for n, p in named(agent).items() if p in optimizer.state}
    steps = {int(state["step"]) for state in states.values()}
    return reference.Moments(
        t=steps.pop() if steps else 0,
        m={n: state["exp_avg"].to(torch.float64, copy=True) for n, state in states.items()},
        v={n: state["exp_avg_sq"].to(torch.float64, copy=True) for n, state in states.items()},
    )


def state_of(agent: DDPG) -> reference.State:
    """Return the agent's state as the reference's, before or after its first update."""
    weights = weights_of(agent)
    if not agent.critic_optimizer.state:
        return reference.start(weights, reference.Spec(critics=agent.config.critics))
    critic, actor = (
        moments_of(optimizer, agent)
        for optimizer in (agent.critic_optimizer, agent.actor_optimizer)
    )
    return reference.State(weights, critic, actor)


def sample_of(batch: Batch) -> reference.Sample:
    def to_double(x: Tensor) -> Tensor:
        return x.to(torch.float64) if x.is_floating_point() else x

    return reference.Sample(
        o={k: to_double(v) for k, v in batch.observation.items()},
        a=to_double(batch.action),
        r=to_double(batch.reward),
        discount=to_double(batch.discount),
        o_next={k: to_double(v) for k, v in batch.next_observation.items()},
    )


def draws_of(
    chance: reference.Chance, config: AgentConfig, dtype: torch.dtype, step: int = 0
) -> UpdateNoise:
    """Convert to the package's update noise, which is scaled and clipped."""

    def clipped(noise: Tensor) -> Tensor:
        sigma, c = config.noise(step), config.noise_clip
        return (sigma * noise).clamp(-c, c).to(dtype)

    return UpdateNoise(
        shifts=chance.shift,
        next_shifts=chance.shift_next,
        next_noise=clipped(chance.noise_next),
        actor_noise=clipped(chance.noise),
        pair=pair_of(chance, config),
    )


def pair_of(chance: reference.Chance, config: AgentConfig) -> Tensor | None:
    """Return the indices of the target's two Qs, as the package counts them."""
    return torch.tensor(chance.pair) - 1 if config.critics > 2 else None


# -- differences ---------------------------------------------------------------------------------


def error(x: Tensor, truth: Tensor) -> float:
    """Return |x - truth| / |truth| of the whole tensor."""
    return float((x.to(torch.float64) - truth).norm() / truth.norm())


def errors(x: reference.Weights, truth: reference.Weights) -> dict[str, float]:
    assert x.keys() == truth.keys()
    return {name: error(x[name], truth[name]) for name in truth}


def beyond(errors: Mapping[str, float], bound: float) -> dict[str, float]:
    """Return the errors at or over the bound; NaN is over any bound."""
    return {name: e for name, e in errors.items() if not e < bound}


def snapshot(parameters: Iterator[nn.Parameter]) -> list[tuple[Tensor, Tensor | None]]:
    """Return copies of values and gradients, for a bit-for-bit comparison."""
    return [(p.detach().clone(), None if p.grad is None else p.grad.clone()) for p in parameters]
