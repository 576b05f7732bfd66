"""Write the checkpoints of a run, and restore the run from a checkpoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from merl.acting.environments import Environments, WorkerDied
from merl.callbacks import Callback
from merl.core import EnvironmentsLost
from merl.core.files import cause
from merl.core.guards import LossGuard
from merl.replay import ReplayBuffer
from merl.runs import checkpoint
from merl.runs.checkpoint import Checkpoint
from merl.runs.checkpoint_folders import discard_later
from merl.runs.run import Run
from merl.training.evaluator import Evaluations
from merl.training.loop import Progress
from merl.training.meters import Clock, Interval
from merl.training.setup import Setup


class Saver:
    """Writer of a run's checkpoints, from which it also restores the run.

    Args:
        setup: agent, progress and random streams.
        run: the run's folder.
        replay: replay buffer, saved next to the checkpoints.
        environments: the states of their random generators are saved.
        evaluations: the last evaluation provides the score of a checkpoint.
        clock: training time of the run so far.
        guard: rejects losses that are not finite.
        callbacks: notified of checkpoints and warnings.
    """

    def __init__(
        self,
        setup: Setup,
        run: Run,
        replay: ReplayBuffer,
        environments: Environments,
        evaluations: Evaluations,
        clock: Clock,
        guard: LossGuard,
        callbacks: Callback,
    ) -> None:
        self._setup, self._run, self._replay = setup, run, replay
        self._environments, self._evaluations = environments, evaluations
        self._clock, self._guard, self._callbacks = clock, guard, callbacks
        self._saved: dict[str, Any] | None = None  # the progress at the last save
        self._start: Checkpoint | None = None  # from which the run was resumed
        self._states: Sequence[Mapping[str, Any] | None] = [None] * environments.count
        self.interval = Interval(setup.config.save_every)

    def save(self, *, within_episode: bool = False) -> bool:
        """Write a checkpoint, unless the last one already has the current state.

        If it cannot be written, warn and continue.

        Args:
            within_episode: whether an episode is still in progress, because it takes long.

        Returns:
            Whether a checkpoint of the current state is on the disk.

        Raises:
            MerlError: the run's folder is gone, or a weight or loss is not finite.
        """
        self._guard.check()
        self._run.check_there()
        setup, progress = self._setup, self._setup.progress
        if self._saved == dataclasses.asdict(progress):
            return True
        try:
            self._replay.flush()  # if it writes the files again, the checksums change
            state = {
                "progress": dataclasses.asdict(progress),
                "randomness": setup.randomness.state_dict(),
                "replay": self._replay.state_dict() | self._replay.checksums(),
                "environment": self._environment_states(),
                "seconds": self._clock.seconds(),
                "cpu_seconds": self._clock.cpu_seconds(),
            }
            checkpoint.save(
                self._run.checkpoints,
                progress.step,
                setup.agent,
                state,
                score=self._score(),
                keep=setup.config.keep,
            )
        except OSError as error:
            self._run.check_there()
            self._callbacks.on_warning(
                f"the checkpoint at step {progress.step} was not written: {cause(error)}"
            )
            return False
        finally:
            self.interval.saved(within_episode)
        self._saved = dataclasses.asdict(progress)
        self._replay.confirm_checkpoint()
        self._callbacks.on_checkpoint(progress.step)
        return True

    def restore(self, start: Checkpoint, *, skip_damaged: bool = False) -> None:
        """Restore agent, progress, replay, random streams and environments from a checkpoint.

        Args:
            start: the checkpoint.
            skip_damaged: leave out the episodes of damaged parts of the replay.

        Raises:
            MerlError: the checkpoint cannot be used, or a part of the replay is damaged.
            EnvironmentsLost: an environment's process died.
        """
        setup, state = self._setup, start.state()
        checkpoint.load_agent(setup.agent, start)
        try:
            with checkpoint.readable(start):
                counts = state["progress"]
                if not all(isinstance(count, int) and count >= 0 for count in counts.values()):
                    raise TypeError(f"progress is {counts}")
                setup.progress = Progress(**counts)
                setup.randomness.load_state_dict(state["randomness"])
                self._replay.load_state_dict(state["replay"], skip_damaged=skip_damaged)
                self._states = state["environment"]
                self._environments.restore(self._states)
                self._clock.restore(float(state["seconds"]), float(state["cpu_seconds"]))
            self._start = start
            discard_later(self._run.checkpoints, start.step)
        except WorkerDied as died:
            raise EnvironmentsLost(
                f"an environment's process {died} right after its start: see its output above"
            ) from None

    def resumes_exactly(self) -> bool:
        """Return whether the environments' random generators are part of the checkpoint.

        Actors keep their own, and their runs need not resume exactly.
        """
        if self._setup.config.has_actors:
            return True
        return all(state and "bit_generator" in state for state in self._environment_states())

    def _score(self) -> float | None:
        """Return the mean return of the evaluation at this step; None if there was none."""
        progress, last, start = self._setup.progress, self._evaluations.last, self._start
        if last is not None and progress.evaluated == progress.step:
            return last.returns.mean
        return start.score if start is not None and start.step == progress.step else None

    def _environment_states(self) -> Sequence[Mapping[str, Any] | None]:
        """Return the states of the environments; after a worker died, the last known states."""
        with suppress(WorkerDied):
            self._states = self._environments.states()
        return self._states
