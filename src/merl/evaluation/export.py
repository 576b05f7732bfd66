"""Export a policy to one file without merl: ONNX, a program of torch.export, or Python with NumPy.

The exported function remembers nothing. Its inputs are one observation (each key that the policy
uses) and, for each camera, the former frames; its outputs are the action in the environment's own
units and the frames to pass with the next observation. At the start of an episode the former frames
are copies of the first one.
"""

from __future__ import annotations

import json
import logging
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import merl
from merl.acting.run_env import recipe
from merl.agents.ddpg import DDPG
from merl.core import MerlError, check_choice
from merl.core.files import cause, remove
from merl.core.user_code import place
from merl.evaluation.exported import FORMER, NEXT, Form, Run, Values, card_of, load_exported
from merl.evaluation.policy import Policy
from merl.evaluation.to_numpy import numpy_program
from merl.runs import record
from merl.runs.plain import describe, to_plain

TOLERANCE = 1e-4
"""Largest relative difference between the actions of the policy and of its exported form."""
CALLS = 200
"""Calls of the latency's measurement."""


class Deployed(nn.Module):
    """The policy of one observation, as it is exported.

    Args:
        policy: the policy of one of merl's agents.
        bounds: lower and upper bounds of the environment's actions; None if they are [-1, 1].
    """

    low: Tensor
    high: Tensor

    def __init__(self, policy: Policy, bounds: tuple[list[float], list[float]] | None) -> None:
        super().__init__()
        agent = policy.agent
        if not isinstance(agent, DDPG):
            raise MerlError(
                "only the policies of merl's own agents can be exported: export yours with torch"
            )
        networks = agent.networks.cpu().eval()
        if networks.imitator is not None:
            raise MerlError(
                "a policy of agent ibrl chooses by its critic, which merl export does not write: "
                "export one of agent merl that starts from it (--agent.start-from RUN)"
            )
        average = networks.policy_average
        self.encoders = networks.encoders
        self.fusion = networks.fusion_of_actor() if average is None else average["fusion"]
        self.actor = networks.actor if average is None else average["actor"]
        self.keys = tuple(policy.modalities)
        self.stacked = tuple(key for key, m in policy.modalities.items() if m.stacked)
        size = networks.actor.action_dim
        low, high = bounds or ([-1.0] * size, [1.0] * size)
        self.register_buffer("low", torch.tensor(low, dtype=torch.float32))
        self.register_buffer("high", torch.tensor(high, dtype=torch.float32))

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the action (A,) and the former frames (K - 1, H, W, C) of each camera.

        Args:
            *inputs: the observation by `keys`, then the former frames by `stacked`.
        """
        observation = dict(zip(self.keys, inputs, strict=False))
        former = dict(zip(self.stacked, inputs[len(self.keys) :], strict=True))
        stacks = {
            key: torch.cat([former[key], observation[key].unsqueeze(0)]) for key in self.stacked
        }
        encoded = self.encoders({k: v.unsqueeze(0) for k, v in (observation | stacks).items()})
        best: Any = self.actor.best
        action = best(self.actor(self.fusion(encoded)))[0]
        scaled = self.low + (action + 1.0) * 0.5 * (self.high - self.low)
        return scaled, *(stacks[key][1:] for key in self.stacked)


def export_policy(policy: Policy, output: Path, form: Form) -> dict[str, Any]:
    """Export a policy; write its card beside it, as JSON.

    Args:
        policy: the policy.
        output: the file; the card has the same name with `.json` appended.
        form: `onnx`, `torch` or `numpy`.

    Returns:
        The card: inputs and outputs with shapes, types and bounds, the source, the latency.

    Raises:
        MerlError: the policy is that of a user's own agent, it cannot be translated, a package is
            missing, or a file cannot be written.
    """
    check_choice("form", form, get_args(Form))
    recorded = {} if policy.run is None else record.read(policy.run.path)
    bounds = recorded.get("action_space", {}).get("own_bounds")
    module = Deployed(policy, None if bounds is None else (bounds[0], bounds[1]))
    example = inputs_of(policy, seed=0)
    names = [*module.keys, *(key + FORMER for key in module.stacked)]
    outputs = ["action", *(key + NEXT for key in module.stacked)]
    arguments = tuple(torch.from_numpy(example[name]) for name in names)
    part = output.with_name(f".part-{output.name}")
    config = policy.config
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with torch.no_grad(), _quiet(), _translating(form):
            if form == "onnx":
                _write_onnx(module, arguments, names, outputs, part)
            elif form == "torch":
                with part.open("wb") as file:
                    torch.export.save(torch.export.export(module, arguments), file)
            else:
                program = torch.export.export(module, arguments)
                title = f"A policy for {config.task}, written by merl {merl.__version__}."
                text = numpy_program(program, names, outputs, title, output.stem)
                part.write_text(text)
            run = load_exported(part, names, outputs)
            _check_same(module, run, example, arguments)
        part.replace(output)
        card = {
            "format": form,
            "merl": merl.__version__,
            "task": config.task,
            "env": None if config.has_user_env else to_plain(recipe(config.evaluated).env),
            "action_repeat": config.action_repeat,
            "agent": config.agent_name,
            "step": policy.step,
            "commit": recorded.get("commit"),
            "inputs": {name: _told(example[name]) for name in names},
            "outputs": {name: _told(value) for name, value in run(example).items()},
            "observations": {key: describe(m.space) for key, m in policy.modalities.items()},
            "action_bounds": [module.low.tolist(), module.high.tolist()],
            "former_frames": "at the start of an episode, copies of the first frame",
            "milliseconds": _latency(run, example),
        }
        card_of(output).write_text(json.dumps(card, indent=1) + "\n")
    except OSError as error:
        raise MerlError(f"{output} cannot be written: {cause(error)}") from error
    finally:
        remove(part)
    return card


@contextmanager
def _translating(form: Form) -> Iterator[None]:
    """Turn an error of an exporter, or of what it wrote, into one line.

    Raises:
        MerlError: in place of the error, but for those of the disk.
    """
    try:
        yield
    except (MerlError, OSError):
        raise
    except Exception as error:  # a user's encoder may do what no exporter can translate
        source = error.__cause__ or error  # torch.onnx adds a page of advice
        first = (str(source).strip().splitlines() or [type(source).__name__])[0]
        raise MerlError(
            f"the policy cannot be written as {form}: {first}{place(source)}: its encoders must "
            "consist of operations that torch.export knows, without branches on values"
        ) from error


def _check_same(module: Deployed, run: Run, example: Values, arguments: tuple[Tensor, ...]) -> None:
    """Check that an exported function computes what the policy computes.

    Raises:
        MerlError: it does not.
    """
    with torch.no_grad():
        expected = module(*arguments)[0].numpy()
    difference = float(np.abs(run(example)["action"] - expected).max())
    if not difference < TOLERANCE * max(1.0, float(np.abs(expected).max())):
        raise MerlError(
            f"the exported policy's actions differ by {difference:.2g} from the policy's: use "
            "another form"
        )


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the exporters' messages about packages and internals that no policy needs."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def _write_onnx(
    module: Deployed,
    arguments: tuple[Tensor, ...],
    names: list[str],
    outputs: list[str],
    output: Path,
) -> None:
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError:
        raise MerlError(
            "ONNX needs further packages: pip install 'merl-rl[onnx]', or use --to torch"
        ) from None
    program = torch.onnx.export(
        module,
        arguments,
        dynamo=True,
        input_names=names,
        output_names=outputs,
        verbose=False,
        external_data=False,
    )
    assert program is not None
    program.save(str(output), external_data=False)


def inputs_of(policy: Policy, seed: int) -> dict[str, NDArray[Any]]:
    """Return random inputs of an exported policy."""
    generator = torch.Generator().manual_seed(seed)
    frames = policy.config.replay.frame_stack
    found = {key: m.random(1, frames, generator)[0] for key, m in policy.modalities.items()}
    stacked = {key: value for key, value in found.items() if policy.modalities[key].stacked}
    newest = found | {key: value[-1] for key, value in stacked.items()}
    former = {key + FORMER: value[:-1] for key, value in stacked.items()}
    return {key: value.contiguous().numpy() for key, value in (newest | former).items()}


def _told(value: NDArray[Any]) -> dict[str, Any]:
    return {"dtype": str(value.dtype), "shape": list(value.shape)}


def _latency(run: Run, example: Values) -> dict[str, float]:
    """Return the median and the 99th percentile of a call's time on one thread, ms."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    times = []
    for _ in range(CALLS):
        begin = time.perf_counter()
        run(example)
        times.append(1000 * (time.perf_counter() - begin))
    torch.set_num_threads(threads)
    middle, late = np.percentile(times[CALLS // 10 :], [50, 99])
    return {"p50": round(float(middle), 3), "p99": round(float(late), 3)}
