"""The command merl run."""

from __future__ import annotations

import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import numpy as np
import tyro
from gymnasium import spaces

from merl.acting.instances import own_bounds
from merl.acting.run_env import recipe
from merl.cli.console import make_console, say
from merl.cli.parsing import PolicyOptions, parse
from merl.cli.running import open_policy
from merl.core import MerlError, counted
from merl.core.fields import Range
from merl.core.signals import Stopped
from merl.demos.episode import Episode, EpisodeRecording
from merl.demos.recorder import Recorder
from merl.envs.frame_rate import frame_rate
from merl.envs.user_env import load_module
from merl.evaluation.exported import SUFFIXES, ExportedPolicy
from merl.evaluation.policy import Policy
from merl.evaluation.realtime import Driven, Limits, check_rate, drive
from merl.runs import record
from merl.runs.plain import describe, told

STOP_KEYS = b" q\x1b"
"""Space, q and Escape."""
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class RunOptions(PolicyOptions):
    """Run a policy in an environment in real time, e.g. on a robot. Space or Ctrl-C stops it."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
    """A run's folder, or a file of `merl export`."""
    env: Annotated[str | None, tyro.conf.arg(metavar="MODULE:FUNCTION")] = None
    """The environment: module:function, a Gymnasium id or a task of merl; by default that of the
    run."""
    hz: Annotated[float, Range(0, 10_000, without=0)] | None = None
    """Steps per second; by default the environment's `render_fps`."""
    episodes: Annotated[int, Range(1)] = 1
    """Number of episodes; each begins with a reset of the environment."""
    max_steps: Annotated[int, Range(1)] | None = None
    """Steps of an episode; by default until the environment ends it."""
    action_limit: Annotated[float, Range(0, 1, without=0)] = 1.0
    """Largest absolute value of an action's numbers, of 1."""
    rate_limit: Annotated[float, Range(0, 2, without=0)] | None = None
    """Largest change of an action's numbers from step to step, for actions that are speeds or
    changes: the first counts from 0."""
    max_late: Annotated[int, Range(1)] = 25
    """Consecutive steps that miss their deadline, after which the run ends."""
    log: Path | None = None
    """Write the episodes to this new folder, which `merl demos show` and training can read."""


def run(args: list[str]) -> int:
    """Run a policy in real time: merl run POLICY [--env MODULE:FUNCTION] [--hz RATE] ..."""
    options = parse(RunOptions, "merl run", args)
    console = make_console()
    log = options.log and options.log.absolute()  # the environment may change the working folder
    policy = _policy(options)
    with ExitStack() as stack:
        env = _env(options, policy)
        stack.callback(env.close)
        check_fits(policy, env)
        rate = check_rate(options.hz or frame_rate(env.metadata))
        limits = Limits(
            options.action_limit, options.rate_limit, options.max_steps, options.max_late
        )
        name = options.env or _task(policy)
        assert isinstance(env.observation_space, spaces.Dict)
        assert isinstance(env.action_space, spaces.Box)
        recorder = None
        if log is not None:
            who = f"policy {options.run}"
            recorder = Recorder(log, name, who, env.observation_space, env.action_space)
        policy(env.observation_space.sample())  # the first call takes longer
        stop = stack.enter_context(Stop.listening())
        say(console, f"{options.run} in {name}, {rate:g} steps per second: {stop.keys} stops")
        code = acted = 0
        for index in range(options.episodes):
            if stop.asked():
                break
            with stop.at_once():
                observation, _ = env.reset()
            policy.reset()
            recording, terminated = EpisodeRecording(observation), False
            try:
                found = drive(
                    policy, env, observation, rate, limits, stop.asked, record=recording.add
                )
                terminated = found.end == "terminated"
            finally:  # also after an error, whose episode is the most interesting
                if recorder is not None and len(recording):
                    recorder.add(recording.finish(terminated=terminated))
            acted += len(recording)
            if len(recording):
                episode = recording.finish(terminated=terminated)
                say(console, f"episode {index + 1}: {_told(episode, found)}")
            if found.end == "late":
                message = f"{counted(options.max_late, 'step')} in a row missed the deadline"
                say(console, f"stopped: {message}: use a lower --hz")
                code = 1
                break
        if not acted:
            say(console, "stopped before the first step")
        if recorder is not None and recorder.demonstrations.lines:
            say(console, f"log: {log}")
    return 128 + stop.number if stop.number else code


class Stop:
    """Requests to stop: a key in the terminal, or a signal; a second signal raises at once.

    Attributes:
        number: the signal; 0 if none arrived.
        keys: what stops, in words.
    """

    def __init__(self, terminal: int | None) -> None:
        self.number, self._pressed, self._raises, self._terminal = 0, False, False, terminal
        self.keys = "Ctrl-C" if terminal is None else "Space or Ctrl-C"

    @classmethod
    @contextmanager
    def listening(cls) -> Iterator[Stop]:
        """Listen to signals that are not ignored, as by nohup, and to the keys of the terminal."""
        terminal = _keyboard()
        stop = cls(terminal)
        heard = [number for number in SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        former = {number: signal.signal(number, stop.note) for number in heard}
        before = None if terminal is None else termios.tcgetattr(terminal)
        try:
            if terminal is not None:
                tty.setcbreak(terminal)
            yield stop
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)
            if terminal is not None and before is not None:
                with suppress(termios.error):  # the terminal was closed
                    termios.tcsetattr(terminal, termios.TCSADRAIN, before)

    def note(self, number: int, _: object) -> None:
        """Note a signal; raise the second one, and any in `at_once`."""
        second, self.number = bool(self.number), number
        if second or self._raises:
            raise Stopped(number)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let signals raise, in calls that may wait for long."""
        self._raises = True
        try:
            yield
        finally:
            self._raises = False

    def asked(self) -> bool:
        """Return whether to stop."""
        if self._terminal is not None and select.select([self._terminal], [], [], 0)[0]:
            keys = os.read(self._terminal, 4096)
            self._pressed |= not keys or any(key in STOP_KEYS for key in keys)
        return self._pressed or self.number != 0


def _keyboard() -> int | None:
    """Return the terminal whose keys this process gets; None without one and in the background."""
    with suppress(AttributeError, OSError, ValueError):  # no stdin, a closed one, no terminal
        terminal = sys.stdin.fileno()
        if os.tcgetpgrp(terminal) == os.getpgrp():
            return terminal
    return None


def check_fits(policy: Policy | ExportedPolicy, env: gymnasium.Env[Any, Any]) -> None:
    """Check that an environment has what a policy observes, and takes its actions.

    Raises:
        MerlError: a key is missing or differs, or the actions have another length.
    """
    assert isinstance(env.observation_space, spaces.Dict)
    for key, modality in policy.modalities.items():
        space = env.observation_space.spaces.get(key)
        if space is None:
            raise MerlError(
                f"the environment has no observation {key!r}, which the policy uses: it has "
                f"{', '.join(env.observation_space.spaces)}"
            )
        own, trained = told(describe(space)), told(describe(modality.space))
        if own != trained:
            raise MerlError(
                f"observation {key!r} of the environment is {own}, and the policy was trained with "
                f"{trained}"
            )
    if isinstance(policy, ExportedPolicy):
        bounds = policy.bounds
    else:
        assert policy.run is not None
        size = policy.run.spaces()[1].shape[0]
        recorded = record.read(policy.run.path)["action_space"].get("own_bounds")
        bounds = recorded or ([-1.0] * size, [1.0] * size)
    size = len(bounds[0])
    if env.action_space.shape != (size,):
        raise MerlError(
            f"the environment's actions are {env.action_space.shape}, and the policy's ({size},)"
        )
    here = own_bounds(env) or ([-1.0] * size, [1.0] * size)
    if not np.allclose(here, bounds):
        raise MerlError(
            f"the environment's actions reach from {here[0]} to {here[1]}, and those that the "
            f"policy learnt from {bounds[0]} to {bounds[1]}: an action would be another movement"
        )


def _policy(options: RunOptions) -> Policy | ExportedPolicy:
    if options.run.suffix == SUFFIXES["numpy"]:
        raise MerlError(
            f"{options.run} is Python code: import its Policy into a program of your own, or "
            "export the policy to onnx"
        )
    if options.run.suffix in SUFFIXES.values():
        return ExportedPolicy(options.run)
    return open_policy(options)


def _env(options: RunOptions, policy: Policy | ExportedPolicy) -> gymnasium.Env[Any, Any]:
    if options.env is None:
        if isinstance(policy, ExportedPolicy):
            raise MerlError(f"{options.run} is a file of a policy: name the environment with --env")
        return policy.make_env(trust=options.trust)
    if ":" in options.env:
        load_module(options.env, Path.cwd())
    known = policy.recipe if isinstance(policy, ExportedPolicy) else recipe(policy.config.evaluated)
    return replace(known, task=options.env).instance()


def _task(policy: Policy | ExportedPolicy) -> str:
    assert isinstance(policy, Policy)
    return policy.config.task


def _told(episode: Episode, found: Driven) -> str:
    """Return one line about an episode: its return, its end, and its times."""
    times = found.timing
    words = f"return {episode.rewards.sum():.4g} in {counted(len(episode), 'step')}, {found.end}"
    if episode.success is not None:
        words += ", success" if episode.success else ", no success"
    for name, values in (("policy", times.policy), ("environment", times.env)):
        middle, worst = 1000 * np.percentile(values, 50), 1000 * max(values)
        words += f"; {name} {middle:.1f} ms (at most {worst:.1f})"
    words += f"; {times.late} late"
    return words + (f", by up to {1000 * max(times.lateness):.1f} ms" if times.late else "")
