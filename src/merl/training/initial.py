"""Weights with which a new agent starts, from files and from another run."""

from __future__ import annotations

from pathlib import Path

from merl.agents.ddpg import DDPG
from merl.agents.networks import load_encoder_weights
from merl.core import Agent, MerlError
from merl.evaluation.policy import load_policy


def load_initial_weights(agent: Agent, home: Path) -> None:
    """Load the weights that the agent's config names, into an agent that starts to train.

    Args:
        agent: the agent; only merl's own have such weights.
        home: the folder to which names of files and runs are relative.

    Raises:
        MerlError: a file or a run cannot be read, or does not fit the agent.
    """
    if not isinstance(agent, DDPG):
        return
    load_encoder_weights(agent.networks, agent.config, home)
    source = agent.config.start_from
    if source is None:
        return
    other = load_policy(home / source).agent
    try:
        if not isinstance(other, DDPG):
            raise RuntimeError("it is the policy of an agent of another kind")
        agent.take_policy(other)
    except RuntimeError as error:
        first = str(error).split(":\n", 1)[-1].strip().splitlines()[0]
        raise MerlError(
            f"agent.start-from {source} does not fit: {first}: train both with the same keys, "
            "encoders and sizes"
        ) from None
