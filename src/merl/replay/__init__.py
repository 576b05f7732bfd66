"""Replay of single frames; sampling makes the frame stacks and the n-step returns."""

from merl.replay.buffer import ReplayBuffer
from merl.replay.capacity import check_fits
from merl.replay.config import ReplayConfig
from merl.replay.spec import ReplaySpec

__all__ = ["ReplayBuffer", "ReplayConfig", "ReplaySpec", "check_fits"]
