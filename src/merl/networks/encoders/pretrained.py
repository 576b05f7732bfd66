"""Encoders from the library timm, with weights from a local file."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from merl.core import MerlError
from merl.modalities import Frames

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet's RGB channels, in [0, 1]."""


def has_timm() -> bool:
    """Return whether timm is installed."""
    return find_spec("timm") is not None


def is_timm_model(name: str) -> bool:
    """Return whether timm is installed and has a model of this name."""
    if not has_timm():
        return False
    import timm

    return bool(timm.is_model(name))


class TimmEncoder(nn.Module):
    """A model of timm without its classifier, applied to each frame of a stack.

    Its normalisation layers use their stored statistics and do not learn new ones, so that acting
    and updates compute the same. The initialisation is timm's.

    Args:
        name: name of the model.
        frames: the modality; a single channel is repeated for a model of three channels.
        stack: number of frames in a stack.

    Attributes:
        features: length of the output.

    Raises:
        MerlError: the frames have neither one nor three channels, or are too small for the model.
    """

    keeps_weights = True

    def __init__(self, name: str, frames: Frames, stack: int) -> None:
        super().__init__()
        import timm

        height, width, self._channels = frames.shape
        if self._channels not in (1, 3):
            raise MerlError(
                f"encoder {name!r} encodes images with one or three channels, not "
                f"{self._channels}: use encoder conv or impala"
            )
        self._name, self._stack = name, stack
        self.model: Any = timm.create_model(name, pretrained=False, num_classes=0)
        self.mean = nn.Buffer(torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.deviation = nn.Buffer(torch.tensor(DEVIATION).view(3, 1, 1), persistent=False)
        self.eval()
        try:
            with torch.no_grad():
                pixels = torch.zeros(1, stack * self._channels, height, width)
                self.features = self(pixels).shape[1]
        except (RuntimeError, AssertionError) as error:
            raise MerlError(
                f"encoder {name!r} cannot encode images of {height}x{width}: {error}"
            ) from None

    def train(self, mode: bool = True) -> TimmEncoder:
        """Stay in evaluation mode; see the class."""
        return super().train(False)

    def load(self, file: Path) -> None:
        """Load weights from a local file (`.safetensors`, or a state dict of torch).

        Raises:
            MerlError: the file cannot be read or belongs to another model.
        """
        from timm.models import load_state_dict

        if not file.is_file():
            raise MerlError(f"weights {file} of encoder {self._name!r}: there is no such file")
        try:
            weights = load_state_dict(str(file), device="cpu", weights_only=True)
            result = self.model.load_state_dict(weights, strict=False)
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise MerlError(f"weights {file} of encoder {self._name!r}: {reason}") from None
        classifier = self.model.pretrained_cfg.get("classifier") or ()
        heads = (classifier,) if isinstance(classifier, str) else tuple(classifier)
        others = [key for key in result.unexpected_keys if not key.startswith(heads)]
        for key in (*result.missing_keys, *others):
            raise MerlError(
                f"weights {file} are of another model than encoder {self._name!r}, which shows in "
                f"{key}: use a file of the same model"
            )

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode stacked frames (B, K C, H, W), in [-0.5, 0.5], to (B, K F)."""
        frames = pixels.reshape(-1, self._channels, *pixels.shape[2:]) + 0.5  # (B K, C, H, W)
        encoded: Tensor = self.model((frames - self.mean) / self.deviation)
        return encoded.reshape(len(pixels), -1)
