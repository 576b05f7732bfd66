"""Reference of MERL's update, written from the paper's equations, to test the package against.

It shares no code with the package: no layer, no optimizer, no helper. One flat dict holds every
weight under its symbol in the paper, every random number is an argument, and one update is a pure
function from a state to the next. docs/explanation/paper.md lists what the paper leaves open.

    symbol          meaning
    xi.KEY          image encoder f of one camera
    zeta.KEY        proprioception encoder g of one vector (no weights if it is the identity)
    psi_critic.KEY  multimodal fusion h for the critic, one modality
    psi_actor.KEY   multimodal fusion h for the actor, one modality
    theta           actor pi
    phi_1, phi_2    critic Q; phi_3, ... in an ensemble
    bar_NAME        the exponential moving average of NAME

The gradients come from autograd; the forward computation and Adam are written out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

Weights = dict[str, Tensor]
Modalities = dict[str, Tensor]


@dataclass(frozen=True)
class Spec:
    """Values from Table 1 and appendix C.1; `averaged` names the weights that have an average."""

    modalities: tuple[str, ...] = ("image", "proprio")  # in the order of concatenation
    strides: tuple[int, ...] = (2, 1, 1, 1)
    mlps: tuple[str, ...] = ()  # modalities with an MLP; the final MERL uses the identity
    layers: int = 3  # of the actor and of each Q, including the output layer
    head_norm: bool = True
    fused: bool = True  # if False, the heads receive the concatenated encodings
    fusion_norm: bool = True
    shared: str = ""  # "", or the losses that train the shared fusion: "critic", "both"
    critic_alone: tuple[str, ...] = ()  # modalities that only the critic observes
    squash: str = "tanh"  # or "simnorm", or "attention" with tanh
    simnorm_group: int = 8
    pad: int = 4
    sigma: float = 0.2
    clip: float = 0.3
    tau: float = 0.01
    learning_rate: float = 1e-4
    critics: int = 2  # Q-functions
    bins: int = 0  # bins of the critic's histogram (HL-Gauss); 0: squared error
    low: float = 0.0  # bounds of the targets
    high: float = 100.0
    averaged: tuple[str, ...] = ("phi_1", "phi_2")  # with "psi_critic" in front: DrQ-v2's target

    @property
    def phis(self) -> list[str]:
        return [f"phi_{k}" for k in range(1, self.critics + 1)]


@dataclass(frozen=True)
class Sample:
    """(o_t, a_t, r_{t:t+n-1}, o_{t+n}) for a mini-batch: images (B, K, H, W, C), vectors (B, n)."""

    o: Modalities
    a: Tensor  # (B, A)
    r: Tensor  # (B,) the discounted sum of the rewards
    discount: Tensor  # (B,) gamma^n, or another value at the end of an episode
    o_next: Modalities


@dataclass(frozen=True)
class Chance:
    """All random numbers of one update."""

    shift: dict[str, Tensor]  # (B, 2) per image key: row and column of the crop of o_t
    shift_next: dict[str, Tensor]  # the same for o_{t+n}
    noise: Tensor  # (B, A) standard normal, for a_t in the actor's loss
    noise_next: Tensor  # (B, A) standard normal, for a_{t+n} in the target
    pair: tuple[int, int] = (1, 2)  # the two Qs of the target


@dataclass(frozen=True)
class Moments:
    """Adam's state: number of steps, and two moments of every gradient."""

    t: int
    m: Weights
    v: Weights


@dataclass(frozen=True)
class State:
    """Everything that the next update depends on, except sample and random numbers."""

    weights: Weights
    critic_adam: Moments
    actor_adam: Moments


@dataclass(frozen=True)
class Report:
    """Intermediate results of one update."""

    y: Tensor  # (B,)
    critic_loss: Tensor
    actor_loss: Tensor
    gradients: Weights


# -- the layers, (B, ...) ------------------------------------------------------------------------


def linear(w: Weights, name: str, x: Tensor) -> Tensor:
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def layer_norm(w: Weights, name: str, x: Tensor) -> Tensor:
    """Ba et al. (2016): over the features of each sample, with the biased variance."""
    mean = x.mean(-1, keepdim=True)
    variance = ((x - mean) ** 2).mean(-1, keepdim=True)
    return (x - mean) / (variance + 1e-5).sqrt() * w[f"{name}.scale"] + w[f"{name}.shift"]


def relu(x: Tensor) -> Tensor:
    return x * (x > 0)


def tanh(x: Tensor) -> Tensor:
    return 1 - 2 / (torch.exp(2 * x) + 1)


def simnorm(x: Tensor, group: int) -> Tensor:
    """Apply a softmax within every group of neighbours."""
    e = x.unflatten(-1, (-1, group)).exp()  # (B, groups, group)
    return (e / e.sum(-1, keepdim=True)).flatten(-2)


def clamp_straight_through(a: Tensor) -> Tensor:
    """Clamp the value to [-1, 1], with the gradient of the identity."""
    with torch.no_grad():
        excess = a - torch.minimum(torch.maximum(a, -torch.ones_like(a)), torch.ones_like(a))
    return a - excess


# -- section 4.1: aug, f, g, h -------------------------------------------------------------------


def aug(image: Tensor, shift: Tensor, pad: int) -> Tensor:
    """Pad each side with its edge pixels and crop at `shift`, one crop for the whole stack.

    The offset is a whole pixel, so the bilinear interpolation of section 4.1 returns the pixel.
    """
    height, width = image.shape[-3:-1]  # (B, K, H, W, C)
    rows = torch.arange(-pad, height + pad).clamp(0, height - 1)
    columns = torch.arange(-pad, width + pad).clamp(0, width - 1)
    padded = image[:, :, rows][:, :, :, columns]
    crops = [
        stack[:, top : top + height, left : left + width]
        for stack, (top, left) in zip(padded, shift.tolist(), strict=True)
    ]
    return torch.stack(crops)


def f(w: Weights, key: str, image: Tensor, spec: Spec) -> Tensor:
    """C.1's image encoder: 3x3 convolutions with ReLU; pixels are scaled to 0..1, minus 0.5.

    The pixels are bytes, or 16-bit integers of depth.
    """
    batch, frames, height, width, channels = image.shape
    low, span = (0, 255) if image.dtype == torch.uint8 else (-(2**15), 2**16 - 1)
    x = (image.to(w[f"xi.{key}.1.weight"].dtype) - low) / span - 0.5
    x = x.permute(0, 1, 4, 2, 3).reshape(batch, frames * channels, height, width)
    for i, stride in enumerate(spec.strides, 1):
        x = relu(conv2d(x, w[f"xi.{key}.{i}.weight"], w[f"xi.{key}.{i}.bias"], stride))
    return x.permute(0, 2, 3, 1).flatten(1)  # rows, columns, channels


def g(w: Weights, key: str, vector: Tensor, spec: Spec) -> Tensor:
    """C.1's proprioception encoder: the identity, or an MLP with a ReLU after each layer.

    A history (B, T, n) has three convolutions over time instead.
    """
    x = vector.to(w["theta.1.weight"].dtype)
    if x.ndim == 3:
        x = x.transpose(1, 2)
        for i in range(1, 4):
            x = relu(conv1d(x, w[f"zeta.{key}.{i}.weight"], w[f"zeta.{key}.{i}.bias"]))
        return x.flatten(1)
    for i in range(1, 3 if key in spec.mlps else 1):
        x = relu(linear(w, f"zeta.{key}.{i}", x))
    return x


def conv1d(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Convolve (B, n, T) over three samples with stride 2, with a zero on each side."""
    zero = torch.zeros_like(x[..., :1])
    windows = torch.cat([zero, x, zero], -1).unfold(-1, 3, 2)  # (B, n, T / 2, 3)
    return torch.einsum("bntk,onk->bot", windows, weight) + bias[:, None]


def encode(w: Weights, o: Modalities, shift: dict[str, Tensor], spec: Spec) -> Modalities:
    """f_xi(aug(o^image)) and g_zeta(o^prop)."""
    return {
        key: f(w, key, aug(o[key], shift[key], spec.pad), spec)
        if key in shift
        else g(w, key, o[key], spec)
        for key in spec.modalities
    }


def h(w: Weights, psi: str, r: Modalities, spec: Spec) -> Tensor:
    """C.1's fusion: for each modality one layer, LayerNorm, tanh; then concatenated, (B, d)."""
    keys = [k for k in spec.modalities if psi != "psi_actor" or k not in spec.critic_alone]
    if not spec.fused:
        return torch.cat([r[key] for key in keys], -1)
    if spec.shared and psi == "psi_actor":
        psi = "psi_critic"

    def one(key: str) -> Tensor:
        x = linear(w, f"{psi}.{key}", r[key])
        if spec.fusion_norm:
            x = layer_norm(w, f"{psi}.{key}.norm", x)
        return x

    parts = [one(key) for key in keys]
    if spec.squash == "attention":
        parts = attend(w, f"{psi}.attention", parts)
    if spec.squash == "simnorm":
        return torch.cat([simnorm(x, spec.simnorm_group) for x in parts], -1)
    return torch.cat([tanh(x) for x in parts], -1)


def attend(w: Weights, name: str, tokens: list[Tensor], heads: int = 4) -> list[Tensor]:
    """Vaswani et al. (2017): x + attention of each token to all, without masks."""
    x = torch.stack(tokens, 1)  # (B, M, c)
    queries, keys, values = (
        linear({"in.weight": weight, "in.bias": bias}, "in", x)
        for weight, bias in zip(
            w[f"{name}.in_proj_weight"].chunk(3), w[f"{name}.in_proj_bias"].chunk(3), strict=True
        )
    )
    width = x.shape[-1] // heads
    results = []
    for part in range(heads):
        cut = slice(part * width, (part + 1) * width)
        scores = queries[..., cut] @ keys[..., cut].transpose(1, 2) / width**0.5  # (B, M, M)
        share = scores.exp() / scores.exp().sum(-1, keepdim=True)
        results.append(share @ values[..., cut])
    x = x + linear(w, f"{name}.out_proj", torch.cat(results, -1))
    return [x[:, index] for index in range(len(tokens))]


# -- section 4.2: pi and Q -----------------------------------------------------------------------


def mlp(w: Weights, name: str, x: Tensor, spec: Spec) -> Tensor:
    """C.1: LayerNorm and ReLU after each layer except the last."""
    for i in range(1, spec.layers):
        x = linear(w, f"{name}.{i}", x)
        x = relu(layer_norm(w, f"{name}.{i}.norm", x) if spec.head_norm else x)
    return linear(w, f"{name}.{spec.layers}", x)


def pi(w: Weights, r_mm: Tensor, noise: Tensor, spec: Spec) -> Tensor:
    """pi_theta(r) + epsilon, epsilon ~ clip(N(0, sigma^2), -c, c); actions live in [-1, 1]."""
    epsilon = (spec.sigma * noise).clamp(-spec.clip, spec.clip)
    return clamp_straight_through(tanh(mlp(w, "theta", r_mm, spec)) + epsilon)


def output(w: Weights, phi: str, r_mm: Tensor, a: Tensor, spec: Spec) -> Tensor:
    return mlp(w, phi, torch.cat([r_mm, a], -1), spec)


def q(w: Weights, phi: str, r_mm: Tensor, a: Tensor, spec: Spec) -> Tensor:
    """Q_phi(r, a), (B,)."""
    out = output(w, phi, r_mm, a, spec)
    if not spec.bins:
        return out.squeeze(-1)
    _, left, right = bins(spec)
    p = out.exp() / out.exp().sum(-1, keepdim=True)
    return p @ ((left + right) / 2)


def bins(spec: Spec) -> tuple[float, Tensor, Tensor]:
    """HL-Gauss (Farebrother et al. 2024): width, left and right edges; three beyond each bound."""
    width = (spec.high - spec.low) / (spec.bins - 6)
    left = spec.low + width * (torch.arange(spec.bins, dtype=torch.float64) - 3)
    return width, left, left + width


def histogram(y: Tensor, spec: Spec) -> Tensor:
    """A Gaussian of 0.75 bins about y, clipped to the bounds, integrated over each bin, (B, n)."""
    width, left, right = bins(spec)
    gaussian = torch.distributions.Normal(y.clamp(spec.low, spec.high)[:, None], 0.75 * width)
    inside = gaussian.cdf(right[-1:]) - gaussian.cdf(left[:1])
    return (gaussian.cdf(right) - gaussian.cdf(left)) / inside


# -- equations 1 and 2 ---------------------------------------------------------------------------


def target(w: Weights, sample: Sample, chance: Chance, spec: Spec) -> Tensor:
    """y, below equation 1: the Q-heads are averages, encoders and fusion are the newest."""
    psi = "bar_psi_critic" if "psi_critic" in spec.averaged else "psi_critic"
    r_next = encode(w, sample.o_next, chance.shift_next, spec)
    a_next = pi(w, h(w, "psi_actor", r_next, spec), chance.noise_next, spec)
    r_mm_next = h(w, psi, r_next, spec)
    return sample.r + sample.discount * q_target(w, r_mm_next, a_next, chance, spec)


def q_target(w: Weights, r_mm: Tensor, a: Tensor, chance: Chance, spec: Spec) -> Tensor:
    """The smaller of two averages: clipped double Q, in an ensemble of a random pair (REDQ)."""
    return torch.minimum(*(q(w, f"bar_phi_{k}", r_mm, a, spec) for k in chance.pair))


def q_actor(w: Weights, r_mm: Tensor, a: Tensor, spec: Spec) -> Tensor:
    """The smaller of two, or the mean of an ensemble (REDQ, RLPD)."""
    values = [q(w, phi, r_mm, a, spec) for phi in spec.phis]
    return torch.minimum(*values) if len(values) == 2 else sum(values) / len(values)


def critic_loss(w: Weights, r: Modalities, a: Tensor, y: Tensor, spec: Spec) -> Tensor:
    """Equation 1, the sum over k."""
    r_mm = h(w, "psi_critic", r, spec)
    if spec.bins:
        logits = [output(w, phi, r_mm, a, spec) for phi in spec.phis]
        log_p = [x - x.exp().sum(-1, keepdim=True).log() for x in logits]
        return sum(-(histogram(y, spec) * each).sum(-1).mean() for each in log_p)
    errors = [q(w, phi, r_mm, a, spec) - y for phi in spec.phis]
    return sum((error**2).mean() for error in errors)


def actor_loss(w: Weights, r: Modalities, noise: Tensor, spec: Spec) -> Tensor:
    """Equation 2; the critic's latent of o_t is constant, even if its fusion is trained here."""
    a = pi(w, h(w, "psi_actor", r, spec), noise, spec)
    r_mm = h(w, "psi_critic", r, spec).detach()
    return -q_actor(w, r_mm, a, spec).mean()


# -- algorithm 1 ---------------------------------------------------------------------------------

ACTOR_LEARNS = ("psi_actor", "theta")


def critic_learns(spec: Spec) -> tuple[str, ...]:
    """Return the symbols that the critic's loss trains."""
    return ("xi", "zeta", "psi_critic", *spec.phis)


def actor_learns(spec: Spec) -> tuple[str, ...]:
    """Return the symbols that the actor's loss trains; both losses may train a shared fusion."""
    return ("psi_critic", "theta") if spec.shared == "both" else ACTOR_LEARNS


def of(weights: Iterable[str], symbols: Iterable[str]) -> list[str]:
    """Return the names that belong to one of these symbols."""
    return [name for name in weights if name.split(".")[0] in tuple(symbols)]


def gradients(loss: Callable[[Weights], Tensor], w: Weights, names: list[str]) -> Weights:
    """Return the gradients of a loss with respect to the named weights only."""
    leaves = {name: w[name].detach().clone().requires_grad_() for name in names}
    return dict(
        zip(names, torch.autograd.grad(loss(w | leaves), list(leaves.values())), strict=True)
    )


def adam(w: Weights, moments: Moments, g: Weights, spec: Spec) -> tuple[Weights, Moments]:
    """Kingma & Ba (2015), algorithm 1, with their defaults."""
    beta_1, beta_2, eps, t = 0.9, 0.999, 1e-8, moments.t + 1
    m = {name: beta_1 * moments.m[name] + (1 - beta_1) * g[name] for name in g}
    v = {name: beta_2 * moments.v[name] + (1 - beta_2) * g[name] ** 2 for name in g}
    moved = {
        name: w[name]
        - spec.learning_rate
        * (m[name] / (1 - beta_1**t))
        / ((v[name] / (1 - beta_2**t)).sqrt() + eps)
        for name in g
    }
    return w | moved, Moments(t, m, v)


def average(w: Weights, spec: Spec) -> Weights:
    """bar_phi <- (1 - tau) bar_phi + tau phi."""
    return w | {
        f"bar_{name}": (1 - spec.tau) * w[f"bar_{name}"] + spec.tau * w[name]
        for name in of(w, spec.averaged)
    }


def update(state: State, sample: Sample, chance: Chance, spec: Spec) -> tuple[State, Report]:
    """UPDATECRITIC, then UPDATEACTOR on the same sample.

    The actor uses the features of o_t from before the critic's step, as constants. Its loss uses
    the critic's fusion and heads from after that step.
    """
    w = state.weights
    y = target(w, sample, chance, spec)
    features = encode(w, sample.o, chance.shift, spec)

    def eq_1(w: Weights) -> Tensor:
        return critic_loss(w, encode(w, sample.o, chance.shift, spec), sample.a, y, spec)

    loss_1, g_1 = eq_1(w), gradients(eq_1, w, of(w, critic_learns(spec)))
    w, critic_adam = adam(w, state.critic_adam, g_1, spec)

    def eq_2(w: Weights) -> Tensor:
        return actor_loss(w, features, chance.noise, spec)

    loss_2, g_2 = eq_2(w), gradients(eq_2, w, of(w, actor_learns(spec)))
    w, actor_adam = adam(w, state.actor_adam, g_2, spec)
    # Last, as in DrQ-v2: it matters only if the actor's loss trains weights with an average.
    w = average(w, spec)

    return State(w, critic_adam, actor_adam), Report(y, loss_1, loss_2, g_1 | g_2)


def start(weights: Weights, spec: Spec) -> State:
    """Return the state before the first step of Adam."""

    def zeros(symbols: tuple[str, ...]) -> Moments:
        names = of(weights, symbols)
        return Moments(
            0,
            {name: torch.zeros_like(weights[name]) for name in names},
            {name: torch.zeros_like(weights[name]) for name in names},
        )

    return State(dict(weights), zeros(critic_learns(spec)), zeros(actor_learns(spec)))
