"""Torch settings that merl's networks need, independent of the surrounding program."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any, TypeVar, cast

import torch

Method = TypeVar("Method", bound=Callable[..., Any])


@contextmanager
def torch_settings(device: torch.device, threads: int | None = None) -> Iterator[None]:
    """Run torch with the settings that merl needs, and restore the caller's afterwards.

    An environment or a program that uses merl may change torch's global settings at any time. Here
    new tensors are float32 and on the device that the code names, gradients are recorded, autocast
    is off, and nondeterministic operations are allowed. If nothing has to change, this takes 5 us.

    Args:
        device: device of the networks.
        threads: CPU threads of an operation; None keeps torch's setting.
    """
    with ExitStack() as stack:
        dtype, before = torch.get_default_dtype(), torch.get_num_threads()
        if dtype is not torch.float32:
            stack.callback(torch.set_default_dtype, dtype)
            torch.set_default_dtype(torch.float32)
        if threads is not None and before != threads:
            stack.callback(torch.set_num_threads, before)
            torch.set_num_threads(threads)
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        if not torch.is_grad_enabled() or torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))  # this enables gradients, too
        if device.type != "meta" and torch.is_autocast_enabled(device.type):
            stack.enter_context(torch.autocast(device.type, enabled=False))
        if torch.are_deterministic_algorithms_enabled():
            warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
            stack.callback(torch.use_deterministic_algorithms, True, warn_only=warn_only)
            torch.use_deterministic_algorithms(False)
        yield


def with_torch_settings(method: Method) -> Method:
    """Decorate a method to run under `torch_settings(self.device, self.threads)`."""

    @wraps(method)
    def wrapped(self: Any, *args: Any, **kwargs: Any) -> Any:
        with torch_settings(self.device, self.threads):
            return method(self, *args, **kwargs)

    return cast(Method, wrapped)
