"""Random generators that an environment may use in addition to Gymnasium's `np_random`.

The global generators of NumPy, Python and torch (if something has imported it, which takes seconds)
belong to the whole process. They are seeded with the seed of an episode if it has one, and they are
saved in checkpoints. An evaluation restores them at its end, together with the generators of its
environment.
"""

from __future__ import annotations

import base64
import json
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


def seed_global_generators(seed: int) -> None:
    """Seed the global generators of NumPy, Python and torch."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (environments use this generator)
    if (torch := _torch()) is not None:
        torch.manual_seed(seed)


def global_state() -> dict[str, Any]:
    """Return the state of the global generators as plain types, for JSON."""
    version, words, gauss = random.getstate()
    numpy: dict[str, Any] = dict(np.random.get_state(legacy=False))  # noqa: NPY002
    numpy["state"] = {
        name: part.tolist() if isinstance(part, np.ndarray) else part
        for name, part in numpy["state"].items()
    }
    state = {"python": [version, list(words), gauss], "numpy": numpy}
    if (torch := _torch()) is not None:
        state["torch"] = base64.b64encode(torch.get_rng_state().numpy().tobytes()).decode()
    return state


def set_global_state(state: Mapping[str, Any]) -> None:
    """Restore the global generators from `global_state()`."""
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    np.random.set_state({**state["numpy"]})  # noqa: NPY002
    if "torch" in state:
        import torch

        data = bytearray(base64.b64decode(state["torch"]))
        torch.set_rng_state(torch.frombuffer(data, dtype=torch.uint8))


def _torch() -> Any:
    """Return torch if something has imported it, else None."""
    return sys.modules.get("torch")


def environment_state(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the state of an environment's random generators, as plain types.

    An environment with other generators has different episodes after a resume.

    Returns:
        The state of the environment's `np_random` (`bit_generator` is one of its keys), empty if
        the environment does not use it, and under `globals` the state of the global generators of
        the process.
    """
    state: dict[str, Any] = {}
    # Gymnasium's property `np_random` makes a generator on access; this attribute does not.
    generator = getattr(env.unwrapped, "_np_random", None)
    if isinstance(generator, np.random.Generator):
        state = dict(generator.bit_generator.state)
        try:
            json.dumps(state)
        except TypeError:
            state = {}
    return state | {"globals": global_state()}


def set_environment_state(env: gymnasium.Env[Any, Any], state: Mapping[str, Any] | None) -> None:
    """Restore from `environment_state()`."""
    own = dict(state or {})
    shared = own.pop("globals", None)
    if shared is not None:
        set_global_state(shared)
    if own:
        env.unwrapped.np_random.bit_generator.state = own


@contextmanager
def kept_generators(env: gymnasium.Env[Any, Any]) -> Iterator[None]:
    """Restore the global random generators and those of an environment at the end of the block.

    The generators of an environment are the attributes of each wrapper, of the environment itself,
    and of their classes, modules and spaces. If training and evaluation share one environment or
    one generator, the generators of training are restored, too.
    """
    restore = [*_restorers(env)]
    shared = global_state()
    torch = _torch()
    on_cuda = torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized()
    cuda = torch.cuda.get_rng_state() if on_cuda else None
    try:
        yield
    finally:
        for restore_one in restore:
            restore_one()
        set_global_state(shared)
        if on_cuda:
            torch.cuda.set_rng_state(cuda)


def held_by(owner: Any) -> Iterator[Any]:
    """Yield the attributes of an object, items of lists and dicts, and their attributes."""
    for value in _parts(_attributes(owner)):
        yield value
        if not isinstance(value, type | ModuleType | gymnasium.Env):
            yield from _parts(_attributes(value))


def _attributes(owner: Any) -> Iterable[Any]:
    """Return the values of an object's attributes."""
    found = getattr(owner, "__dict__", None)  # dm_control's empty binding answers with an array
    return found.values() if isinstance(found, Mapping) else ()


def _parts(values: Iterable[Any]) -> Iterator[Any]:
    """Yield the values, and the items of lists, tuples and dicts among them."""
    for value in list(values):
        yield value
        if isinstance(value, list | tuple):
            yield from value
        elif isinstance(value, dict):
            yield from list(value.values())


def _restorers(env: gymnasium.Env[Any, Any]) -> Iterator[Callable[[], object]]:
    """Yield a function for each generator of the environment that restores it."""
    for owner in _owners(env):
        if isinstance(owner, gymnasium.Env):
            yield from filter(None, map(_restorer, held_by(owner)))
        for name, value in list(getattr(owner, "__dict__", {}).items()):
            restore = _restorer(value)
            if restore is not None:
                yield restore
            if restore is not None or name == "_np_random":  # None for a space before its first use
                yield _reassign(owner, name, value)


def _owners(env: gymnasium.Env[Any, Any]) -> Iterator[Any]:
    """Yield the objects whose attributes may be generators of an environment."""
    layer: Any = env
    while layer is not None:
        yield layer
        yield from type(layer).__mro__
        yield sys.modules.get(type(layer).__module__)
        for value in getattr(layer, "__dict__", {}).values():
            yield from _with_parts(value)
        layer = layer.env if isinstance(layer, gymnasium.Wrapper) else None


def _with_parts(value: Any) -> Iterator[Any]:
    """Yield a space and the spaces in it; nothing for any other object."""
    if isinstance(value, spaces.Space):
        yield value
        for part in value.spaces.values() if isinstance(value, spaces.Dict) else ():
            yield from _with_parts(part)


def _restorer(value: Any) -> Callable[[], object] | None:
    """Return a function that restores the present state of a generator.

    Return None for other objects.
    """
    if isinstance(value, np.random.Generator):
        bits, state = value.bit_generator, value.bit_generator.state
        return lambda: setattr(bits, "state", state)
    if isinstance(value, np.random.RandomState):
        legacy = value.get_state(legacy=False)
        return lambda: value.set_state(legacy)
    if isinstance(value, random.Random) and not isinstance(value, random.SystemRandom):
        words = value.getstate()
        return lambda: value.setstate(words)
    if (torch := _torch()) is not None and isinstance(value, torch.Generator):
        tensor = value.get_state()
        return lambda: value.set_state(tensor)
    return None


def _reassign(owner: Any, name: str, value: Any) -> Callable[[], None]:
    """Return a function that assigns a generator again, since `reset` may have replaced it."""

    def reassign() -> None:
        if owner.__dict__.get(name) is not value:
            setattr(owner, name, value)

    return reassign
