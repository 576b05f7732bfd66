"""A program of torch.export as a Python file that needs NumPy alone, with the weights inside."""

from __future__ import annotations

import base64
import io
import operator
import textwrap
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.fx import Node

from merl.core import MerlError

HEAD = '''\
"""{title}

    from {module} import Policy

    policy = Policy()
    policy.reset()  # at the start of each episode
    action = policy({{{example}}})
"""

import base64
import io
import zlib

import numpy as np


class Policy:
    """Acts on one observation at a time; it keeps the former frames of each camera itself."""

    def __init__(self):
        content = zlib.decompress(base64.b85decode("".join(WEIGHTS.split())))
        with np.load(io.BytesIO(content)) as arrays:
            self.weights = {{name: arrays[name] for name in arrays.files}}
        self.reset()

    def reset(self):
        """Start a new episode: discard the former frames."""
        self.frames = {{}}

    def __call__(self, observation):
        """Return the action in the environment's own units, float32 (A,)."""
        values = {{}}
        for name, (dtype, shape) in INPUTS.items():
            value = np.asarray(observation[name])
            if value.shape != shape or not np.can_cast(value.dtype, dtype, "same_kind"):
                given = f"{{value.dtype}} {{value.shape}}"
                raise ValueError(f"{{name}} is {{given}}, not {{dtype}} {{shape}}")
            values[name] = value.astype(dtype)
        for name, frame, count in FORMER:
            copies = np.repeat(values[frame][None], count, axis=0)
            values[name] = self.frames.get(name, copies)
        found = compute(self.weights, values)
        for name, frame, _ in FORMER:
            self.frames[name] = found[frame + "_next"]
        return found["action"]


def windows(x, size, stride, padding, fill):
    """Return the windows of x (B, C, ...) over its last axes, as (B, C, ..., *size)."""
    x = np.pad(x, ((0, 0), (0, 0), *((p, p) for p in padding)), constant_values=fill)
    axes = tuple(range(2, x.ndim))
    found = np.lib.stride_tricks.sliding_window_view(x, size, axis=axes)
    return found[(slice(None), slice(None), *(slice(None, None, s) for s in stride))]


def convolve(x, weight, bias, stride, padding):
    """Convolve signals or images (B, C, ...) with kernels (N, C, ...)."""
    count = weight.ndim - 2
    patches = windows(x, weight.shape[2:], stride, padding, 0)
    inner = (1, *range(2 + count, 2 + 2 * count)), (1, *range(2, 2 + count))
    return np.moveaxis(np.tensordot(patches, weight, inner) + bias, -1, 1)


def max_pool(x, size, stride, padding):
    """Return the largest value of each window."""
    axes = tuple(range(-len(size), 0))
    return windows(x, size, stride, padding, -np.inf).max(axes)


def layer_norm(x, weight, bias, eps):
    """Normalise the last axis."""
    centred = x - x.mean(-1, keepdims=True)
    scale = np.sqrt((centred**2).mean(-1, keepdims=True) + np.float32(eps))
    return centred / scale * weight + bias


def softmax(x, axis):
    """Return exp(x), divided by its sum along an axis."""
    powers = np.exp(x - x.max(axis, keepdims=True))
    return powers / powers.sum(axis, keepdims=True)


def split(x, sizes, axis):
    """Split an axis into parts of these sizes."""
    return np.split(x, np.cumsum(sizes)[:-1], axis)


def cut(x, axis, begin, end):
    """Return x[begin:end] along an axis."""
    return np.moveaxis(np.moveaxis(x, axis, 0)[begin:end], 0, axis)


'''
"""The beginning of the file; `compute` and the weights follow."""


def _binary(sign: str) -> Callable[..., str]:
    def form(a: Any, b: Any, *, alpha: Any = 1) -> str:
        return f"{a} {sign} {b}" if alpha == 1 else f"{a} {sign} {alpha} * {b}"

    return form


def _same(x: str, *_: Any, **__: Any) -> str:
    return x


def _cast(x: str, *, dtype: Any = None, **_: Any) -> str:
    return x if dtype is None else f"{x}.astype(np.{str(dtype).rpartition('.')[2]})"


def _convolution(
    x: str,
    weight: str,
    bias: str | None,
    stride: Any,
    padding: Any,
    dilation: Any,
    transposed: Any,
    _: Any,
    groups: Any,
) -> str:
    if transposed or groups != 1 or set(dilation) != {1}:
        raise NotImplementedError
    return f"convolve({x}, {weight}, {bias or 0}, {stride}, {padding})"


def _limits(x: str, low: Any = None, high: Any = None) -> str:
    return f"np.clip({x}, {low}, {high})"


def _cut(x: str, axis: int = 0, begin: Any = None, end: Any = None) -> str:
    return f"cut({x}, {axis}, {begin}, {end})"


def _sum(x: str, axes: Any, keep: bool = False) -> str:
    return f"np.sum({x}, axis={tuple(axes)}, keepdims={keep})"


FORMS: dict[str, Callable[..., str]] = {
    "add.Tensor": _binary("+"),
    "sub.Tensor": _binary("-"),
    "mul.Tensor": _binary("*"),
    "div.Tensor": _binary("/"),
    "mul.Scalar": _binary("*"),
    "eq.Scalar": _binary("=="),
    "mm.default": _binary("@"),
    "bmm.default": _binary("@"),
    "addmm.default": lambda bias, a, b: f"{bias} + {a} @ {b}",
    "alias.default": _same,
    "clone.default": _same,
    "detach.default": _same,
    "expand.default": lambda x, shape, **_: f"np.broadcast_to({x}, {shape})",
    "_to_copy.default": _cast,
    "view.default": lambda x, shape: f"np.reshape({x}, {shape})",
    "_unsafe_view.default": lambda x, shape: f"np.reshape({x}, {shape})",
    "unsqueeze.default": lambda x, axis: f"np.expand_dims({x}, {axis})",
    "squeeze.dim": lambda x, axis: f"np.squeeze({x}, {axis})",
    "permute.default": lambda x, axes: f"np.transpose({x}, {axes})",
    "cat.default": lambda parts, axis=0: f"np.concatenate([{', '.join(parts)}], {axis})",
    "select.int": lambda x, axis, index: f"np.take({x}, {index}, {axis})",
    "slice.Tensor": _cut,
    "sum.dim_IntList": _sum,
    "convolution.default": _convolution,
    "native_layer_norm.default": lambda x, _, w, b, eps: (
        f"(layer_norm({x}, {w or 1}, {b or 0}, {eps}),)"
    ),
    "relu.default": lambda x: f"np.maximum({x}, 0)",
    "tanh.default": lambda x: f"np.tanh({x})",
    "sqrt.default": lambda x: f"np.sqrt({x})",
    "rsqrt.default": lambda x: f"1 / np.sqrt({x})",
    "logical_not.default": lambda x: f"~{x}",
    "any.dim": lambda x, axis, keep=False: f"np.any({x}, {axis}, keepdims={keep})",
    "where.self": lambda test, a, b: f"np.where({test}, {a}, {b})",
    "full_like.default": lambda x, value, **_: f"np.full_like({x}, {value})",
    "split_with_sizes.default": lambda x, sizes, axis=0: f"split({x}, {sizes}, {axis})",
    "squeeze.dims": lambda x, axes: f"np.squeeze({x}, {tuple(axes)})",
    "max_pool2d_with_indices.default": lambda x, size, stride, padding=(0, 0): (
        f"(max_pool({x}, {size}, {stride}, {padding}),)"
    ),
    "clamp.default": _limits,
    "_softmax.default": lambda x, axis, _: f"softmax({x}, {axis})",
}
"""NumPy's form of each operation, from its arguments as text."""


def numpy_program(
    program: torch.export.ExportedProgram,
    names: list[str],
    outputs: list[str],
    title: str,
    module: str,
) -> str:
    """Return the text of a Python file that computes what a program does.

    Args:
        program: the program, whose inputs and outputs are single tensors.
        names: names of the inputs; `NAME_former` holds the former frames of `NAME`.
        outputs: names of the outputs.
        title: the first line of the file's docstring.
        module: name of the file, without its ending.

    Raises:
        MerlError: the program has an operation without a form here.
    """
    if not module.isidentifier():
        raise MerlError(f"a Python file cannot be named {module}.py: give another name with --out")
    program = program.run_decompositions()
    known: dict[str, Any] = dict(_constants(program))
    weights: dict[str, Tensor] = {}
    text: dict[str, str] = {}
    lines: list[str] = []
    kinds: dict[str, tuple[str, tuple[int, ...]]] = {}
    inputs = iter(names)

    def told(value: Any) -> Any:
        """Return an argument as text; a constant tensor becomes a weight."""
        if isinstance(value, Node):
            if value.name in known:
                weights[value.name] = known[value.name]
                return f'w["{value.name}"]'
            return text[value.name]
        if isinstance(value, list | tuple):
            return [told(each) for each in value]
        return f'float("{value}")' if value in (float("inf"), -float("inf")) else value

    for node in program.graph.nodes:
        if node.op == "placeholder":
            if node.name not in known:
                name = next(inputs)
                text[node.name] = f'values["{name}"]'
                value = node.meta["val"]
                kinds[name] = str(value.dtype).rpartition(".")[2], tuple(value.shape)
        elif node.op == "output":
            results = [told(each) for each in node.args[0]]
        elif all(each.name in known for each in node.all_input_nodes):
            known[node.name] = _value(node, known)
        elif "_assert_tensor_metadata" not in str(node.target):
            lines.append(f"{node.name} = {_form(node, told)}")
            text[node.name] = node.name
    pairs = ", ".join(f'"{name}": {value}' for name, value in zip(outputs, results, strict=True))
    body = [*lines, f"return {{{pairs}}}"]
    plain = {name: kind for name, kind in kinds.items() if not name.endswith("_former")}
    former = [
        (name, name.removesuffix("_former"), kinds[name][1][0])
        for name in names
        if name.endswith("_former")
    ]
    example = ", ".join(f'"{name}": {name}' for name in plain)
    head = HEAD.format(title=title, module=module, example=example)
    return (
        head
        + "def compute(w, values):\n"
        + '    """Return action and frames for an observation and the former frames."""\n'
        + textwrap.indent("\n".join(body), "    ")
        + f"\n\n\nINPUTS = {plain!r}\nFORMER = {former!r}\n"
        + f'WEIGHTS = """\n{_packed(weights)}\n"""\n'
    )


def _form(node: Node, told: Callable[[Any], Any]) -> str:
    if node.target is operator.getitem:
        return f"{told(node.args[0])}[{node.args[1]}]"
    name = str(node.target).removeprefix("aten.")
    arguments = [told(each) for each in node.args]
    try:
        return FORMS[name](*arguments, **{key: told(v) for key, v in node.kwargs.items()})
    except (KeyError, NotImplementedError, TypeError):
        raise MerlError(
            f"the policy uses {name}, which --to numpy does not know: use --to onnx"
        ) from None


def _value(node: Node, known: dict[str, Any]) -> Any:
    """Compute a node all of whose inputs are constants."""
    arguments, options = torch.fx.node.map_arg(
        (node.args, node.kwargs), lambda each: known[each.name]
    )
    function: Any = node.target
    return function(*arguments, **options)


def _constants(program: torch.export.ExportedProgram) -> dict[str, Tensor]:
    """Return parameters and buffers by the names of their nodes."""
    signature = program.graph_signature
    found = {
        node: program.state_dict[name] for node, name in signature.inputs_to_parameters.items()
    }
    for node, name in signature.inputs_to_buffers.items():
        held = program.state_dict if name in program.state_dict else program.constants
        found[node] = held[name]
    for node, name in signature.inputs_to_lifted_tensor_constants.items():
        found[node] = program.constants[name]
    return {name: value.detach() for name, value in found.items()}


def _packed(weights: dict[str, Tensor]) -> str:
    """Return arrays as text, in lines."""
    file = io.BytesIO()
    arrays: dict[str, Any] = {name: value.numpy() for name, value in weights.items()}
    np.savez(file, **arrays)
    text = base64.b85encode(zlib.compress(file.getvalue(), 9)).decode()
    return "\n".join(text[i : i + 100] for i in range(0, len(text), 100))
