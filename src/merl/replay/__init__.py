"""A ring of single frames; stacks of frames and n-step returns are made when sampled."""

from merl.replay.config import ReplayConfig, check_fits, replay_bytes
from merl.replay.ring import Replay

__all__ = ["Replay", "ReplayConfig", "check_fits", "replay_bytes"]
