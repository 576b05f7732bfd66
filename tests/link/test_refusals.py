"""What does not fit is refused in one line, by the side that can mend it, and the run goes on."""

from __future__ import annotations

import os
import signal
import socket
import threading
from pathlib import Path

import pytest

import merl
from helpers import flat, wait_for
from merl.cli import main
from two_sides import COUNTING, Sides, free_port

OTHERS = """
import gymnasium
import numpy as np
from counting_here import Counting

def wide():
    env = Counting()
    env.observation_space = gymnasium.spaces.Dict(
        {"joint": gymnasium.spaces.Box(-np.inf, np.inf, (3,))}
    )
    return env

def strong():
    env = Counting()
    env.action_space = gymnasium.spaces.Box(-5.0, 5.0, (1,))
    return env

def nan():
    env = Counting()
    env.observe = lambda: {"joint": np.full(2, np.nan, np.float32)}
    return env
"""


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Return a function that runs a command, which must end with one line on stderr."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COUNT", str(tmp_path / "here/count"))
    monkeypatch.delenv("MERL_TOKEN", raising=False)
    monkeypatch.syspath_prepend(tmp_path / "here")

    def run(*arguments: str, code: int = 2) -> str:
        capsys.readouterr()
        assert main(arguments) == code
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if "error" in line]
        return flat(line)

    return run


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["learner", "reach_duplo", "--actors.listen", "0.0.0.0:7007"], "--actors.token FILE"),
        (["learner", "reach_duplo", "--actors.listen", "a:b"], "takes HOST:PORT"),
        (["learner", "reach_duplo", "--actors.token", "missing"], "token missing cannot be read"),
        (["learner", "reach_duplo", "--random-steps", "9"], "give --random-steps to `merl actor`"),
        (["learner", "reach_duplo", "--agent", "bc"], "needs no actor"),
        (["actor", "--connect", "no.invalid:7007"], "no learner answers at no.invalid:7007"),
        (["actor"], "missing from merl actor: HOST:PORT"),
    ],
)
def test_what_cannot_begin_is_refused(refused, arguments: list[str], words: str) -> None:
    assert words in refused(*arguments)
    assert not list(Path().glob("runs/*"))


def test_a_port_in_use_and_a_missing_learner_are_named(
    refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    told = refused("actor", "--connect", f"127.0.0.1:{port}")
    assert f"no learner answers at 127.0.0.1:{port} (Connection refused)" in told
    with socket.create_server(("127.0.0.1", port)) as server:
        with monkeypatch.context() as other:
            other.setenv("MERL_TOKEN", "secret")
            told = refused("learner", "reach_duplo", "--actors.listen", "203.0.113.1:7007")
            assert "cannot listen on 203.0.113.1:7007: Cannot assign requested address" in told
        told = refused("learner", "reach_duplo", "--actors.listen", f"127.0.0.1:{port}")
        assert "Address already in use: stop the other program, or name another port" in told

        def answer() -> None:
            accepted, _ = server.accept()
            accepted.sendall(b"SSH-2.0-OpenSSH_9.6p1 Ubuntu-3ubuntu13\r\n")

        threading.Thread(target=answer).start()
        told = refused("actor", "--connect", f"127.0.0.1:{port}")
        assert "this is no message of merl" in told


def test_actors_that_do_not_fit_are_refused(
    refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("counting_here.py").write_text(COUNTING)
    Path("others.py").write_text(OTHERS)
    sides = Sides(tmp_path, "--steps", "100000")
    learner = sides.learner()
    try:
        wait_for(lambda: "waiting" in sides.output("learner"))
        connect = ("actor", "--connect", f"127.0.0.1:{sides.port}", "--env")
        with monkeypatch.context() as other:
            other.setenv("MERL_TOKEN", "secret")
            assert "the token is not the learner's" in refused(*connect, "others:wide")
            other.setenv("MERL_TOKEN", "")
            other.setattr(merl, "__version__", "0.0.1")
            assert "and this machine 0.0.1: install the same" in refused(*connect, "others:wide")
        assert "name the environment of this machine with --env" in refused(*connect[:-1])
        for noise in (b"", b"GET / HTTP/1.1\r\n\r\n", os.urandom(9999), b"MERL" + b"\xff" * 12):
            with socket.create_connection(("127.0.0.1", sides.port)) as peer:
                peer.sendall(noise)
        actor = sides.actor()
        wait_for(lambda: "actor 0 of" in sides.output("actor"))
        told = refused(*connect, "others:wide")
        assert "observation 'joint' was float32 (2,) and is float32 (3,)" in told
        told = refused(*connect, "others:strong")
        assert "the actions' bounds was low [-2.0], high [2.0] and is low [-5.0]" in told
        told = refused(*connect, "counting_here:make")
        assert "all places of the run are taken (--num-envs 1)" in told
        os.kill(actor.pid or 0, signal.SIGTERM)
        actor.join(60)
        assert actor.exitcode == 128 + signal.SIGTERM, sides.output("actor")
        (sides.run / "actors.json").write_text("[")
        assert "actors.json is damaged (" in refused(*connect, "counting_here:make")
        assert "actors.json is damaged (" in flat(sides.output("learner"))
        (sides.run / "actors.json").write_text("[null]")  # its spool is lost
        assert "observation 'joint' is nan" in refused(*connect, "others:nan", code=3)
    finally:
        os.kill(learner.pid or 0, signal.SIGTERM)
        learner.join(60)
    assert learner.exitcode == 128 + signal.SIGTERM
    assert "Traceback" not in sides.output("learner")
