"""MERL's update as a careful newcomer would write it: the reference that `bench update` times.

Eager single precision, channels first, the shift by `grid_sample`, an Adam per network, everything
in the order of Algorithm 1: what DrQ-v2's own code does, too, which is this agent on pixels alone
(`Plain(vector=0, latent=50, head_norm=False, average_fusion=True)`). It shares no code with the
agents; a test holds their losses and gradients together.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional


@dataclass(frozen=True)
class Sample:
    """A batch as such code keeps it: stacked frames as channels.

    Attributes:
        image: uint8 (B, K C, H, W).
        vector: float32 (B, n); n is 0 where there are no joints.
        action: (B, A).
        reward: (B, 1).
        discount: (B, 1).
        next_image: of o_{t+n}.
        next_vector: of o_{t+n}.
    """

    image: Tensor
    vector: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_image: Tensor
    next_vector: Tensor


class Shift(nn.Module):
    """Random shift by up to `pad` pixels, as a bilinear sample of a padded picture."""

    def __init__(self, pad: int) -> None:
        super().__init__()
        self.pad = pad

    def forward(self, image: Tensor, offset: Tensor | None = None) -> Tensor:
        """(B, C, H, H) to the same; `offset` (B, 2) in [0, 2 pad] is x, y, else drawn."""
        batch, _, side, _ = image.shape
        padded = functional.pad(image, (self.pad,) * 4, mode="replicate")
        whole = side + 2 * self.pad
        centre = torch.arange(side, device=image.device, dtype=image.dtype) * 2 + 1
        line = centre / whole - 1.0  # grid_sample's coordinates of the first `side` pixels
        grid = torch.stack(torch.meshgrid(line, line, indexing="xy"), dim=-1)
        if offset is None:
            offset = torch.randint(0, 2 * self.pad + 1, (batch, 2), device=image.device)
        moved = offset.to(image.dtype).view(batch, 1, 1, 2) * 2.0 / whole
        return functional.grid_sample(
            padded, grid + moved, padding_mode="zeros", align_corners=False
        )


class Encoder(nn.Module):
    """Four convolutions, 3x3, 32 channels, strides 2, 1, 1, 1."""

    def __init__(self, channels: int, side: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for stride in (2, 1, 1, 1):
            layers += [nn.Conv2d(channels, 32, 3, stride=stride), nn.ReLU()]
            channels, side = 32, (side - 3) // stride + 1
        self.layers = nn.Sequential(*layers)
        self.features = 32 * side * side

    def forward(self, image: Tensor) -> Tensor:
        """(B, C, H, H) in [0, 255] to (B, F)."""
        encoded: Tensor = self.layers(image / 255.0 - 0.5)
        return encoded.flatten(1)


class Fuse(nn.Module):
    """Linear, LayerNorm, tanh for each modality, side by side."""

    def __init__(self, features: Iterable[int], latent: int) -> None:
        super().__init__()
        sizes = [size for size in features if size]
        share = latent // len(sizes)
        self.parts = nn.ModuleList(
            nn.Sequential(nn.Linear(size, share), nn.LayerNorm(share), nn.Tanh()) for size in sizes
        )

    def forward(self, *encoded: Tensor) -> Tensor:
        """(B, F) of each modality to (B, d)."""
        return torch.cat([part(e) for part, e in zip(self.parts, encoded, strict=False)], dim=-1)


def head(inputs: int, outputs: int, layers: int, width: int, norm: bool) -> nn.Sequential:
    """Linear (LayerNorm) ReLU, and a last Linear."""
    parts: list[nn.Module] = []
    for _ in range(layers - 1):
        parts += [nn.Linear(inputs, width), *([nn.LayerNorm(width)] if norm else []), nn.ReLU()]
        inputs = width
    return nn.Sequential(*parts, nn.Linear(inputs, outputs))


class Critic(nn.Module):
    """Fusion and two values."""

    def __init__(self, fuse: Fuse, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.fuse, self.first, self.second = fuse, first, second

    def forward(self, encoded: tuple[Tensor, Tensor], action: Tensor) -> tuple[Tensor, Tensor]:
        """Encodings and action (B, A) to the two values, (B, 1)."""
        return self.values(self.fuse(*encoded), action)

    def values(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The same from what is fused already."""
        both = torch.cat([latent, action], dim=-1)
        return self.first(both), self.second(both)


class Plain:
    """The agent.

    Args:
        channels: of the stacked picture.
        side: height and width of it.
        vector: length of what the joints tell; 0 is pixels alone.
        actions: A.
        layers: of the heads, the last one counted.
        width: of the heads.
        latent: d.
        head_norm: LayerNorm in the heads.
        average_fusion: whether the target averages the critic's fusion too, as DrQ-v2's does.
        pad: of the shift.
    """

    tau, noise, clip = 0.01, 0.2, 0.3

    def __init__(
        self,
        channels: int,
        side: int,
        vector: int,
        actions: int,
        *,
        layers: int,
        width: int = 1024,
        latent: int = 128,
        head_norm: bool = True,
        average_fusion: bool = False,
        pad: int = 4,
        learning_rate: float = 1e-4,
    ) -> None:
        self.shift = Shift(pad)
        self.encoder = Encoder(channels, side)
        features = (self.encoder.features, vector)
        size = (layers, width, head_norm)
        values = (head(latent + actions, 1, *size) for _ in range(2))
        self.critic = Critic(Fuse(features, latent), *values)
        self.critic_target = copy.deepcopy(self.critic)
        if not average_fusion:
            self.critic_target.fuse = self.critic.fuse
        self.actor_fuse = Fuse(features, latent)
        self.actor = head(latent, actions, *size)
        actor = [*self.actor_fuse.parameters(), *self.actor.parameters()]
        self.encoder_adam = torch.optim.Adam(self.encoder.parameters(), lr=learning_rate)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=learning_rate)
        self.actor_adam = torch.optim.Adam(actor, lr=learning_rate)

    def to(self, device: torch.device) -> Plain:
        """The same agent, moved there."""
        for module in (self.encoder, self.critic, self.critic_target, self.actor_fuse, self.actor):
            module.to(device)
        return self

    def update(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """One update with its own random numbers; the two losses."""
        noise, next_noise = (
            (torch.randn_like(sample.action) * self.noise).clamp(-self.clip, self.clip)
            for _ in range(2)
        )
        return self.learn(sample, noise, next_noise)

    def learn(
        self,
        sample: Sample,
        noise: Tensor,
        next_noise: Tensor,
        offset: Tensor | None = None,
        next_offset: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One update with its random numbers given."""
        dtype = sample.action.dtype
        picture = self.shift(sample.image.to(dtype), offset)
        next_picture = self.shift(sample.next_image.to(dtype), next_offset)
        encoded = self.encoder(picture), sample.vector
        with torch.no_grad():
            next_encoded = self.encoder(next_picture), sample.next_vector
            next_action = (self.policy(next_encoded) + next_noise).clamp(-1.0, 1.0)
            target = torch.min(*self.critic_target(next_encoded, next_action))
            target = sample.reward + sample.discount * target
        first, second = self.critic(encoded, sample.action)
        critic_loss = functional.mse_loss(first, target) + functional.mse_loss(second, target)
        self.encoder_adam.zero_grad()
        self.critic_adam.zero_grad()
        critic_loss.backward()  # type: ignore[no-untyped-call]
        self.encoder_adam.step()
        self.critic_adam.step()

        encoded = encoded[0].detach(), encoded[1]
        wanted = self.policy(encoded) + noise
        action = wanted + (wanted.clamp(-1.0, 1.0) - wanted).detach()
        with torch.no_grad():
            latent = self.critic.fuse(*encoded)
        actor_loss = -torch.min(*self.critic.values(latent, action)).mean()
        self.actor_adam.zero_grad()
        actor_loss.backward()  # type: ignore[no-untyped-call]
        self.actor_adam.step()

        with torch.no_grad():
            pairs = zip(self.critic.parameters(), self.critic_target.parameters(), strict=True)
            for recent, average in pairs:
                if average is not recent:
                    average.copy_(self.tau * recent + (1 - self.tau) * average)
        return critic_loss.detach(), actor_loss.detach()

    def policy(self, encoded: tuple[Tensor, Tensor]) -> Tensor:
        """The mean action."""
        return torch.tanh(self.actor(self.actor_fuse(*encoded)))
