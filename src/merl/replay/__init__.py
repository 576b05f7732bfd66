"""Replay of single frames; sampling makes the frame stacks and the n-step returns."""

from merl.replay.buffer import ReplayBuffer
from merl.replay.config import ReplayConfig, check_fits, replay_bytes
from merl.replay.ring import EpisodeRing

__all__ = ["EpisodeRing", "ReplayBuffer", "ReplayConfig", "check_fits", "replay_bytes"]
