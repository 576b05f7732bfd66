"""The command merl actor."""

from __future__ import annotations

import dataclasses
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from merl.acting.instances import own_bounds
from merl.acting.run_env import make_run_env, run_spaces
from merl.cli.console import make_console, say
from merl.cli.parsing import parse
from merl.cli.run import Stop
from merl.config import ActorsConfig, TrainConfig
from merl.core import MerlError, counted
from merl.core.fields import Range, check_fields
from merl.envs.user_env import imports_code, load_module
from merl.evaluation.realtime import Limits
from merl.link.acting import Actor, Pace
from merl.link.connection import Connection, reach
from merl.link.protocol import Address, read_token
from merl.link.spool import Spool
from merl.link.timesteps import Layout
from merl.link.weights import check_can_act
from merl.runs import record
from merl.runs.resume import decided

TELL_SECONDS = 5.0
"""Seconds between two lines about episodes."""


@dataclass(frozen=True)
class ActorOptions:
    """Act for a learner (`merl learner`), e.g. on a robot's computer. Space or Ctrl-C stops it."""

    connect: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")]
    """Where the learner listens."""
    env: Annotated[str | None, tyro.conf.arg(metavar="MODULE:FUNCTION")] = None
    """The environment: module:function or a Gymnasium id; by default the learner's task, if it is
    one of merl or Gymnasium."""
    token: Path | None = None
    """File with the learner's secret; by default the environment variable MERL_TOKEN."""
    spool: Path = Path("spool")
    """Folder of the timesteps that the learner has not saved yet; one for each actor."""
    hz: Annotated[float, Range(0, 10_000, without=0)] | None = None
    """Steps per second; by default as fast as the learner follows."""
    behind: Annotated[int, Range(1)] = 100
    """Timesteps that may be on their way to the learner's replay; with --hz, at the start of an
    episode. Beyond that, the actor waits."""
    random_steps: Annotated[int, Range(0)] = 0
    """Steps of this actor with uniformly random actions at the start."""
    max_steps: Annotated[int, Range(1)] | None = None
    """Steps of an episode; by default until the environment ends it."""
    action_limit: Annotated[float, Range(0, 1, without=0)] = 1.0
    """Largest absolute value of an action's numbers, of 1."""
    rate_limit: Annotated[float, Range(0, 2, without=0)] | None = None
    """Largest change of an action's numbers from step to step; the first counts from 0."""
    max_late: Annotated[int, Range(1)] = 25
    """With --hz, consecutive steps that miss their deadline, after which the actor ends."""

    def __post_init__(self) -> None:
        check_fields(self, "--")


def actor(args: list[str]) -> int:
    """Act for a learner: merl actor --connect HOST:PORT [--env MODULE:FUNCTION] [--hz RATE] ..."""
    options = parse(ActorOptions, "merl actor", args)
    console = make_console()
    address, token = Address.parse(options.connect, "--connect"), read_token(options.token)
    with ExitStack() as stack:
        spool = stack.enter_context(Spool.open(options.spool.absolute()))
        channel, plain = reach(address, token)
        stack.callback(channel.close)
        config = _config(plain, options.env)
        env = make_run_env(config)
        stack.callback(env.close)
        space, action_space = run_spaces(config, env)
        layout = Layout(space, action_space)
        described = record.describe_spaces(space, action_space, own_bounds(env))
        connection = Connection(address, token, spool, layout, described)
        connection.open(channel)
        stack.callback(connection.close)
        stop = stack.enter_context(Stop.listening())
        acting = Actor(
            config, env, spool, layout, connection, _pace(options), _limits(options), stop
        )
        rate = "" if options.hz is None else f" at {options.hz:g} steps per second"
        name = f"actor {connection.place} of {address} in {config.task}"
        say(console, f"{name}{rate}: {stop.keys} stops")
        code = _act(options, acting, connection, console)
        connection.close()
        _tell_end(connection, spool, console)
    return 128 + stop.number if stop.number else code


def _act(options: ActorOptions, acting: Actor, connection: Connection, console: Console) -> int:
    """Act until the end, and print lines about episodes; return the exit code."""
    told = -TELL_SECONDS
    for number, (episode, driven) in enumerate(acting.episodes(), 1):
        if time.monotonic() - told >= TELL_SECONDS:
            told = time.monotonic()
            success = {None: "", True: ", success", False: ", no success"}[episode.success]
            late = "" if options.hz is None else f"; {driven.timing.late} late"
            say(
                console,
                f"episode {number}: return {episode.total_reward:.4g} in "
                f"{counted(episode.length, 'step')}{success}{late}; "
                f"policy of update {acting.policy:,} of {connection.updates:,}",
            )
        if driven.end == "late":
            steps = counted(options.max_late, "step")
            console.print(f"stopped: {steps} in a row missed the deadline: use a lower --hz")
            return 1
    return 0


def _tell_end(connection: Connection, spool: Spool, console: Console) -> None:
    if connection.done:
        spool.finish()
        console.print("the run is done")
    elif spool.last > connection.stored:
        count = counted(spool.last - connection.stored, "timestep")
        line = f"{count} will be sent when an actor starts again with --spool {spool.folder}"
        say(console, line)


def _pace(options: ActorOptions) -> Pace:
    return Pace(options.hz, options.behind, options.random_steps)


def _limits(options: ActorOptions) -> Limits:
    late = sys.maxsize if options.hz is None else options.max_late
    return Limits(options.action_limit, options.rate_limit, options.max_steps, late)


def _config(plain: dict[str, Any], env: str | None) -> TrainConfig:
    """Return the learner's config for this machine.

    Raises:
        MerlError: it needs code of the user's that is not named here.
    """
    try:
        config = record.config_of({"config": plain})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise MerlError(
            f"the learner's config cannot be read ({error}): is it a learner of merl?"
        ) from None
    check_can_act(config)
    if env is None and imports_code(config.task):
        raise MerlError(
            f"the learner's task is {config.task}: name the environment of this machine with --env"
        )
    task = config.task if env is None else env
    if ":" in task:
        load_module(task, Path.cwd())
    evaluation = dataclasses.replace(config.eval, start=None)
    alone = dataclasses.replace(config, task=task, actors=ActorsConfig(), eval=evaluation)
    return decided(dataclasses.replace(alone, num_envs=1))
