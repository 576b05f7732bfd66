"""Encoders by name: f_xi and g_zeta of the paper, and others. The critic's loss trains them.

To add one, write a class in this package and add it to `ENCODERS`. A class of your own needs no
change here: see `custom`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

from merl.core import MerlError, suggest
from merl.modalities import Frames, Modality, Sequence, Vector
from merl.networks.encoders.custom import custom_encoder
from merl.networks.encoders.frames import ConvEncoder, ImpalaEncoder
from merl.networks.encoders.pretrained import TimmEncoder, has_timm, is_timm_model
from merl.networks.encoders.sequences import Conv1dEncoder, TransformerEncoder
from merl.networks.encoders.vectors import Identity, MLPEncoder


@dataclass(frozen=True)
class EncoderOptions:
    """Sizes of encoders.

    Attributes:
        conv_channels: channels of each convolution of `conv`.
        conv_strides: stride of each convolution of `conv`.
        mlp_dim: width of `mlp`.
    """

    conv_channels: int = 32
    conv_strides: tuple[int, ...] = (2, 1, 1, 1)
    mlp_dim: int = 64


Builder = Callable[..., nn.Module]
ENCODERS: dict[str, tuple[tuple[type[Modality], ...], Builder]] = {
    "conv": ((Frames,), lambda m, k, o: ConvEncoder(m, k, o.conv_channels, o.conv_strides)),
    "impala": ((Frames,), lambda m, k, _: ImpalaEncoder(m, k)),
    "identity": ((Vector, Sequence), lambda m, _k, _o: Identity(m)),
    "mlp": ((Vector, Sequence), lambda m, _, o: MLPEncoder(m, o.mlp_dim)),
    "conv1d": ((Sequence,), lambda m, _k, _o: Conv1dEncoder(m)),
    "transformer": ((Sequence,), lambda m, _k, _o: TransformerEncoder(m)),
}
"""The modalities that each encoder can encode, and its builder from (modality, stack, options)."""


def make_encoder(name: str, modality: Modality, stack: int, options: EncoderOptions) -> nn.Module:
    """Build the encoder of an observation key.

    Args:
        name: a name in `ENCODERS`, `module:Class`, or the name of a timm model.
        modality: modality of the key.
        stack: number of frames in a stack.
        options: sizes.

    Returns:
        A module with an attribute `features`, which encodes `Modality.to_input()` (or, with an
        attribute `takes_stored`, the stored observations) to (B, features).

    Raises:
        MerlError: there is no such encoder, or it does not fit the modality.
    """
    if ":" in name:
        return custom_encoder(name, modality, stack)
    kinds, builder = ENCODERS.get(name, ((), None))
    if builder is not None and isinstance(modality, kinds):
        return builder(modality, stack, options)
    if builder is None and isinstance(modality, Frames) and is_timm_model(name):
        return TimmEncoder(name, modality, stack)
    fitting = [known for known, (fits, _) in ENCODERS.items() if isinstance(modality, fits)]
    others = ["a timm model", "module:Class"] if isinstance(modality, Frames) else ["module:Class"]
    if builder is not None:
        raise MerlError(
            f"encoder {name!r} does not fit a key of kind {modality.kind}: choose from "
            f"{', '.join([*fitting, *others])}"
        )
    missing = "" if has_timm() else " (timm is not installed: pip install 'merl-rl[timm]')"
    raise MerlError(f"encoder {name!r} is unknown: {suggest(name, [*fitting, *others])}{missing}")
