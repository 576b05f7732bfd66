"""MERL's update in plain PyTorch: the reference that `merl bench update` times.

Eager mode, single precision, channels first, the random shift by `grid_sample`, one Adam per
network, all in the order of Algorithm 1. DrQ-v2's own code does the same; DrQ-v2 is this agent on
images alone (`Plain(vector=0, latent=50, head_norm=False, average_fusion=True)`). This module
shares no code with the agents; a test checks that losses and gradients are equal.
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
    """A batch with stacked frames as channels.

    Attributes:
        image: uint8 (B, K C, H, W).
        vector: float32 (B, n); n is 0 without proprioception.
        action: (B, A).
        reward: (B, 1).
        discount: (B, 1).
        next_image: `image` of o_{t+n}.
        next_vector: `vector` of o_{t+n}.
    """

    image: Tensor
    vector: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_image: Tensor
    next_vector: Tensor


class Shift(nn.Module):
    """Random shift by up to `pad` pixels, as a bilinear sample of a padded image."""

    def __init__(self, pad: int) -> None:
        super().__init__()
        self.pad = pad

    def forward(self, image: Tensor, offset: Tensor | None = None) -> Tensor:
        """Shift images (B, C, H, H) by `offset` (B, 2): x, y in [0, 2 pad]; random if None."""
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
        """Encode images (B, C, H, H) in [0, 255] as features (B, F)."""
        encoded: Tensor = self.layers(image / 255.0 - 0.5)
        return encoded.flatten(1)


class Fuse(nn.Module):
    """Linear, LayerNorm and tanh for each modality, concatenated."""

    def __init__(self, features: Iterable[int], latent: int) -> None:
        super().__init__()
        sizes = [size for size in features if size]
        share = latent // len(sizes)
        self.parts = nn.ModuleList(
            nn.Sequential(nn.Linear(size, share), nn.LayerNorm(share), nn.Tanh()) for size in sizes
        )

    def forward(self, *encoded: Tensor) -> Tensor:
        """Fuse features (B, F) of each modality into a latent (B, d)."""
        return torch.cat([part(e) for part, e in zip(self.parts, encoded, strict=False)], dim=-1)


def head(inputs: int, outputs: int, layers: int, width: int, norm: bool) -> nn.Sequential:
    """Return blocks of Linear, LayerNorm (if `norm`) and ReLU, then a last Linear."""
    parts: list[nn.Module] = []
    for _ in range(layers - 1):
        parts += [nn.Linear(inputs, width), *([nn.LayerNorm(width)] if norm else []), nn.ReLU()]
        inputs = width
    return nn.Sequential(*parts, nn.Linear(inputs, outputs))


class Critic(nn.Module):
    """Fusion and two Q heads."""

    def __init__(self, fuse: Fuse, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.fuse, self.first, self.second = fuse, first, second

    def forward(self, encoded: tuple[Tensor, Tensor], action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the two values (B, 1) of encodings and an action (B, A)."""
        return self.values(self.fuse(*encoded), action)

    def values(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return the two values (B, 1) of a latent (B, d) and an action (B, A)."""
        both = torch.cat([latent, action], dim=-1)
        return self.first(both), self.second(both)


class Plain:
    """The agent: MERL or, on images alone, DrQ-v2.

    Args:
        channels: channels of the stacked image.
        side: height and width of the image.
        vector: size of the proprioception; 0 for images alone.
        actions: size A of an action.
        layers: layers of each head, including the last one.
        width: hidden width of the heads.
        latent: size d of the latent.
        head_norm: whether the heads have LayerNorm.
        average_fusion: whether the target averages the critic's fusion too, as in DrQ-v2.
        pad: largest shift in pixels, in each direction.
        learning_rate: learning rate of each Adam.
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
        """Move the agent to a device and return it."""
        for module in (self.encoder, self.critic, self.critic_target, self.actor_fuse, self.actor):
            module.to(device)
        return self

    def update(self, sample: Sample) -> tuple[Tensor, Tensor]:
        """Make one update with random noise and shifts; return the two losses."""
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
        """Make one update with the given noise and shifts; return the two losses."""
        dtype = sample.action.dtype
        image = self.shift(sample.image.to(dtype), offset)
        next_image = self.shift(sample.next_image.to(dtype), next_offset)
        encoded = self.encoder(image), sample.vector
        with torch.no_grad():
            next_encoded = self.encoder(next_image), sample.next_vector
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
        noisy = self.policy(encoded) + noise
        action = noisy + (noisy.clamp(-1.0, 1.0) - noisy).detach()
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
        """Return the mean action (B, A)."""
        return torch.tanh(self.actor(self.actor_fuse(*encoded)))
