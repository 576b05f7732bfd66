"""A new agent starts with the policy of another run."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

import merl
from merl.cli import main
from merl.core import MerlError
from merl.training.setup import load_initial_weights

TINY = ["train", "reach_duplo", "--preset", "smoke", "--steps", "260", "--eval.every", "0"]
TINY += ["--threads", "1", "--agent.precision", "fp32"]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run whose average of the actor differs from its newest weights."""
    run = tmp_path_factory.mktemp("source") / "run"
    assert main([*TINY, "--run-dir", str(run), "--agent.actor-average", "0.5"]) == 0
    return run


@pytest.mark.parametrize("average", [None, 0.01])
def test_the_policy_is_that_of_the_run(source: Path, average: float | None) -> None:
    given, policy = merl.load_policy(source), merl.load_policy(source)
    rng = np.random.default_rng(0)
    observation = {
        "image": rng.integers(0, 256, (32, 32, 3), dtype=np.uint8),
        "proprio": rng.normal(size=24).astype(np.float32),
    }
    expected = given(observation)
    agent = policy.agent
    config = dataclasses.replace(
        agent.config,  # type: ignore[attr-defined]
        start_from=source.name,
        actor_average=average,
    )
    torch.manual_seed(7)
    new = type(agent)(  # type: ignore[call-arg]
        config,
        *given.run.spaces(),  # type: ignore[union-attr]
        frame_stack=given.config.replay.frame_stack,
        seed=7,
        device=torch.device("cpu"),
    )
    critic = [p.clone() for p in new.networks.critic.parameters()]
    load_initial_weights(new, source.parent)
    policy.agent = new
    policy.reset()
    np.testing.assert_array_equal(policy(observation), expected)
    # Exploration begins with the same weights, and the critic stays as it was made.
    stack = {key: torch.from_numpy(value)[None] for key, value in observation.items()}
    stack["image"] = stack["image"][:, None].repeat(1, given.config.replay.frame_stack, 1, 1, 1)
    mean = new.networks.policy(stack)[0].detach().numpy()
    np.testing.assert_array_equal(mean, expected)
    for before, after in zip(critic, new.networks.critic.parameters(), strict=True):
        assert torch.equal(before, after)


def test_a_run_begins_with_it_and_resumes(source: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    command = [*TINY, "--run-dir", str(run), "--agent.start-from", str(source)]
    assert main([*command, "--random-steps", "1"]) == 0
    assert merl.load_policy(run).config.agent.start_from == source  # type: ignore[attr-defined]
    assert main(["resume", str(run), "--steps", "300"]) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--agent.hidden-dim", "64"], "does not fit: size mismatch for layers.0.linear.weight"),
        (["--agent.keys", "proprio"], "does not fit"),
        (["--agent", "sac"], "does not fit"),
    ],
)
def test_a_policy_of_another_size_is_refused(
    options: list[str],
    words: str,
    source: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    command = [*TINY, "--run-dir", str(run), "--agent.start-from", str(source), *options]
    assert main(command) == MerlError.exit_code
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert not run.exists()
