"""The update of a training run: sample a batch from the replay, and let the agent learn from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from merl.accelerate.cuda_graph import UpdateFromHost, UpdateOnDevice
from merl.accelerate.device_replay import DeviceReplay, bytes_on_device
from merl.config import TrainConfig
from merl.core import Accelerable, Agent
from merl.networks.settings import torch_settings
from merl.replay import ReplayBuffer
from merl.replay.mixing import MixedReplay
from merl.training.loop import Randomness, Update

ROOM = 0.8
"""Maximum share of a GPU's free memory for a copy of the replay."""


def make_update(
    agent: Agent,
    replay: ReplayBuffer | MixedReplay,
    randomness: Randomness,
    config: TrainConfig,
    device: torch.device,
    warn: Callable[[str], None],
    updates: int = 0,
) -> Update:
    """Return the update that is fastest on the agent's device.

    The environments may share this process and change torch's settings; sampling and updates use
    merl's settings.

    Args:
        agent: the learner.
        replay: the replay, with all steps of the run so far, and with the demonstrations if the
            run has any.
        randomness: the run's random streams.
        config: the config of the run.
        device: device of the agent.
        warn: receives the reason if the replay is not copied to the GPU.
        updates: number of updates so far.
    """
    with torch_settings(device, config.threads):
        if not isinstance(agent, Accelerable):
            update = plain_update(agent, replay, randomness, config)
        elif device.type == "cuda":
            update = update_on_gpu(agent, replay, randomness, config, warn, updates)
        else:
            update = update_on_cpu(agent, replay, randomness, config)

    def update_with_settings(step: int) -> dict[str, Tensor]:
        if isinstance(replay, MixedReplay):
            replay.ratio = config.demos_share(step)
        with torch_settings(device, config.threads):
            return update(step)

    return update_with_settings


def plain_update(
    agent: Agent, replay: ReplayBuffer | MixedReplay, randomness: Randomness, config: TrainConfig
) -> Update:
    """Return an update that samples a batch and hands it to the agent, for any agent."""
    size, batches = config.replay.batch_size, randomness.batches
    return lambda step: agent.update(replay.sample(size, batches), step=step)


def update_on_cpu(
    agent: Accelerable,
    replay: ReplayBuffer | MixedReplay,
    randomness: Randomness,
    config: TrainConfig,
) -> Update:
    """Return the same update, with the random shift applied while images are copied."""
    size, batches = config.replay.batch_size, randomness.batches

    def update(step: int) -> dict[str, Tensor]:
        plan = agent.plan(step)
        noise = agent.draw(size, plan)
        batch = replay.sample(size, batches, *agent.frame_transforms(noise))
        return agent.learn(batch, replace(noise, shifts={}, next_shifts={}), plan)

    return update


def update_on_gpu(
    agent: Accelerable,
    replay: ReplayBuffer | MixedReplay,
    randomness: Randomness,
    config: TrainConfig,
    warn: Callable[[str], None],
    updates: int,
) -> Update:
    """Return a recorded update, with batches from a copy of the replay on the GPU if it fits."""
    torch.cuda.empty_cache()  # return the cached memory of the timed agents
    size = config.replay.batch_size
    if isinstance(replay, MixedReplay):
        pass  # each update copies its batch to the GPU
    elif config.replay.compress:
        warn("the compressed replay stays on the host: each update copies its batch to the GPU")
    elif bytes_on_device(replay) > ROOM * torch.cuda.mem_get_info()[0]:
        warn("the replay does not fit on the GPU: each update copies its batch to the GPU")
    else:
        copy = DeviceReplay(replay, agent.device)
        return UpdateOnDevice(agent, copy, size, randomness.on_device(updates))
    return UpdateFromHost(agent, lambda: replay.sample(size, randomness.batches))
