"""The outcome of a run."""

from __future__ import annotations

from dataclasses import dataclass

from merl.core import MerlError, NotSaved, counted
from merl.evaluation.evaluation import Evaluation
from merl.runs.checkpoint import Checkpoint
from merl.runs.run import Run
from merl.runs.run_folder import resume_line
from merl.training.loop import Progress


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        run: folder and config of the run.
        progress: counts of steps, updates and episodes.
        evaluation: the last evaluation; None if there was none.
        signal: number of the signal that stopped the run; None if no signal stopped it.
        saved: whether a checkpoint of the final state is on the disk.
        unwritten: rows of metrics that could not be written.
    """

    run: Run
    progress: Progress
    evaluation: Evaluation | None
    signal: int | None
    saved: bool
    unwritten: int = 0

    def was_stopped(self) -> bool:
        """Return whether a signal stopped the run."""
        return self.signal is not None

    def check_saved(self) -> None:
        """Check that the end of the run is saved.

        Raises:
            NotSaved: its last checkpoint or rows of its metrics are not on the disk.
        """
        lost = [] if self.saved else ["its checkpoint"]
        lost += [f"{counted(self.unwritten, 'row')} of its metrics"] if self.unwritten else []
        if not lost:
            return
        try:
            last = f"step {Checkpoint.find(self.run.checkpoints).step:,}"
        except MerlError:
            last = "its last checkpoint, or its start"
        raise NotSaved(
            f"{self.run.path} ended at step {self.progress.step:,}, but {' and '.join(lost)} could "
            f"not be written: once the disk can be written, `{resume_line(self.run.path)}` "
            f"continues from {last}"
        )
