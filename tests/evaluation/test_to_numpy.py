"""The Python file that needs NumPy alone computes what the policy computes, for every network."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from merl.agents import AGENTS, make_agent
from merl.config import TrainConfig
from merl.core import MerlError
from merl.evaluation.export import export_policy
from merl.evaluation.exported import ExportedPolicy, Form
from merl.evaluation.policy import Policy

SPACE = spaces.Dict(
    {
        "depth": spaces.Box(0.0, 2.0, (24, 24, 1), np.float32),
        "force": spaces.Box(-9.0, 9.0, (8, 3), np.float32),
        "image": spaces.Box(0, 255, (24, 32, 3), np.uint8),
        "joint": spaces.Box(-np.inf, np.inf, (6,), np.float32),
    }
)
SMALL = {"hidden_dim": 32, "conv_channels": 8, "latent_dim": 64, "precision": "fp32"}


def make_policy(name: str, space: spaces.Dict, **values: Any) -> Policy:
    config = replace(AGENTS[name].config, **SMALL | values)
    run = TrainConfig("somewhere:make", agent_name=name, agent=config)
    agent = make_agent(
        name,
        config,
        space,
        spaces.Box(-1.0, 1.0, (4,), np.float32),
        frame_stack=run.replay.frame_stack,
        seed=1,
        device=torch.device("cpu"),
    )
    return Policy(agent, run, space, torch.device("cpu"))


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("merl", {}),
        ("merl", {"fusion_layer": "attention"}),
        ("merl", {"fusion_layer": "simnorm", "fusion_norm": False}),
        ("merl", {"encoders": {"image": "impala", "force": "transformer", "joint": "mlp"}}),
        ("merl", {"standardize": True, "actor_average": 0.1, "latent_dim": 0}),
        ("drqv2", {}),
        ("sac", {"keys": ("joint",), "latent_dim": 0}),
    ],
)
def test_actions_equal_those_of_the_policy(
    name: str, values: dict[str, Any], tmp_path: Path
) -> None:
    policy = make_policy(name, SPACE, **values)
    if values.get("standardize"):
        generator = torch.Generator().manual_seed(3)
        batch = {key: m.random(64, 3, generator) for key, m in policy.modalities.items()}
        policy.agent.networks.encoders.observe(batch)  # type: ignore[attr-defined]
    export_policy(policy, tmp_path / "p.py", "numpy")
    exported = ExportedPolicy(tmp_path / "p.py")
    for _ in range(3):
        policy.reset()
        exported.reset()
        for _ in range(4):
            observation = {key: m.space.sample() for key, m in policy.modalities.items()}
            action = policy(observation)
            np.testing.assert_allclose(exported(observation), action, rtol=0, atol=1e-5)


def test_the_file_needs_neither_merl_nor_torch(tmp_path: Path) -> None:
    policy = make_policy("merl", spaces.Dict(image=SPACE["image"], joint=SPACE["joint"]))
    export_policy(policy, tmp_path / "arm.py", "numpy")
    script = """
import sys
sys.modules["torch"] = sys.modules["merl"] = None  # importing either fails
import numpy as np
from arm import Policy
policy = Policy()
image, joint = np.full((24, 32, 3), 7, np.uint8), np.ones(6, np.float32)
for _ in range(2):
    action = policy({"image": image, "joint": joint})
print(*action)
"""
    shown = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    observation = {"image": np.full((24, 32, 3), 7, np.uint8), "joint": np.ones(6, np.float32)}
    np.testing.assert_allclose([float(x) for x in shown.split()], policy(observation), atol=1e-5)


ENCODERS = """
import torch
from torch import nn

class Plain(nn.Module):
    def __init__(self, modality, stack):
        super().__init__()
        channels = stack * modality.shape[2]
        convolution = nn.Conv2d(channels, 4, 5, 3, bias=False)
        norm = nn.LayerNorm(10, elementwise_affine=False)
        self.layers = nn.Sequential(convolution, norm, nn.ReLU(), nn.Flatten())
        self.features = 4 * 7 * 10

    def forward(self, pixels):
        return self.layers(pixels)

class Branching(Plain):
    def forward(self, pixels):
        encoded = super().forward(pixels)
        return encoded if encoded.sum() > 1 else -encoded
"""


@pytest.fixture
def encoders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a module with encoders of the user's own."""
    name = f"encoders_{abs(hash(tmp_path)) % 10**9}"
    (tmp_path / f"{name}.py").write_text(ENCODERS)
    monkeypatch.syspath_prepend(tmp_path)
    return name


def test_layers_without_bias_and_weights(encoders: str, tmp_path: Path) -> None:
    space = spaces.Dict(image=SPACE["image"])
    policy = make_policy("drqv2", space, encoders={"image": f"{encoders}:Plain"})
    export_policy(policy, tmp_path / "p.py", "numpy")
    observation = {"image": SPACE["image"].sample()}
    exported = ExportedPolicy(tmp_path / "p.py")
    np.testing.assert_allclose(exported(observation), policy(observation), rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", ["onnx", "torch", "numpy"])
def test_what_cannot_be_translated_is_one_line(form: Form, encoders: str, tmp_path: Path) -> None:
    if form == "onnx":
        pytest.importorskip("onnxruntime")
    space = spaces.Dict(image=SPACE["image"])
    policy = make_policy("drqv2", space, encoders={"image": f"{encoders}:Branching"})
    with pytest.raises(MerlError, match=f"cannot be written as {form}: ") as caught:
        export_policy(policy, tmp_path / "out/p", form)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
    assert not any((tmp_path / "out").iterdir())


def test_an_operation_without_a_form_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(
        __import__("merl.evaluation.to_numpy", fromlist=["FORMS"]).FORMS, "tanh.default"
    )
    policy = make_policy("merl", spaces.Dict(joint=SPACE["joint"]))
    with pytest.raises(MerlError, match="which --to numpy does not know"):
        export_policy(policy, tmp_path / "p.py", "numpy")
    assert not any(tmp_path.iterdir())
