"""An agent of the user: the one of docs/howto/agent.md, and agents that cannot work."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import merl
from merl.agents.config import UnloadedConfig
from merl.cli import main
from merl.core import MerlError
from merl.runs.run import Run
from merl.training.loop import StepResult

TASK, NAME = "merl.envs.dot:whole", "small_agent:SmallAgent"
LOSS = '"value_loss": value_loss.detach()'
GUIDE = Path(__file__).parents[2] / "docs" / "howto" / "agent.md"
_FLAGS = {
    "--preset": "smoke",
    "--steps": 60,
    "--random-steps": 20,
    "--seed-steps": 20,
    "--device": "cpu",
    "--threads": 1,
    "--agent.hidden": 16,
    "--replay.batch-size": 4,
    "--eval.every": 40,
    "--eval.episodes": 1,
    "--eval.video": "none",
}
SMALL = [str(part) for flag in _FLAGS.items() for part in flag] + ["--eval.no-references"]
VALUES = {flag.strip("-").replace("-", "_"): value for flag, value in _FLAGS.items()}
VALUES |= {"eval.references": False}


def code() -> str:
    """Return the agent in the guide."""
    found = re.search(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    assert found
    return found.group(1)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Work in a folder with the module of the agent."""
    (tmp_path / "small_agent.py").write_text(code())
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    yield tmp_path
    sys.path[:] = before
    forget()


def forget() -> None:
    """Forget the module, as a new process."""
    for name in [name for name in sys.modules if name.endswith("_agent")]:
        del sys.modules[name]


def weights_of(run: Path) -> dict[str, torch.Tensor]:
    return load_file(max(run.glob("checkpoints/*")) / "weights.safetensors")


def train(*flags: str, agent: str = NAME, run: str = "run") -> int:
    return main(["train", TASK, "--agent", agent, *SMALL, "--run-dir", run, *flags])


def test_it_trains_evaluates_and_resumes_exactly(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train("--agent.keys", "joints") == 0
    config = Run.open(folder / "run").with_agent().config
    assert (config.agent_name, config.agent.hidden, config.agent.keys) == (NAME, 16, ("joints",))  # type: ignore[attr-defined]

    class Stops(merl.Callback):
        def on_step(self, result: StepResult) -> bool | None:
            return False if result.step == 40 else None

    forget()
    values = VALUES | {"run_dir": "again", "agent.keys": ("joints",)}
    merl.train(TASK, agent=NAME, callbacks=[Stops()], **values)
    forget()
    monkeypatch.chdir(Path(sys.executable).parent)  # the record of the run names the folder
    assert main(["resume", str(folder / "again")]) == 0
    once, again = weights_of(folder / "run"), weights_of(folder / "again")
    assert once.keys() == again.keys()
    assert all(torch.equal(once[name], again[name]) for name in once)

    forget()
    capsys.readouterr()
    assert main(["evaluate", str(folder / "run"), "--episodes", "2"]) == 0
    assert "at step 60" in capsys.readouterr().out
    forget()
    policy = merl.load_policy(folder / "run")
    action = policy({"joints": np.array([0.5, -0.5], np.float32)})
    assert (action.shape, action.dtype) == ((2,), np.float32)


def test_it_is_trained_from_python_as_a_class(folder: Path) -> None:
    sys.path.append(str(folder))
    from small_agent import SmallAgent

    outcome = merl.train(TASK, agent=SmallAgent, **VALUES | {"run_dir": "run"})
    assert outcome.run.config.agent == SmallAgent.Config(hidden=16)
    assert merl.load_policy("run").step == 60


def test_its_environments_run_in_worker_processes(folder: Path) -> None:
    assert train("--num-envs", "2", "--no-synchronous") == 0
    assert weights_of(folder / "run")


def test_the_flags_of_its_config_are_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        train("--help")
    shown = capsys.readouterr().out
    assert "--agent.hidden" in shown
    assert "Standard deviation of the exploration noise" in shown
    assert "--agent.conv-strides" not in shown


def test_the_agent_of_an_untrusted_run_is_not_imported(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train() == 0
    forget()
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "of another user"))
    shutil.move(folder / "run", folder / "untrusted")
    mark = folder / "imported"
    (folder / "small_agent.py").write_text(f"open({str(mark)!r}, 'w')\n{code()}")
    run = str(folder / "untrusted")
    assert isinstance(Run.open(folder / "untrusted").config.agent, UnloadedConfig)
    for command in (["evaluate", run, "--episodes", "1"], ["resume", run, "--steps", "80"]):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        named = "names code as its agent: 'SmallAgent' of module 'small_agent', in folder"
        assert named in error
    with pytest.raises(MerlError, match=r"add --trust \(in Python: trust=True\)"):
        merl.load_policy(run)
    assert train("--resume", agent="merl", run=run) == 2  # names another agent
    assert not mark.exists()
    assert main(["evaluate", run, "--episodes", "1", "--trust"]) == 0
    assert "--trust: importing 'SmallAgent' of module 'small_agent'" in capsys.readouterr().err
    forget()
    assert train("--resume", "--steps", "80", run=run) == 0  # names the agent in its folder


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        (
            "no_such_agent:A",
            ("", ""),
            "'no_such_agent:A': No module named 'no_such_agent' in",
        ),
        ("small agent:A", ("", ""), "use module:Class, for example my_agent:MyAgent"),
        ("mrl", ("", ""), "agent 'mrl' is unknown: did you mean 'merl'?"),
        ("small_agent:SmalAgent", ("", ""), "has no class 'SmalAgent': did you mean 'SmallAgent'?"),
        ("small_agent:prod", ("", ""), "has no class 'prod': docs/howto/agent.md"),
        (NAME, ("def update(", "def learn("), f"agent {NAME!r} has no method update: docs/howto"),
        (NAME, ("import torch\n", "import torhc\n"), "imports 'torhc', which is not installed"),
        (
            NAME,
            ("import torch\n", "1 / 0\n"),
            "Error: division by zero (small_agent.py, line",
        ),
        (NAME, (", threads\n", "\n"), "got an unexpected keyword argument 'threads': docs/howto"),
        (NAME, ("(ObservationConfig)", ""), "Config must be a dataclass that extends Observation"),
        (
            NAME,
            ("hidden: int = 64", "hidden: int"),
            "TypeError: non-default argument 'hidden' follows",
        ),
        (NAME, ("tuple(observation_space)", '("eye",)'), "senses is ('eye',): return a tuple of"),
        (NAME, (".to(device)", ".to(devise)"), "cannot be made: NameError: name 'devise' is not"),
        (NAME, ("action.clamp(-1, 1)", "action[0]"), "returned shape (2,): return (1, 2), one"),
        (NAME, (f"return {{{LOSS}", f"{{{LOSS}"), f"update() of agent {NAME!r} returned None: re"),
        (NAME, (LOSS, LOSS.replace(".detach()", ".item()")), "of scalar tensors"),
        (NAME, (LOSS, f"{LOSS}[None]"), "returned {'value_loss': tensor(["),
        ("merl", ("", ""), "unrecognized options: --agent.hidden"),
    ],
)
def test_bad_input_is_reported_in_one_line(
    name: str,
    change: tuple[str, str],
    says: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder / "small_agent.py").write_text(code().replace(*change))
    assert train(agent=name) == 2
    error = capsys.readouterr().err
    assert says in " ".join(error.split())
    assert error.count("\n") == 1
    assert not (folder / "run").exists() or "returned shape" in says
