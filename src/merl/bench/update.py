"""Speed of an update compared with the same update in plain PyTorch, `examples/merl_minimal.py`.

Both have the same work: 84x84 images, three frames, proprioception of size 24, actions of size 9,
batch 256, and heads of six layers, as in the paper for `move_box` and `lift_box`.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from rich.table import Table
from torch import Tensor

from merl.accelerate.cuda_graph import Recorded, UpdateOnDevice
from merl.accelerate.device_replay import DeviceReplay
from merl.accelerate.speed_up import speed_up
from merl.agents import AGENTS, make_agent
from merl.agents.config import AgentConfig
from merl.agents.ddpg import DDPG
from merl.bench.measuring import Work, circumstances, shown, spread, take_turns
from merl.core import Batch, MerlError, Transition, counted
from merl.replay import ReplayBuffer, ReplayConfig, ReplaySpec
from merl.training.setup import choose_device
from merl.training.timing import Arithmetic

if TYPE_CHECKING:
    from merl_minimal import MERL

Precision = Literal["fp32", "bf16"]
SIDE, STACK, PROPRIO, ACTIONS, LAYERS = 84, 3, 24, 9, 6
STRIDES, HIDDEN = (2, 1, 1, 1), (1024,) * (LAYERS - 1)
REFERENCE, OURS, SB3 = "reference, fp32", "merl", "Stable-Baselines3 TD3"
EXAMPLE = "merl_minimal.py"
"""File of the reference: in a wheel beside this file, in the repository in `examples`."""
SB3_DIFFERS = (
    "not the same update: no random shift, no 3-step returns for Dict observations, no LayerNorm, "
    "no fusion; its target averages the encoder too, and it samples from its buffer"
)
BARS = {f"{OURS}, bf16": 6.0, f"{OURS}, fp32": 1.5}
"""Required speed in multiples of the reference's, on two cores with AMX-bf16."""
WHOLE, COMPILED = ", sampled on the GPU", ", compiled"
BARS_ON_GPU = {f"{OURS}, bf16{WHOLE}": 4.0, f"{OURS}, bf16{WHOLE}{COMPILED}": 4.0}
"""The same on a GPU; it applies to the variant that training chooses."""
UPDATES_ON_GPU = 50
"""Updates in a turn."""


def run(repeats: int = 5, batch_size: int = 256) -> dict[str, Any]:
    """Time an update in every variant, on a GPU if there is one, else on all threads.

    On a GPU, a turn has `UPDATES_ON_GPU` updates, and there are further variants: the whole update
    as in training, with its batch sampled from a replay on the GPU; in bf16 also with
    torch.compile, if that works.

    Args:
        repeats: number of rounds; in each round every variant has one turn.
        batch_size: B.

    Returns:
        Plain values: `updates_per_s` by variant and `ratio` (to the reference, within each round),
        each as `median`, `low` and `high` over the rounds; `skipped` and `not_compiled`, the
        reasons why a variant is missing; the values of `circumstances`.
    """
    device = choose_device("auto")
    on_gpu = device.type == "cuda"
    times = UPDATES_ON_GPU if on_gpu else 1

    def repeated(update: Work) -> Work:
        def work() -> None:
            for _ in range(times):
                update()
            if on_gpu:
                torch.cuda.synchronize()

        return work

    result: dict[str, Any] = {"repeats": repeats, "batch_size": batch_size} | circumstances()
    batch = noise_batch(batch_size).to(device)
    sides: dict[str, Work] = {
        REFERENCE: repeated(partial(reference().to(device).update, as_sample(batch)))
    }
    for precision in ("fp32", "bf16"):
        learner = learner_of("merl", precision, device)
        sides[f"{OURS}, {precision}"] = repeated(partial(learner.update, batch, step=0))
    if on_gpu:
        replay = DeviceReplay(noise_replay(), device)
        # A failed recording may break torch's generators: a recording that works follows it.
        variants: tuple[tuple[Precision, bool], ...]
        variants = ("fp32", False), ("bf16", True), ("bf16", False)
        for precision, compiled in variants:
            whole = f"{OURS}, {precision}{WHOLE}{COMPILED if compiled else ''}"
            try:
                learner = learner_of("merl", precision, device, compiled=compiled)
                sides[whole] = repeated(_recorded(learner, replay, batch_size))
            except Exception as error:
                if not compiled:
                    raise
                result["not_compiled"] = f"{whole}: {type(error).__name__}"
    try:
        sides[SB3] = repeated(_stable_baselines(batch_size, device))
        result["stable_baselines"] = SB3_DIFFERS
    except MerlError as reason:
        result["skipped"] = f"{SB3}: {reason}"
    taken = take_turns(sides, repeats, others=(REFERENCE, SB3))
    result["updates_per_s"] = {
        side: spread([times / t for t in each]) for side, each in taken.items()
    }
    result["ratio"] = {
        side: spread([theirs / t for theirs, t in zip(taken[REFERENCE], each, strict=True)])
        for side, each in taken.items()
        if side != REFERENCE
    }
    return result


def table(result: dict[str, Any]) -> Table:
    """Return the result of `run` as a table."""
    title = f"an update, batch {result['batch_size']}, median of {result['repeats']}"
    rows = Table(title=f"{title} (min to max), {counted(result['threads'], 'thread')}")
    for heading in ("", "updates/s", "times the reference", "target"):
        rows.add_column(heading, justify="right" if heading else "left")
    bars = BARS_ON_GPU if result["machine"]["gpu"] else BARS
    for side, rate in result["updates_per_s"].items():
        ratio = result["ratio"].get(side)
        bar = bars.get(side)
        rows.add_row(side, shown(rate), shown(ratio) if ratio else "", f"{bar:g}" if bar else "")
    notes = [] if result["machine"]["gpu"] else ["the targets are for two cores with AMX-bf16"]
    notes += [f"skipped: {result[why]}" for why in ("skipped", "not_compiled") if why in result]
    if "stable_baselines" in result:
        notes.append(f"{SB3}: {result['stable_baselines']}")
    rows.caption = "; ".join(notes)
    return rows


def _recorded(learner: DDPG, replay: DeviceReplay, batch_size: int) -> Work:
    """Return an update with its batch sampled from a replay on the GPU, recorded as a graph."""
    update = UpdateOnDevice(learner, replay, batch_size, seed=0)
    for _ in range(Recorded.WARM_UP + 1):
        update(0)
    return partial(update, 0)


def load_example(**constants: float) -> ModuleType:
    """Load the reference's file, with other values for some of its constants."""
    here = Path(__file__)
    files = here.with_name(EXAMPLE), here.parents[3] / "examples" / EXAMPLE
    spec = spec_from_file_location("merl_minimal", next(file for file in files if file.exists()))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    vars(module).update(constants)
    return module


def reference() -> MERL:
    """Return the reference in the size that is timed."""
    agent: MERL = load_example(PAD=4).MERL(
        (3 * STACK, SIDE, SIDE), PROPRIO, ACTIONS, STRIDES, HIDDEN
    )
    return agent


def as_sample(batch: Batch) -> list[Tensor]:
    """Convert a batch of the replay to the reference's form: frames stacked as channels."""

    def parts(seen: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        images = seen["image"].permute(0, 1, 4, 2, 3)  # (B, K, H, W, C) to (B, K C, H, W)
        return images.flatten(1, 2).contiguous(), seen["proprio"]

    reward, discount = batch.reward[:, None], batch.discount[:, None]
    given = *parts(batch.observation), batch.action, reward, discount
    return [*given, *parts(batch.next_observation)]


def learner_of(
    agent: str,
    precision: Precision,
    device: torch.device,
    side: int = SIDE,
    *,
    compiled: bool = False,
) -> DDPG:
    """Return merl's agent in the size that is timed, for images of `side` x `side` pixels."""
    arithmetic = Arithmetic(precision, torch.get_num_threads(), compiled)
    config = arithmetic.decided(AGENTS[agent].config)
    assert isinstance(config, AgentConfig)
    if agent == "merl":
        config = dataclasses.replace(config, head_layers=LAYERS)
    actions = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
    learner = make_agent(
        agent, config, space_of(side), actions, frame_stack=STACK, seed=0, device=device
    )
    assert isinstance(learner, DDPG)
    speed_up(learner)
    return learner


def noise_replay(steps: int = 2000) -> ReplayBuffer:
    """Return a replay filled with noise, in episodes of 250 steps."""
    actions = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
    replay = ReplayBuffer(ReplaySpec.of(ReplayConfig(), space_of(), actions, capacity=steps))
    rng = np.random.default_rng(0)
    for step in range(steps):
        seen = {
            "image": rng.integers(0, 256, (SIDE, SIDE, 3), np.uint8),
            "proprio": rng.standard_normal(PROPRIO, np.float32),
        }
        if step % 250 == 0:
            replay.begin(seen)
        action = rng.uniform(-1, 1, ACTIONS).astype(np.float32)
        replay.add(Transition(action, rng.uniform(), 1.0, seen, last=step % 250 == 249))
    return replay


def space_of(side: int = SIDE) -> spaces.Dict:
    """Return the observation space: `image` and `proprio`."""
    return spaces.Dict(
        {
            "image": spaces.Box(0, 255, (side, side, 3), np.uint8),
            "proprio": spaces.Box(-np.inf, np.inf, (PROPRIO,), np.float32),
        }
    )


def noise_batch(size: int, side: int = SIDE) -> Batch:
    """Return a batch of noise, the same for each call with the same size."""
    generator = torch.Generator().manual_seed(0)

    def observation() -> dict[str, Tensor]:
        shape = (size, STACK, side, side, 3)
        return {
            "image": torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator),
            "proprio": torch.randn((size, PROPRIO), generator=generator),
        }

    action = torch.rand((size, ACTIONS), generator=generator) * 2 - 1
    reward = torch.rand(size, generator=generator)
    return Batch(observation(), action, reward, torch.full((size,), 0.97), observation())


def _stable_baselines(batch_size: int, device: torch.device) -> Work:
    """Return an update of Stable-Baselines3's TD3 with the same encoder.

    Raises:
        MerlError: Stable-Baselines3 is not installed.
    """
    try:
        from stable_baselines3 import TD3
        from stable_baselines3.common.logger import Logger
        from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    except ImportError:
        raise MerlError('not installed: pip install "merl-rl[bench]"') from None

    class Extractor(BaseFeaturesExtractor):  # type: ignore[misc]
        """The encoded image and the proprioception, concatenated."""

        def __init__(self, observation_space: spaces.Dict) -> None:
            encoder = load_example().encoder(3 * STACK, STRIDES)
            features = encoder(torch.zeros(1, 3 * STACK, SIDE, SIDE)).shape[1]
            super().__init__(observation_space, features + PROPRIO)
            self.encoder = encoder

        def forward(self, observation: dict[str, Tensor]) -> Tensor:
            encoded = self.encoder(observation["image"] / 255 - 0.5)
            return torch.cat([encoded, observation["proprio"]], dim=-1)

    env = _Idle()
    model = TD3(
        "MultiInputPolicy",
        env,
        learning_rate=1e-4,
        buffer_size=batch_size,
        batch_size=batch_size,
        tau=0.01,
        policy_delay=1,
        policy_kwargs={
            "features_extractor_class": Extractor,
            "net_arch": [1024] * (LAYERS - 1),
            "share_features_extractor": True,
            "normalize_images": False,
        },
        device=device,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    noise = np.random.default_rng(0)
    for _ in range(batch_size):
        seen, then = (
            {key: value[None] for key, value in env.observation_space.sample().items()}
            for _ in range(2)
        )
        action, reward = noise.uniform(-1, 1, (1, ACTIONS)), noise.uniform(0, 1, 1)
        model.replay_buffer.add(seen, then, action, reward, np.array([False]), [{}])
    return lambda: model.train(gradient_steps=1, batch_size=batch_size)


class _Idle(gymnasium.Env[Any, Any]):
    """Dummy environment that only provides spaces."""

    def __init__(self) -> None:
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, (3 * STACK, SIDE, SIDE), np.uint8),
                "proprio": spaces.Box(-1.0, 1.0, (PROPRIO,), np.float32),
            }
        )
        self.action_space = spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)
