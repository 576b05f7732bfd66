"""Processes of `merl learner` and `merl actor` for tests, which may be killed."""

from __future__ import annotations

import multiprocessing
import os
import socket
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path

from merl.cli import main

COUNTING = """
import os

import gymnasium
import numpy as np
from gymnasium import spaces

LENGTH = 7

class Counting(gymnasium.Env):
    '''Counts its observations, also across processes; episodes have 7 steps.'''

    def __init__(self):
        self.observation_space = spaces.Dict({"joint": spaces.Box(-np.inf, np.inf, (2,))})
        self.action_space = spaces.Box(-2.0, 2.0, (1,))
        self.log = os.open(os.environ["COUNT"], os.O_RDWR | os.O_CREAT | os.O_APPEND)

    def observe(self):
        os.write(self.log, b"x")  # first, so that no two observations are the same
        return {"joint": np.array([os.fstat(self.log).st_size, self.step_], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_ = 0
        return self.observe(), {}

    def step(self, action):
        assert abs(action[0]) <= 2
        self.step_ += 1
        over = self.step_ == LENGTH
        seen = self.observe()
        return seen, float(seen["joint"][0]), over, False, {"success": over}

def make():
    return Counting()
"""
"""Environment of an actor; the learner cannot import it."""
LEARNER = [
    *("learner", "counting:make", "--preset", "smoke", "--agent", "proprio", "--eval.every", "0"),
    *("--device", "cpu", "--threads", "1", "--agent.precision", "fp32", "--agent.hidden-dim", "8"),
    *("--agent.latent-dim", "8", "--agent.torch-compile", "no", "--replay.batch-size", "4"),
    *("--seed-steps", "20", "--save-every", "0.3", "--run-dir", "run", "--resume"),
    *("--actors.weights-every", "5"),
]


def free_port() -> int:
    """Return a port that no program uses."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port


class Sides:
    """A learner and its actors, started again and again.

    Args:
        folder: gets their folders, and their output in `learner.log` and `NAME.log`.
        learner: arguments of the learner in addition to `LEARNER`.
    """

    def __init__(self, folder: Path, *learner: str) -> None:
        self.folder, self.port = folder, free_port()
        self.run = folder / "server/run"
        self._learner = [*LEARNER, "--actors.listen", f"127.0.0.1:{self.port}", *learner]
        self._context = multiprocessing.get_context("forkserver")  # imports torch only once
        self._context.set_forkserver_preload(["merl.cli.train", "merl.cli.actor"])

    def learner(self) -> BaseProcess:
        """Start or resume the learner."""
        return self.start("server", "learner", self._learner)

    def actor(self, name: str = "actor", *options: str) -> BaseProcess:
        """Start an actor with its own folder."""
        folder = self.folder / name
        folder.mkdir(exist_ok=True)
        (folder / "counting.py").write_text(COUNTING)
        command = ["actor", "--connect", f"127.0.0.1:{self.port}", "--env", "counting:make"]
        return self.start(name, name, [*command, *options])

    def output(self, name: str) -> str:
        """Return all output of a side so far."""
        file = self.folder / f"{name}.log"
        return file.read_text() if file.exists() else ""

    def start(self, folder: str, log: str, arguments: list[str]) -> BaseProcess:
        """Start a command in a folder, with its output in `LOG.log`."""
        (self.folder / folder).mkdir(exist_ok=True)
        process = self._context.Process(
            target=run_merl, args=(self.folder / folder, self.folder / f"{log}.log", arguments)
        )
        process.start()
        return process


def run_merl(folder: Path, log: Path, arguments: list[str]) -> None:
    """Run the command line in a folder, with its output in a file."""
    os.chdir(folder)
    os.environ |= {"COUNT": str(folder / "count"), "MERL_TOKEN": ""}
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    os._exit(_code(arguments))


def _code(arguments: list[str]) -> int:
    try:
        return main(arguments)
    except BaseException:
        import traceback

        traceback.print_exc()
        return 99
