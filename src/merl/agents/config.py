"""Config of an agent: the keys that it observes, its networks, and how it learns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from merl.core import Kind, MerlError
from merl.core.fields import NOT_EMPTY, Range, check_fields
from merl.networks.fusion import FusionLayer
from merl.networks.returns import HLGauss

Precision = Literal["auto", "fp32", "bf16"]
Target = Literal["heads", "heads_and_fusion"]
CriticLoss = Literal["mse", "hl_gauss"]
FusionOwner = Literal["decoupled", "shared", "shared_by_both"]
TorchCompile = Literal["auto", "yes", "no"]

WIDEST = 65_536
"""Upper bound of layer widths and other counts in the config."""
Count = Annotated[int, Range(1, WIDEST)]
Width = Annotated[int, Range(0, WIDEST)]
Positive = Annotated[float, Range(0, without=0)]
NotNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1, without=0)]


@dataclass(frozen=True)
class ObservationConfig:
    """Base of every agent's config: the keys that it observes."""

    keys: tuple[str, ...] | None = None
    """Observation keys to use; if not set, every key of the kinds in `modalities`, except the
    privileged ones. In merl's own tasks, `state` is used only if it is named."""
    modalities: tuple[Kind, ...] = get_args(Kind)
    """Kinds of observations to use if `keys` is not set."""
    privileged: tuple[str, ...] = ()
    """Keys that only the critic observes, e.g. `state`: known in training only (asymmetric
    critic)."""

    def __post_init__(self) -> None:
        check_fields(self, "agent.")


@dataclass(frozen=True)
class UnloadedConfig(ObservationConfig):
    """Config of a user's agent, as recorded in a run, before the agent's code is imported."""

    values: Mapping[str, Any] = field(default_factory=dict)
    """Every recorded value, by name."""


@dataclass(frozen=True)
class AgentConfig(ObservationConfig):
    """Networks of an agent and how it learns; the defaults are from Table 1 and Appendix C.1.

    Each agent of merl is a choice of these values.
    """

    encoders: dict[str, str] = field(default_factory=dict)
    """Encoder of a key, by its name (`--agent.encoders.wrist impala`): conv, impala or a model of
    timm for images; identity, mlp, conv1d or transformer for numbers; or `module:Class`. If not
    set: conv for images, identity for vectors, conv1d for histories."""
    encoder_weights: dict[str, str] = field(default_factory=dict)
    """File with the initial weights of a key's encoder, for models of timm. It is read once, when
    the run starts."""
    frozen_encoders: tuple[str, ...] = ()
    """Keys whose encoders are not trained."""
    start_from: Path | None = None
    """Run whose policy the agent starts with, e.g. one of agent `bc`: encoders, the actor's fusion
    and the actor, which must have the same sizes. It is read once, when the run starts."""
    learning_rate: Positive = 1e-4
    """Step size of Adam, for every network."""
    learning_rate_end: Positive | None = None
    """Step size at the end of a linear decay over `learning_rate_steps`; if not set, it is
    constant."""
    learning_rate_steps: Annotated[int, Range(1, 10**12)] = 500_000
    """Environment steps of the decay of the step size."""
    critics: Annotated[int, Range(2, 100)] = 2
    """Q-functions. A target is the smaller of two values, and so is what the actor follows. With
    more than two (RLPD: 10), a target's two are drawn at random for each update, and the actor
    follows the mean of all."""
    critic_loss: CriticLoss = "mse"
    """Loss of the critic: the mean squared error (mse), or the cross-entropy of a histogram of
    returns (hl_gauss; Farebrother et al. 2024)."""
    critic_bins: Annotated[int, Range(HLGauss.FEWEST, WIDEST)] = 101
    """Bins of the histogram, including three beyond each bound."""
    critic_low: float = 0.0
    """Lowest return of the histogram, in units of reward. Lower targets are clipped to it: set it
    if rewards can be below 0."""
    critic_high: float | None = None
    """Highest return of the histogram; if not set, action_repeat / (1 - discount), the bound for
    rewards in [0, 1]. Higher targets are clipped to it: set it if rewards can be above 1."""
    actor_average: Share | None = None
    """Evaluate and deploy an exponential moving average of the actor and its fusion. This is the
    weight of the newest weights at each update, in (0, 1], e.g. 0.001; if not set, there is no
    average. Exploration and updates always use the newest weights."""
    tau: Share = 0.01
    """Weight of the critic in the target network's moving average at each update, in (0, 1]."""
    noise_std: NotNegative = 0.2
    """Standard deviation of the exploration noise, also used in updates of critic and actor."""
    noise_std_end: NotNegative | None = None
    """Final standard deviation, reached linearly over `noise_steps`; if not set, it is constant."""
    noise_steps: Annotated[int, Range(1, 10**12)] = 500_000
    """Environment steps over which the standard deviation changes."""
    noise_correlation: Annotated[float, Range(0, 1, without=1)] = 0.0
    """Correlation of the exploration noise between consecutive actions, in [0, 1). Its standard
    deviation does not change. In updates the noise is uncorrelated."""
    noise_clip: NotNegative = 0.3
    """Bound of the noise in the updates of critic and actor; when acting, noise is not clipped."""
    clone_weight: NotNegative = 0.0
    """Weight of a term in the actor's loss that clones the demonstrations (`--demos`): the
    squared error of its actions, in units of the mean absolute value of the critic."""
    clone_better: bool = False
    """Clone the run's own actions too, where the critic rates them above the actor's (Q-filter).
    The squared error is then a mean over the whole batch, in which other own actions count as 0."""
    clone_steps: Annotated[int, Range(1, 10**12)] | None = None
    """Environment steps over which that weight falls to 0; if not set, it is constant."""
    target: Target = "heads"
    """Networks that have a target copy: the Q-heads (MERL), or the critic's fusion too, as DrQ-v2's
    target includes its trunk."""
    latent_dim: Width = 128
    """d, the length of the fused representation: an equal share for each modality, rounded down. 0
    disables the fusion: the heads receive the concatenated encodings."""
    fusion: FusionOwner = "decoupled"
    """Fusions of critic and actor (Figure 3a): one each (decoupled), or one for both, trained by
    the critic's loss (shared) or by both losses (shared_by_both)."""
    fusion_layer: FusionLayer = "tanh"
    """What the fusion applies to each key's linear projection: tanh (MERL), a softmax over groups
    of eight numbers (simnorm), or attention between the keys and tanh (attention)."""
    fusion_norm: bool = True
    """LayerNorm in the fusion (Figure 3c)."""
    shift_pad: Width = 4
    """Random shift, in pixels to each side; 0 disables it."""
    conv_channels: Count = 32
    """Channels of each convolution of the image encoder."""
    conv_strides: Annotated[tuple[Count, ...], NOT_EMPTY] = (2, 1, 1, 1)
    """Strides of the image encoder's convolutions."""
    mlp_dim: Count = 64
    """Width of encoder `mlp` (Figure 5)."""
    standardize: bool = False
    """Standardise vectors and histories by the mean and the deviation of the first batches; the
    paper uses raw vectors."""
    head_layers: Count = 3
    """Linear layers of actor and critic, with the output layer (paper: 3 for reach, else 6)."""
    hidden_dim: Count = 1024
    """Width of the hidden layers of actor and critic."""
    head_norm: bool = True
    """LayerNorm in the hidden layers of actor and critic."""
    precision: Precision = "auto"
    """Arithmetic of the update: fp32, bf16 (weights, norms, targets and losses stay fp32), or auto,
    which times both once and chooses."""
    torch_compile: TorchCompile = "auto"
    """Whether to compile the update with torch, which takes a minute or two: yes, no, or auto,
    which tries it once on a GPU in a long run, and keeps it if it is faster."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_histogram()
        if self.clone_better and not self.clone_weight:
            raise MerlError(
                "agent.clone-better is an option of the cloning term, and agent.clone-weight 0 "
                "disables it: set a weight"
            )
        if self.privileged and self.fusion != "decoupled":
            raise MerlError(
                f"agent.privileged {self.privileged} needs separate fusions for critic and actor: "
                f"use --agent.fusion decoupled instead of {self.fusion}"
            )
        for name in ("fusion", "fusion_norm", "fusion_layer"):
            if self.latent_dim == 0 and getattr(self, name) != getattr(AgentConfig, name):
                raise MerlError(
                    f"agent.{_flag(name)} {getattr(self, name)} is an option of the fusion, "
                    "which agent.latent-dim 0 disables: remove it, or set a latent-dim above 0"
                )

    def _check_histogram(self) -> None:
        for name in ("critic_bins", "critic_low", "critic_high"):
            value = getattr(self, name)
            if self.critic_loss == "mse" and value != getattr(AgentConfig, name):
                raise MerlError(
                    f"agent.{_flag(name)} {value} is an option of the histogram, and "
                    "agent.critic-loss mse has none: remove it, or use --agent.critic-loss hl_gauss"
                )
        if self.critic_high is not None and not self.critic_low < self.critic_high:
            raise MerlError(
                f"agent.critic-high must be above agent.critic-low {self.critic_low}, "
                f"not {self.critic_high}"
            )

    def noise(self, step: int) -> float:
        """Return the exploration noise's standard deviation after `step` environment steps."""
        return decayed(self.noise_std, self.noise_std_end, step / self.noise_steps)

    def step_size(self, step: int) -> float:
        """Return Adam's step size after `step` environment steps."""
        share = step / self.learning_rate_steps
        return decayed(self.learning_rate, self.learning_rate_end, share)

    def cloning(self, step: int) -> float:
        """Return the weight of the cloning term after `step` environment steps."""
        if self.clone_steps is None:
            return self.clone_weight
        return decayed(self.clone_weight, 0.0, step / self.clone_steps)


def decayed(start: float, end: float | None, share: float) -> float:
    """Return a value after this share of a linear change; constant without an end."""
    return start if end is None else start + min(share, 1.0) * (end - start)


def _flag(name: str) -> str:
    return name.replace("_", "-")
