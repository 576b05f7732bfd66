"""The agents by name: merl's, which share one learner (`ddpg`), and a user's own."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import torch
from gymnasium import spaces

from merl.agents.bc import BC, BCConfig
from merl.agents.config import ObservationConfig
from merl.agents.ddpg import DDPG, DDPGConfig
from merl.agents.drqv2 import DrQV2Config
from merl.agents.ibrl import IBRL, IBRLConfig
from merl.agents.merl import MERLConfig
from merl.agents.sac import SAC, SACConfig
from merl.core import Agent, MerlError, check_choice, suggest
from merl.core.user_code import in_one_line, load_module
from merl.networks.settings import torch_settings


@dataclass(frozen=True)
class AgentKind:
    """An agent by name.

    Attributes:
        config: its default config.
        make: makes the agent: its class, called with the arguments of `make_agent`.
        imitates: whether it learns from demonstrations alone.
    """

    config: ObservationConfig
    make: Callable[..., Agent]
    imitates: bool = False


AGENTS = {
    "merl": AgentKind(MERLConfig(), DDPG),
    "drqv2": AgentKind(DrQV2Config(), DDPG),
    "ddpg": AgentKind(DDPGConfig(), DDPG),
    "sac": AgentKind(SACConfig(), SAC),
    # Two baselines of the paper's argument: proprioception alone, and MERL on the state.
    "proprio": AgentKind(MERLConfig(modalities=("vector", "sequence")), DDPG),
    "merl_state": AgentKind(MERLConfig(keys=("state",)), DDPG),
    # Two that learn from demonstrations: from them alone, and beside own experience.
    "bc": AgentKind(BCConfig(), BC, imitates=True),
    "ibrl": AgentKind(IBRLConfig(), IBRL),
}
"""The agents of merl."""
METHODS = ("act", "update", "state_dict", "load_state_dict", "load_policy")
"""Methods of a user's class; see `merl.core.Agent`."""
HELP = "docs/howto/agent.md describes what an agent needs"


def imitates(name: str) -> bool:
    """Return whether the agent of that name learns from demonstrations alone; a user's does not."""
    return name in AGENTS and AGENTS[name].imitates


def find_agent(name: str, *folders: Path) -> AgentKind:
    """Return the agent of that name.

    Args:
        name: a key of `AGENTS`, or `module:Class`, whose module is imported.
        folders: folders that are searched first for the module.

    Raises:
        MerlError: there is no such agent, or the class is not one.
    """
    if ":" not in name:
        check_choice("agent", name, tuple(AGENTS))
        return AGENTS[name]
    module = load_module(name, *folders, kind="agent")
    _, _, class_name = name.partition(":")
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        known = [key for key, value in vars(module).items() if isinstance(value, type)]
        hint = suggest(class_name, known)
        way = hint if hint.startswith("did") else HELP
        raise MerlError(f"agent {name!r}: {module.__file__} has no class {class_name!r}: {way}")
    missing = [method for method in METHODS if not callable(getattr(found, method, None))]
    if missing:
        raise MerlError(f"agent {name!r} has no method {', '.join(missing)}: {HELP}")
    return AgentKind(_default_config(name, found), found)


def make_agent(
    name: str,
    config: ObservationConfig,
    observation_space: spaces.Dict,
    action_space: spaces.Box,
    *,
    frame_stack: int,
    seed: int,
    device: torch.device,
    threads: int | None = None,
) -> Agent:
    """Make an agent for these spaces.

    Args:
        name: name of the agent, see `find_agent`; its module was imported before.
        config: config of the agent.
        observation_space: observations of the environment.
        action_space: actions of the environment, (A,), in [-1, 1].
        frame_stack: number of frames in an image stack.
        seed: seed of weights, noise and shifts.
        device: device of the agent.
        threads: CPU threads of acting and updates; None keeps torch's setting.

    Raises:
        MerlError: the observation space lacks a key that the agent uses, the config does not fit
            the space, or the user's class fails.
    """
    make = find_agent(name).make
    try:
        with torch_settings(device, threads):
            torch.manual_seed(seed)
            agent = make(
                config,
                observation_space,
                action_space,
                frame_stack=frame_stack,
                seed=seed,
                device=device,
                threads=threads,
            )
    except Exception as error:
        if isinstance(error, MerlError) or name in AGENTS:
            raise
        raise MerlError(f"agent {name!r} cannot be made: {in_one_line(error)}") from error
    senses = getattr(agent, "senses", None)
    if not isinstance(senses, tuple) or not {*senses} <= {*observation_space}:
        keys = tuple(observation_space)
        raise MerlError(f"agent {name!r}: senses is {senses!r}: return a tuple of keys of {keys}")
    return agent


def _default_config(name: str, found: type[Any]) -> ObservationConfig:
    """Return the default config of a user's class: its attribute `Config`, or only the keys.

    Raises:
        MerlError: the class does not accept the arguments of an agent, or `Config` is not a config.
    """
    kind = getattr(found, "Config", ObservationConfig)
    if not (isinstance(kind, type) and issubclass(kind, ObservationConfig) and is_dataclass(kind)):
        raise MerlError(
            f"agent {name!r}: Config must be a dataclass that extends ObservationConfig"
        )
    try:
        config = kind()
        inspect.signature(found).bind(
            config, None, None, frame_stack=1, seed=0, device=None, threads=None
        )
    except TypeError as error:
        raise MerlError(f"agent {name!r}: {' '.join(str(error).split())}: {HELP}") from None
    return config
