"""Where the agent acts: an environment in this process, or several in processes of their own.

Both are spoken to in the same way: `send` actions, `receive` what they led to. In between,
environments in processes of their own step while the learner learns.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Timer
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import AsyncState
from numpy.typing import NDArray

from merl.acting.generators import seed_global_generators
from merl.acting.run_env import (
    EnvSpaces,
    environment_state,
    make_run_env,
    set_environment_state,
)
from merl.config import TrainConfig
from merl.core import EnvironmentFailed, EnvironmentsLost, MerlError, Observation
from merl.core.output import tolerate_lost_output
from merl.core.python_path import set_value, users_value, working_folder_hidden
from merl.envs.user_env import imports_code, load_module, module_folder

_INFO = ("success", "reward_terms")
"""What the loop wants to know beside the reward."""
_TOLD = "told"
"""The only key of a worker's info; under it lies what its environment told of `_INFO`."""
_LEFT_TO_THE_RUN = (signal.SIGINT, signal.SIGUSR1, signal.SIGHUP)
"""A terminal or a batch system sends them to the workers too, which are to work on until the run
has saved and ends them. SIGTERM is what they are ended by."""
START_SECONDS = 300.0
"""In which all processes must have made their environments."""
END_SECONDS = 5.0
"""In which they must have ended, before they are killed."""


class Step(NamedTuple):
    """What an action led to; see `gymnasium.Env.step`."""

    observation: Observation
    reward: float
    terminated: bool
    truncated: bool
    info: Mapping[str, Any]


class WorkerDied(Exception):  # noqa: N818 (no error as long as it can be mended)
    """A process of an environment died or does not answer: the episodes in progress are lost."""


class Environments(Protocol):
    """One environment or several, that are stepped together.

    Attributes:
        count: how many there are.
        action_shape: of one action, (A,).
    """

    count: int
    action_shape: tuple[int, ...]

    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """Start an episode in each environment named, with its seed if it has one.

        A seed also seeds the global generators of the process that the environment lives in.

        Raises:
            Lost: a process died.
        """
        ...

    def send(self, actions: NDArray[np.float32]) -> None:
        """Have every environment take its action, (count, A) in [-1, 1].

        Raises:
            Lost: a process died.
        """
        ...

    def receive(self) -> list[Step]:
        """What the actions led to, once they all have.

        Raises:
            Lost: a process died, or is late.
        """
        ...

    def states(self) -> list[dict[str, Any]]:
        """Return `environment_state()` of each one."""
        ...

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        """Take back what `states` gave."""
        ...

    def restart(self) -> None:
        """Make them anew, after one was lost.

        Raises:
            Lost: they cannot be started.
        """
        ...

    def close(self) -> None:
        """End them."""
        ...


class InProcessEnvs:
    """One environment in this process: nothing happens between `send` and `receive`.

    Args:
        env: the environment; who made it closes it.
    """

    count = 1

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self.action_shape = env.action_space.shape or ()
        self._action: NDArray[np.float32] | None = None

    def reset(self, seeds: Mapping[int, int | None]) -> dict[int, Observation]:
        """See `Environments`."""
        observations = {}
        for index, seed in seeds.items():
            if seed is not None:
                seed_global_generators(seed)
            observations[index] = self._env.reset(seed=seed)[0]
        return observations

    def send(self, actions: NDArray[np.float32]) -> None:
        """See `Environments`."""
        self._action = actions[0]

    def receive(self) -> list[Step]:
        """See `Environments`."""
        observation, reward, terminated, truncated, info = self._env.step(self._action)
        return [Step(observation, float(reward), terminated, truncated, info)]

    def states(self) -> list[dict[str, Any]]:
        """See `Environments`."""
        return [environment_state(self._env)]

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        """See `Environments`."""
        set_environment_state(self._env, states[0])

    def restart(self) -> None:
        """See `Environments`; it is never lost."""

    def close(self) -> None:
        """See `Environments`."""


class WorkerEnvs:
    """Environments in processes of their own, which step at the same time.

    They are spawned (a fork with OpenGL or with threads hangs), give their observations through
    shared memory, and end with this process. When one of them dies, or does not answer in time, all
    are started again by `restart`.

    Args:
        config: of the run; `num_envs`, and `worker_timeout` in seconds.
        here: the same environment in this process, which lends its spaces and stays as it is.

    Raises:
        EnvironmentsLost: they cannot be started.
    """

    def __init__(self, config: TrainConfig, here: gymnasium.Env[Any, Any]) -> None:
        self.count, self.action_shape = config.num_envs, here.action_space.shape or ()
        self._config, self._here, self._timeout = config, here, config.worker_timeout
        self._lost: str | None = None  # what became of a process
        try:
            self._env = self._started()
        except WorkerDied as lost:
            raise EnvironmentsLost(
                f"an environment's process {lost} while it was started: see what it said above"
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
                infos[_TOLD][index][0],
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

    @contextmanager
    def _loss(self) -> Iterator[None]:
        """Raise `WorkerDied` for a process that has died; ask nothing more until a restart."""
        if self._lost is not None:
            raise WorkerDied(self._lost)
        try:
            yield
        except multiprocessing.TimeoutError:
            self._lost = "did not answer in time"
        except (EOFError, ConnectionError):
            self._lost = "died"
        except MerlError:
            self._lost = "failed"  # its pipe is closed: nothing more can be asked of it
            raise
        if self._lost is not None:
            raise WorkerDied(self._lost)

    def _call(self, name: str, *args: Any) -> tuple[Any, ...]:
        with self._loss():
            self._env.call_async(name, *args)
            return self._env.call_wait(self._timeout)

    def _started(self) -> AsyncVectorEnv:
        self._lost = None
        expected = EnvSpaces.of(self._config, self._here)
        folder = module_folder(self._config.task)
        makers = [
            _Maker(self._config, index, expected, self._here, folder) for index in range(self.count)
        ]
        others = multiprocessing.active_children()
        with (
            self._loss(),
            _killing_after(
                START_SECONDS, lambda: set(multiprocessing.active_children()) - {*others}
            ),
            working_folder_hidden(),
        ):
            # What a worker raises is raised here; Gymnasium would print it, too.
            gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
            return AsyncVectorEnv(makers, context="spawn", autoreset_mode=AutoresetMode.DISABLED)


@contextmanager
def _killing_after(
    seconds: float, processes: Callable[[], Iterable[BaseProcess]]
) -> Iterator[None]:
    """Kill processes if the work takes longer: whoever waits for them goes on."""
    impatience = Timer(seconds, lambda: _kill(processes()))
    impatience.daemon = True
    impatience.start()
    try:
        yield
    finally:
        impatience.cancel()


def _kill(processes: Iterable[BaseProcess]) -> None:
    for process in processes:
        process.kill()


def _end(env: AsyncVectorEnv) -> None:
    """End the processes, whatever state they are in."""
    with _killing_after(END_SECONDS, lambda: env.processes):
        try:
            env.close()
        except Exception:  # a pipe or a process is gone: no way to end in good order
            _kill(env.processes)
            env._state = AsyncState.DEFAULT  # nothing will answer what it waits for
            with suppress(Exception):
                env.close(terminate=True)


def _nth(batch: Mapping[str, Any], index: int) -> dict[str, Any]:
    """One environment's part of a batched observation."""
    return {key: value[index] for key, value in batch.items()}


@contextmanager
def _errors_that_arrive() -> Iterator[None]:
    """Replace an exception that cannot be pickled: the other process would wait for it forever."""
    try:
        yield
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise


class _Worker(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment in a process of its own, with what the loop asks of it beside stepping."""

    def __init__(self, env: gymnasium.Env[Any, Any], index: int) -> None:
        super().__init__(env)
        self._index = index

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        if options.get("seed") is not None:
            seed_global_generators(options["seed"])
        with _errors_that_arrive():
            observation, _ = self.env.reset(**options)
        return observation, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with _errors_that_arrive():
            observation, reward, terminated, truncated, info = self.env.step(action)
        told = {name: info[name] for name in _INFO if name in info}
        # In a tuple, lest Gymnasium merge it with what the other environments tell.
        return observation, reward, terminated, truncated, {_TOLD: (told,)}

    def state(self) -> dict[str, Any]:
        with _errors_that_arrive():
            return environment_state(self.env)

    def restore(self, states: Sequence[Mapping[str, Any] | None]) -> None:
        with _errors_that_arrive():
            set_environment_state(self.env, states[self._index])


class _StandIn(gymnasium.Env[Any, Any]):
    """Has the spaces of an environment, and nothing else.

    Args:
        expected: its spaces.
        error: why the environment cannot be used; `reset` raises it, since an exception while a
            worker starts does not reach the run.
    """

    def __init__(self, expected: EnvSpaces, error: MerlError | None = None) -> None:
        self.observation_space, self.action_space = expected.observation, expected.action
        self._error = error

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        if self._error is not None:
            raise self._error
        raise NotImplementedError


@dataclass
class _Maker:
    """Makes an environment in the process that it is sent to."""

    config: TrainConfig
    index: int
    expected: EnvSpaces
    here: gymnasium.Env[Any, Any] | None
    folder: Path | None
    """From which the module of a user's environment was loaded."""
    safe_path: str | None = field(default_factory=users_value)
    """What the user set; the environment may start Python processes of its own."""

    def __call__(self) -> gymnasium.Env[Any, Any]:
        if self.here is not None:
            return _StandIn(self.expected)
        for number in _LEFT_TO_THE_RUN:
            signal.signal(number, signal.SIG_IGN)
        if imports_code(self.config.task):
            set_value(self.safe_path)
        tolerate_lost_output()
        with _errors_that_arrive():
            if self.folder is not None:
                load_module(self.config.task, self.folder)
            env = make_run_env(self.config)
        try:
            self.expected.check(EnvSpaces.of(self.config, env), f"that of worker {self.index}")
        except MerlError as error:
            env.close()
            env = _StandIn(self.expected, EnvironmentFailed(str(error)))
        return _Worker(env, self.index)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "here": None}
