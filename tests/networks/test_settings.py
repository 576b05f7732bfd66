"""Agents are built, act and learn the same, whatever settings of torch the program has changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import merl
from merl.agents import AGENTS, make_agent
from merl.agents.config import AgentConfig
from merl.agents.merl import MERLConfig
from merl.cli import main
from merl.config import TrainConfig
from merl.core import MerlError, Transition
from merl.evaluation.policy import Policy
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
from merl.runs import checkpoint
from merl.training.loop import Randomness
from merl.training.updating import make_update
from toy import DotEnv

CPU = torch.device("cpu")
SMALL = {"latent_dim": 8, "hidden_dim": 8, "conv_channels": 4, "conv_strides": (2, 1, 1, 1)}
CONFIG = TrainConfig(
    "dot",
    steps=100,
    replay=ReplayConfig(batch_size=8),
    agent=MERLConfig(**SMALL, shift_pad=1, precision="fp32", standardize=True),
)
SPACE = DotEnv().observation_space
ACTIONS = DotEnv().action_space


def all_settings() -> tuple[Any, ...]:
    return (
        torch.get_default_dtype(),
        torch.get_default_device(),
        torch.get_num_threads(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.is_autocast_enabled("cpu"),
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )


def set_double() -> None:
    torch.set_default_dtype(torch.float64)


def set_meta() -> None:
    torch.set_default_device("meta")


def set_no_gradients() -> None:
    torch.set_grad_enabled(False)


def set_threads() -> None:
    torch.set_num_threads(2)


def set_deterministic() -> None:
    torch.use_deterministic_algorithms(True, warn_only=True)


def set_autocast() -> None:
    torch.set_autocast_enabled("cpu", True)


SETTERS = [set_double, set_meta, set_no_gradients, set_threads, set_deterministic, set_autocast]


@contextmanager
def disturbed(by: str) -> Iterator[None]:
    """Run with torch settings changed by `by`: the name of a setter, all or inference."""
    if by == "inference":
        with torch.inference_mode():
            yield
        return
    chosen = [s for s in SETTERS if by in (s.__name__, "all")]
    before = torch.get_num_threads()
    try:
        for setter in chosen:
            setter()
        yield
    finally:
        torch.set_default_device(None)
        torch.set_default_dtype(torch.float32)
        torch.set_grad_enabled(True)
        torch.set_num_threads(before)
        torch.use_deterministic_algorithms(False)
        torch.set_autocast_enabled("cpu", False)


def results(config: AgentConfig, folder: Path) -> list[Any]:
    """Build an agent, act, learn from a replay, save and load; return all results."""
    agent = make_agent("merl", config, SPACE, ACTIONS, frame_stack=3, seed=0, device=CPU, threads=1)
    with torch_settings(CPU):
        replay = ReplayBuffer(ReplaySpec.of(CONFIG.replay, SPACE, ACTIONS, capacity=20))
    env = DotEnv()
    observation, _ = env.reset(seed=0)
    replay.begin(observation)
    policy = Policy(agent, CONFIG, SPACE, CPU)
    for step in range(9):
        action = np.full(1, step / 10, np.float32)
        observation = env.step(action)[0]
        replay.add(Transition(action, step / 10, 1.0, observation, last=False))
    update = make_update(agent, replay, Randomness(0), CONFIG, CPU, print)
    metrics = [update(0) for _ in range(2)][-1]
    saved = checkpoint.save(folder, 1, agent, {}, score=None, keep=1)
    again = make_agent("merl", config, SPACE, ACTIONS, frame_stack=3, seed=1, device=CPU, threads=1)
    checkpoint.load_agent(again, saved)
    update_again = make_update(again, replay, Randomness(1), CONFIG, CPU, print)
    update_again(0)
    checkpoint.load_policy_of(agent, saved)
    return [
        *(parameter.detach().clone().numpy() for parameter in again.networks.parameters()),
        *(value.detach().clone().numpy() for value in metrics.values()),
        again.act(policy_input(observation), explore=True, step=0).numpy(),
        policy(observation),
    ]


def policy_input(observation: dict[str, Any]) -> dict[str, torch.Tensor]:
    image = torch.from_numpy(np.stack([observation["image"]] * 3))[None]
    return {"image": image, "joint": torch.from_numpy(observation["joint"])[None]}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    return results(CONFIG.agent, tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize("by", [*(setter.__name__ for setter in SETTERS), "all", "inference"])
def test_agent_does_not_depend_on_torch_settings(
    by: str, undisturbed: list[Any], tmp_path: Path
) -> None:
    with disturbed(by):
        before = all_settings()
        found = results(CONFIG.agent, tmp_path)
        assert all_settings() == before  # the program's settings are unchanged
    for one, other in zip(found, undisturbed, strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == np.float32


@pytest.mark.parametrize("by", ["all", "inference"])
def test_sac_does_not_depend_on_torch_settings(by: str) -> None:
    def weights() -> list[Any]:
        config = AGENTS["sac"].config
        space = gymnasium.spaces.Dict({"state": SPACE["joint"]})
        agent = make_agent(
            "sac", config, space, ACTIONS, frame_stack=1, seed=0, device=CPU, threads=1
        )
        seen = torch.from_numpy(np.ones((1, 2), np.float32))
        action = agent.act({"state": seen}, explore=True, step=0)
        agent.load_state_dict(agent.state_dict())
        return [action.numpy(), *(p.detach().numpy() for p in agent.networks.parameters())]

    expected = weights()
    with disturbed(by):
        found = weights()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_threads_are_set_only_during_the_call() -> None:
    torch.set_num_threads(2)
    with torch_settings(CPU, threads=1):
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with torch_settings(CPU):
        assert torch.get_num_threads() == 2


def test_settings_are_restored_after_an_error() -> None:
    with disturbed("all"):
        before = all_settings()
        with torch_settings(CPU, threads=1):
            assert all_settings() == (torch.float32, CPU, 1, True, False, False, False, False)
        with pytest.raises(ZeroDivisionError), torch_settings(CPU, threads=1):
            raise ZeroDivisionError
        assert all_settings() == before


class Disturbing(DotEnv):
    """An environment that changes torch's settings in every call."""

    def __init__(self) -> None:
        super().__init__()
        set_double()
        set_meta()

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        set_autocast()
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        set_no_gradients()
        set_threads()
        return super().step(action)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two runs: with an environment that changes torch's settings, and with one that does not."""
    flags = ["--preset", "smoke", "--threads", "1", "--agent.precision", "fp32", "--device", "cpu"]
    flags += ["--steps", "40", "--random-steps", "20", "--seed-steps", "20"]
    flags += ["--replay.batch-size", "8", "--eval.every", "30", "--eval.episodes", "1"]
    flags += ["--eval.video", "none", "--agent.hidden-dim", "8", "--agent.latent-dim", "8"]
    flags += ["--agent.shift-pad", "1", "--agent.conv-channels", "4", "--agent.conv-strides"]
    flags += ["2", "1", "1", "1"]
    folders = []
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        for name in ("Disturbing", "DotEnv"):
            run = tmp_path_factory.mktemp("runs") / name
            with disturbed("none"):  # restore what the environment has changed
                assert main(["train", f"test_settings:{name}", *flags, "--run-dir", str(run)]) == 0
                assert main(["resume", str(run), "--steps", "50"]) == 0
                assert main(["evaluate", str(run), "--episodes", "1"]) == 0
            folders.append(run)
    return folders


def test_environment_that_changes_torch_settings_does_not_change_weights(runs: list[Path]) -> None:
    weights = [(run / "checkpoints/00000050/weights.safetensors").read_bytes() for run in runs]
    assert weights[0] == weights[1]


@pytest.mark.parametrize(("threads", "used"), [({}, 1), ({"threads": None}, 2)])
def test_loaded_policy_acts_on_one_thread_by_default(
    threads: dict[str, Any], used: int, runs: list[Path]
) -> None:
    torch.set_num_threads(2)
    policy = merl.load_policy(runs[1], **threads)
    seen: list[int] = []
    agent: Any = policy.agent
    agent.networks.actor.register_forward_hook(lambda *_: seen.append(torch.get_num_threads()))
    policy(DotEnv().reset(seed=0)[0])
    assert (seen, torch.get_num_threads()) == ([used], 2)


@pytest.mark.parametrize("threads", [0, -1, 1.5, True, "two"])
def test_number_of_threads_is_checked(threads: Any, tmp_path: Path) -> None:
    with pytest.raises(MerlError, match="threads is"):
        merl.load_policy(tmp_path, threads=threads)
