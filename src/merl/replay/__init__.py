"""A ring of single frames; stacks of frames and n-step returns are made when sampled."""

from merl.replay.buffer import ReplayBuffer
from merl.replay.config import ReplayConfig, check_fits, replay_bytes
from merl.replay.ring import EpisodeRing

__all__ = ["EpisodeRing", "ReplayBuffer", "ReplayConfig", "check_fits", "replay_bytes"]
