"""Encoders of a user's own class.

The class is a `torch.nn.Module` that is made from (modality, stack), sets `features`, the length F
of the encoding, and encodes `modality.to_input()` to (B, F) in `forward`. Its initialisation is
kept. A method `observe`, if there is one, gets the input of each update before `forward`.
"""

from __future__ import annotations

import torch
from torch import nn

from merl.core import MerlError
from merl.core.user_code import in_one_line, load_module
from merl.modalities import Modality
from merl.networks.initialization import KEEPS_WEIGHTS


def custom_encoder(name: str, modality: Modality, stack: int) -> nn.Module:
    """Build an encoder from `module:Class`, and check its output.

    Raises:
        MerlError: the class cannot be imported, fails, or is no encoder of this modality.
    """
    module = load_module(name, kind="encoder")
    attribute = name.partition(":")[2]
    maker = getattr(module, attribute, None)
    if not (isinstance(maker, type) and issubclass(maker, nn.Module)):
        raise MerlError(
            f"encoder {name!r}: {module.__name__} has no class {attribute!r} that is a "
            "torch.nn.Module"
        )
    try:
        encoder: nn.Module = maker(modality, stack)
        features = getattr(encoder, "features", None)
        with torch.no_grad():
            shape = tuple(encoder(modality.to_input(modality.zeros(2, stack))).shape)
    except Exception as error:
        raise MerlError(f"encoder {name!r} failed: {in_one_line(error)}") from error
    if shape != (2, features):
        raise MerlError(
            f"encoder {name!r} returned the shape {shape} for two observations, and its attribute "
            f"`features` is {features}: return (B, features)"
        )
    setattr(encoder, KEEPS_WEIGHTS, True)
    return encoder
