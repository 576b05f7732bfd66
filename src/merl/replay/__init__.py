"""A ring of single frames; stacks of frames and n-step returns are made when sampled."""

from merl.replay.config import ReplayConfig, check_fits, replay_bytes
from merl.replay.lanes import Lanes
from merl.replay.ring import Replay

__all__ = ["Lanes", "Replay", "ReplayConfig", "check_fits", "replay_bytes"]
