"""Environments in worker processes, which step while the learner updates."""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Timer
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState
from gymnasium.vector.utils import CloudpickleWrapper
from numpy.typing import NDArray

from merl.acting.environments import Environments, Step, WorkerDied
from merl.acting.generators import (
    environment_state,
    seed_global_generators,
    set_environment_state,
)
from merl.acting.instances import EnvRecipe, EnvSpaces, with_keys
from merl.acting.processes import Processes, belong_to
from merl.acting.still import StillEnv
from merl.core import EnvironmentFailed, EnvironmentsLost, MerlError, Observation
from merl.core.files import cause
from merl.core.output import tolerate_lost_output
from merl.core.python_path import set_value, users_value, working_folder_hidden
from merl.core.user_code import in_one_line, module_folder
from merl.envs.user_env import imports_code, load_module

_INFO = ("success", "reward_terms")
"""Keys of an environment's info that the training loop uses."""
_INFO_KEY = "reported"
"""The only key of a worker's info; its value holds the `_INFO` entries of the environment."""
START_SECONDS = 300.0
"""Time limit within which all processes must have made their environments."""
END_SECONDS = 5.0
"""Time limit within which the processes must have ended; after that they are killed."""


class WorkerEnvs(Environments):
    """Environments in worker processes that step in parallel.

    The processes are spawned (a fork with OpenGL or threads hangs), return observations through
    shared memory, and end with this process. If one dies or does not answer in time, `restart`
    starts all of them again.

    Args:
        recipe: how to make them; see `check_sendable`.
        here: the same environment in this process, with the keys that the agent uses; only its
            spaces are used.
        count: number of environments.
        timeout: time limit of a step and of a reset, seconds.

    Raises:
        EnvironmentsLost: the processes cannot be started.
    """

    def __init__(
        self, recipe: EnvRecipe, here: gymnasium.Env[Any, Any], count: int, timeout: float
    ) -> None:
        self.count, self.action_shape = count, here.action_space.shape or ()
        self._recipe, self._here, self._timeout = recipe, here, timeout
        self._lost: str | None = None  # why a process is lost
        self._level = gymnasium.logger.min_level  # of the caller
        try:
            self._env = self._started()
        except BaseException as error:
            gymnasium.logger.min_level = self._level
            if not isinstance(error, WorkerDied):
                raise
            raise EnvironmentsLost(
                f"an environment's process {error} while it started: see its output above"
            ) from None

    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """See `Environments`."""
        which = np.array([index in seeds for index in range(self.count)])
        with self._loss():
            self._env.reset_async(
                [seeds.get(index) for index in range(self.count)], {"reset_mask": which}
            )
            observations, _ = self._env.reset_wait(self._timeout)
        return {index: _nth(observations, index) for index in seeds}

    def send(self, actions: NDArray[np.float32]) -> None:
        """See `Environments`."""
        with self._loss():
            self._env.step_async(actions)

    def receive(self) -> list[Step]:
        """See `Environments`."""
        with self._loss():
            observations, rewards, terminated, truncated, infos = self._env.step_wait(self._timeout)
        return [
            Step(
                _nth(observations, index),
                float(rewards[index]),
                bool(terminated[index]),
                bool(truncated[index]),
                infos[_INFO_KEY][index][0],
            )
            for index in range(self.count)
        ]

    def states(self) -> list[dict[str, Any]]:
        """See `Environments`."""
        return [*self._call("state")]

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        """See `Environments`."""
        self._call("restore", list(states))

    def restart(self) -> None:
        """See `Environments`."""
        self.close()
        self._env = self._started()

    def close(self) -> None:
        """See `Environments`."""
        _end(self._env)
        gymnasium.logger.min_level = self._level

    @contextmanager
    def _loss(self) -> Iterator[None]:
        """Convert a lost process into `WorkerDied`, in all later calls too, until a restart."""
        if self._lost is not None:
            raise WorkerDied(self._lost)
        try:
            yield
        except multiprocessing.TimeoutError:
            self._lost = "did not answer in time"
        except (EOFError, ConnectionError):
            self._lost = "died"
        except MerlError:
            self._lost = "failed"  # its pipe is closed, so it cannot be used again
            raise
        if self._lost is not None:
            raise WorkerDied(self._lost)

    def _call(self, name: str, *args: Any) -> tuple[Any, ...]:
        with self._loss():
            self._env.call_async(name, *args)
            return self._env.call_wait(self._timeout)

    def _started(self) -> AsyncVectorEnv:
        self._lost = None
        expected, folder = EnvSpaces.of(self._here), module_folder(self._recipe.task)
        makers = [
            _Maker(self._recipe, index, expected, self._here, folder) for index in range(self.count)
        ]
        others = multiprocessing.active_children()
        with (
            self._loss(),
            _killing_after(
                START_SECONDS, lambda: set(multiprocessing.active_children()) - {*others}
            ),
            working_folder_hidden(),
        ):
            # The exception of a worker is raised here; Gymnasium must not print it as well.
            gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
            with _shared_memory(self.count):
                return Processes(makers, context="spawn", autoreset_mode=AutoresetMode.DISABLED)


def check_sendable(recipe: EnvRecipe, count: int) -> None:
    """Check that `count` worker processes can receive the function that makes their environments.

    Raises:
        MerlError: the function refers to something that exists in this process alone.
    """
    try:
        pickle.dumps(CloudpickleWrapper(lambda: recipe.make))  # as AsyncVectorEnv sends it
    except Exception as error:
        raise MerlError(
            f"{recipe.task} cannot be sent to the worker processes of num-envs {count} "
            f"({in_one_line(error)}): let the function make all that it uses, or use num-envs 1 "
            "and synchronous"
        ) from None


@contextmanager
def _shared_memory(count: int) -> Iterator[None]:
    """Explain an error of the system while processes with shared memory are started."""
    try:
        yield
    except ConnectionError:  # a process died
        raise
    except OSError as error:
        raise MerlError(
            f"the worker processes of num-envs {count} cannot be started: {cause(error)}: they "
            "need shared memory (/dev/shm) and open files; or use num-envs 1 and synchronous"
        ) from error


@contextmanager
def _killing_after(
    seconds: float, processes: Callable[[], Iterable[BaseProcess]]
) -> Iterator[None]:
    """Kill processes if the block takes longer, so that waiting for them ends."""
    timer = Timer(seconds, lambda: _kill(processes()))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _kill(processes: Iterable[BaseProcess]) -> None:
    for process in processes:
        process.kill()


def _end(env: AsyncVectorEnv) -> None:
    """End the worker processes in any state."""
    with _killing_after(END_SECONDS, lambda: env.processes):
        try:
            env.close()
        except Exception:  # a pipe or a process is lost: a regular close is impossible
            _kill(env.processes)
            env._state = AsyncState.DEFAULT  # do not wait for an answer
            with suppress(Exception):
                env.close(terminate=True)


def _nth(batch: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return the observation of one environment from a batched observation."""
    return {key: value[index] for key, value in batch.items()}


@contextmanager
def _picklable_errors() -> Iterator[None]:
    """Replace an exception that cannot be pickled; else the main process would wait forever."""
    try:
        yield
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise


class _Worker(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment in a worker process, with methods to save and restore its state."""

    def __init__(self, env: gymnasium.Env[Any, Any], index: int) -> None:
        super().__init__(env)
        self._index = index

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        if options.get("seed") is not None:
            seed_global_generators(options["seed"])
        with _picklable_errors():
            observation, _ = self.env.reset(**options)
        return observation, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with _picklable_errors():
            observation, reward, terminated, truncated, info = self.env.step(action)
        reported = {name: info[name] for name in _INFO if name in info}
        # In a tuple, so that Gymnasium does not merge it with the info of other environments.
        return observation, reward, terminated, truncated, {_INFO_KEY: (reported,)}

    def state(self) -> dict[str, Any]:
        with _picklable_errors():
            return environment_state(self.env)

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        with _picklable_errors():
            set_environment_state(self.env, states[self._index])


@dataclass
class _Maker:
    """A function that makes an environment in a worker process."""

    recipe: EnvRecipe
    index: int
    expected: EnvSpaces
    here: gymnasium.Env[Any, Any] | None
    folder: Path | None
    """The folder from which the module of a user's environment was loaded."""
    parent: int = field(default_factory=os.getpid)
    safe_path: str | None = field(default_factory=users_value)
    """The user's value of `PYTHONSAFEPATH`, for Python processes that the environment starts."""

    def __call__(self) -> gymnasium.Env[Any, Any]:
        if self.here is not None:
            return StillEnv(self.expected)
        belong_to(self.parent)
        if imports_code(self.recipe.task):
            set_value(self.safe_path)
        tolerate_lost_output()
        with _picklable_errors():
            if self.folder is not None:
                load_module(self.recipe.task, self.folder)
            env = with_keys(self.recipe.instance(), self.expected.observation.keys())
        try:
            self.expected.check(EnvSpaces.of(env), f"that of worker {self.index}")
        except MerlError as error:
            env.close()
            # An exception during the start of a worker would not reach the run.
            env = StillEnv(self.expected, EnvironmentFailed(str(error)))
        return _Worker(env, self.index)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "here": None}
