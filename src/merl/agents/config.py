"""What an agent is made of and how it learns, as values: every agent is a choice of these."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

from merl.core import MerlError, check_choice
from merl.networks.fusion import Squash
from merl.networks.returns import HLGauss

Precision = Literal["auto", "fp32", "bf16"]
Target = Literal["heads", "heads_and_fusion"]
CriticLoss = Literal["mse", "hl_gauss"]
FusionOwner = Literal["decoupled", "shared", "shared_by_both"]
TorchCompile = Literal["auto", "yes", "no"]

WIDEST = 65_536
"""More than any layer here has ever been given."""


@dataclass(frozen=True)
class AgentConfig:
    """What an agent is made of and how it learns; the values are Table 1's and Appendix C.1's."""

    images: tuple[str, ...] | None = None
    """Image keys to see; every one that the environment gives, if not set."""
    vectors: tuple[str, ...] | None = None
    """Vector keys to feel; if not set, every one that the environment gives and that is not for the
    critic alone. Of merl's own tasks `state` is used only if it is named."""
    privileged: tuple[str, ...] = ()
    """Vector keys that the critic alone is told, e.g. `state`: what is known in training only."""
    learning_rate: float = 1e-4
    """Adam's step size, for every network."""
    critic_loss: CriticLoss = "mse"
    """How the critic learns its target: by the mean squared error, or as a histogram over bins by
    cross-entropy (hl_gauss; Farebrother et al. 2024)."""
    critic_bins: int = 101
    """Bins of that histogram, the three beyond each bound included."""
    critic_low: float = 0.0
    """The lowest return that the histogram can hold, in the unit of the rewards. Lower targets
    count as this one: with rewards below 0 set it."""
    critic_high: float | None = None
    """The highest; if not set, 1 / (1 - discount), which no return exceeds as long as rewards lie
    in [0, 1]. Higher targets count as this one: with rewards above 1 set it."""
    actor_every: int = 1
    """The actor learns in every n-th update only (delayed policy updates, TD3); critic, encoders
    and target learn in all."""
    actor_average: float | None = None
    """Evaluate and deploy an exponential moving average of the actor and its fusion, which moves by
    this share towards the newest weights whenever the actor learns, in (0, 1], e.g. 0.001; if not
    set, the newest weights. Exploration and updates always use the newest."""
    tau: float = 0.01
    """How far the target network moves towards the critic at each update, in (0, 1]."""
    noise_std: float = 0.2
    """Standard deviation of the exploration noise, also used in both updates."""
    noise_std_end: float | None = None
    """What it falls to, in a straight line over `noise_steps`; it stays as it is, if not set."""
    noise_steps: int = 500_000
    """Environment steps over which it falls."""
    noise_correlation: float = 0.0
    """How much of the exploration noise stays from one action to the next, in [0, 1); its standard
    deviation is the same. In updates the noise is drawn anew."""
    noise_clip: float = 0.3
    """Bound of the noise in both updates; when acting it is not clipped."""
    target: Target = "heads"
    """What has an averaged copy: the Q-heads (MERL), or the critic's fusion too, as DrQ-v2's target
    covers its trunk."""
    latent_dim: int = 128
    """d, the length of the fused representation: an equal share for each modality, rounded down; 0
    leaves the fusion out: the encodings go to the heads as they are."""
    fusion: FusionOwner = "decoupled"
    """Whose the fusion is (Figure 3a): one each for critic and actor, or one that both use, which
    the critic's loss moves, or both losses."""
    fusion_norm: bool = True
    """LayerNorm in the fusion (Figure 3c)."""
    squash: Squash = "tanh"
    """What bounds the fused representation: tanh, or a softmax over groups of eight."""
    shift_pad: int = 4
    """Random shift: how many pixels to each side."""
    conv_channels: int = 32
    """Channels of each of the image encoder's convolutions."""
    conv_strides: tuple[int, ...] = (2, 1, 1, 1)
    """Strides of the image encoder's convolutions."""
    vector_encoder_dim: int = 0
    """Width of the MLP that encodes each vector; 0 is the identity (Figure 5)."""
    standardize: bool = False
    """Bring the numbers of a vector to one scale, by the mean and the deviation of the first
    batches; the paper takes them as they are."""
    head_layers: int = 3
    """Linear layers of actor and critic, the output layer counted (paper: 3 for reach, else 6)."""
    hidden_dim: int = 1024
    """Width of the hidden layers of actor and critic."""
    head_norm: bool = True
    """LayerNorm in the hidden layers of actor and critic."""
    precision: Precision = "auto"
    """Arithmetic of the update: fp32, bf16 (weights, norms, targets and losses stay fp32), or auto,
    which times both once."""
    torch_compile: TorchCompile = "auto"
    """Whether torch compiles what updates compute, which takes a minute or two: yes, no, or auto,
    which tries it once on a GPU, for a run that takes long, and keeps it where it is faster."""

    def __post_init__(self) -> None:
        if not 0 < self.learning_rate < math.inf:
            raise MerlError(f"agent.learning-rate must be above 0, not {self.learning_rate}")
        for name, choice, choices in (
            ("precision", self.precision, get_args(Precision)),
            ("target", self.target, get_args(Target)),
            ("squash", self.squash, get_args(Squash)),
            ("critic-loss", self.critic_loss, get_args(CriticLoss)),
            ("fusion", self.fusion, get_args(FusionOwner)),
            ("torch-compile", self.torch_compile, get_args(TorchCompile)),
        ):
            check_choice(f"agent.{name}", choice, choices)
        for name, value in self._given("tau", "actor_average"):
            if not 0 < value <= 1:
                raise MerlError(f"agent.{_flag(name)} must lie in (0, 1], not {value}")
        for name, value in self._given("noise_std", "noise_std_end"):
            if not 0 <= value < math.inf:
                raise MerlError(f"agent.{_flag(name)} must be at least 0, not {value}")
        if not 0 <= self.noise_correlation < 1:
            raise MerlError(
                f"agent.noise-correlation must lie in [0, 1), not {self.noise_correlation}"
            )
        if not self.noise_clip >= 0:
            raise MerlError(f"agent.noise-clip must be at least 0, not {self.noise_clip}")
        least = {"conv_channels": 1, "head_layers": 1, "hidden_dim": 1, "noise_steps": 1}
        least["critic_bins"] = HLGauss.FEWEST
        least |= {"actor_every": 1, "latent_dim": 0, "shift_pad": 0, "vector_encoder_dim": 0}
        for name, bound in least.items():
            most = WIDEST if name != "noise_steps" else 10**12
            if not bound <= getattr(self, name) <= most:
                raise MerlError(
                    f"agent.{_flag(name)} must be at least {bound} and at most {most}, "
                    f"not {getattr(self, name)}"
                )
        self._check_histogram()
        for name in ("fusion", "fusion_norm", "squash"):
            if self.latent_dim == 0 and getattr(self, name) != getattr(AgentConfig, name):
                raise MerlError(
                    f"agent.{_flag(name)} {getattr(self, name)} is of a fusion, and with "
                    "agent.latent-dim 0 there is none: leave it out, or give a latent-dim"
                )
        if not self.conv_strides or min(self.conv_strides) < 1:
            raise MerlError(
                f"agent.conv-strides {self.conv_strides} must name a stride of at least 1 for each "
                "convolution"
            )

    def _given(self, *names: str) -> Iterator[tuple[str, float]]:
        """Those of these fields that are set, with their values."""
        return ((name, value) for name in names if (value := getattr(self, name)) is not None)

    def _check_histogram(self) -> None:
        for name in ("critic_bins", "critic_low", "critic_high"):
            value = getattr(self, name)
            if self.critic_loss == "mse" and value != getattr(AgentConfig, name):
                raise MerlError(
                    f"agent.{_flag(name)} {value} is of a histogram, and agent.critic-loss mse "
                    "has none: leave it out, or use --agent.critic-loss hl_gauss"
                )
            if value is not None and not math.isfinite(value):
                raise MerlError(f"agent.{_flag(name)} must be finite, not {value}")
        if self.critic_high is not None and not self.critic_low < self.critic_high:
            raise MerlError(
                f"agent.critic-high must be above agent.critic-low {self.critic_low}, "
                f"not {self.critic_high}"
            )

    def noise(self, step: int) -> float:
        """The standard deviation of the exploration noise after `step` environment steps."""
        if self.noise_std_end is None:
            return self.noise_std
        share = min(step / self.noise_steps, 1.0)
        return self.noise_std + share * (self.noise_std_end - self.noise_std)


def _flag(name: str) -> str:
    return name.replace("_", "-")
