"""The command merl demos record."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Annotated, Any, get_args

import numpy as np
import tyro
from numpy.typing import NDArray

from merl.cli.console import make_console
from merl.cli.demos.shared import EnvOptions, describe, make, tell_line, with_env
from merl.core import MerlError
from merl.core.fields import Range
from merl.demos.episode import Episode
from merl.demos.recorder import Recorder
from merl.envs.config import EnvConfig, UserEnvConfig
from merl.envs.expert_policy import ExpertPolicy, HandMotion
from merl.envs.frame_rate import frame_rate
from merl.envs.registration import ENV_IDS
from merl.envs.user_env import check_task
from merl.evaluation.demonstrating import record_episodes
from merl.evaluation.policy import Policy, load_policy
from merl.evaluation.realtime import check_rate
from merl.evaluation.teleoperation import Command, DeviceName, Window, record_by_hand

EXPERT = "expert"
DEVICES = get_args(DeviceName)
NOISE = 0.1
"""Noise on the actions of an expert or of a policy."""


@dataclass(frozen=True)
class RecordOptions(EnvOptions):
    """Record demonstrations."""

    source: Annotated[str, tyro.conf.arg(name="from", metavar="expert|keyboard|gamepad|RUN")] = (
        EXPERT
    )
    """Who acts: the scripted expert (in merl's own tasks), a person, or the policy of a run."""
    episodes: Annotated[int, Range(1, 100_000)] = 50
    """Number of episodes."""
    noise: Annotated[float, Range(0, 1)] | None = None
    """Standard deviation of Gaussian noise on every action: it shows how to recover from errors. By
    default 0.1, and none on a person's actions."""
    hz: Annotated[float, Range(0, 1000, without=0)] | None = None
    """Steps per second while a person acts; by default those of the environment."""
    seed: Annotated[int, Range(0, 10_000)] = 0
    """Selects the start states and the noise."""
    failures: tyro.conf.FlagCreatePairsOff[bool] = False
    """Keep episodes that do not end in success."""
    env: Annotated[EnvConfig, tyro.conf.arg(name="")] = field(default_factory=EnvConfig)
    user_env: Annotated[UserEnvConfig, tyro.conf.arg(name="env")] = field(
        default_factory=UserEnvConfig
    )


def record(args: list[str]) -> int:
    """Record demonstrations."""
    options, preset = with_env(RecordOptions, "record", args)
    check_task(options.task)
    if options.source == EXPERT and options.task not in ENV_IDS:
        raise MerlError(
            f"there is no expert for {options.task}: name a run, keyboard or gamepad with --from, "
            "or record episodes of your own with Python (docs/howto/demonstrations.md)"
        )
    console = make_console()
    folder = options.folder.absolute()  # the environment may change the working folder
    with ExitStack() as stack:
        by_hand = options.source in DEVICES
        made = make(options, stack, render_mode="rgb_array" if by_hand else None)
        if by_hand:
            source, found = options.source, _by_hand(options, made, stack)
        else:
            source, found = _by_policy(options, made)
        form = options.env.form if options.task in ENV_IDS else {}
        spaces = made.observation_space, made.action_space
        recorder = Recorder(folder, options.task, source, *spaces, form)
        with console.status("recording", spinner="line"):
            for episode in found:
                recorder.add(episode)
    if not recorder.demonstrations.lines:
        raise MerlError("no episode was kept: nothing was written")
    describe(console, recorder.demonstrations)
    tell_line(console, options, preset)
    return 0


def _by_policy(options: RecordOptions, env: Any) -> tuple[str, Iterator[Episode]]:
    """Return who acts, and the episodes of the expert or of a run's policy."""
    policy: ExpertPolicy | Policy = (
        ExpertPolicy(env) if options.source == EXPERT else load_policy(options.source)
    )
    if isinstance(policy, Policy) and policy.config.task != options.task:
        raise MerlError(
            f"{options.source} was trained on {policy.config.task}, not on {options.task}: "
            "name another run with --from"
        )
    noise = NOISE if options.noise is None else options.noise
    found = record_episodes(
        policy,
        env,
        options.episodes,
        reset=policy.reset,
        noise=noise,
        seed=options.seed,
        failures=options.failures,
    )
    return f"{options.source}, noise {noise:g}", found


def _by_hand(options: RecordOptions, env: Any, stack: ExitStack) -> Iterator[Episode]:
    """Open the window; return the episodes of the person."""
    if options.noise:
        raise MerlError(f"noise {options.noise:g} is for a policy: a person's actions have none")
    motion: Callable[[Command], NDArray[np.float32]]
    if options.task in ENV_IDS:
        motion = HandMotion(env.unwrapped)
        axes: tuple[str, ...] = HandMotion.axes
    else:
        motion = lambda command: command.astype(np.float32)  # noqa: E731
        axes = tuple(f"action {number}" for number in range(env.action_space.shape[0]))
    window = Window("keyboard" if options.source == "keyboard" else "gamepad", axes)
    stack.callback(window.close)
    rate = check_rate(options.hz or frame_rate(env.metadata))
    return record_by_hand(
        window,
        motion,
        env,
        options.episodes,
        rate,
        seed=options.seed,
        failures=options.failures,
    )
