"""Loggers: callbacks that write the metrics of a run to files or services.

Every run has a `CSV`. `--log tensorboard wandb trackio` adds the others, and
`merl.train(..., callbacks=[merl.loggers.WandB(entity="my-lab")])` adds one with options of its own.
A logger that fails during training gives one warning, and the run continues.
"""

from __future__ import annotations

import io
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from merl.callbacks import Callback
from merl.core import MerlError, check_choice
from merl.core.files import append_whole
from merl.core.user_code import reason
from merl.evaluation.evaluation import Evaluation
from merl.runs.metrics import MetricsFile
from merl.runs.plain import to_plain

if TYPE_CHECKING:
    from merl.runs.run import Run
    from merl.training.outcome import Outcome
    from merl.training.trainer import Trainer


class Logger(Callback):
    """Base class of loggers: override `open`, `log` and `close`.

    An exception in `open` ends a new run before its first step. Any other exception, also in `open`
    of a resumed run, gives a warning, once.
    """

    def open(self, trainer: Trainer) -> None:
        """Start to log a run, or continue with one that is resumed at `trainer.progress.step`."""

    def log(self, step: int, values: Mapping[str, float]) -> None:
        """Log values, which are named as in `metrics.csv`, e.g. `train/return`, `eval/return`."""

    def close(self, outcome: Outcome | None) -> None:
        """Finish the log; the outcome is None if an exception ended the run."""

    def on_start(self, trainer: Trainer) -> None:
        """See `Callback`."""
        self._trainer, self._warned = trainer, False
        try:
            self.open(trainer)
        except Exception as error:
            if trainer.progress.step == 0:
                raise MerlError(f"{type(self).__name__} cannot log: {reason(error)}") from error
            self._warn(error)

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """See `Callback`."""
        self._guarded(lambda: self.log(step, metrics))

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """See `Callback`."""
        self._guarded(lambda: self.log(step, self._trainer.evaluations.row))

    def on_end(self, outcome: Outcome | None) -> None:
        """See `Callback`."""
        if hasattr(self, "_trainer"):  # else another callback failed before `on_start`
            self._guarded(lambda: self.close(outcome))

    def _guarded(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self._warn(error)

    def _warn(self, error: Exception) -> None:
        if not self._warned:
            self._warned = True
            self._trainer.warn(
                f"{type(self).__name__} does not log everything: {reason(error)}; training "
                "continues, and metrics.csv has all metrics"
            )


class CSV(Callback):
    """The authoritative log of every run, `metrics.csv`; rows after a resumed step are dropped.

    Attributes:
        file: the file; None before the start.
    """

    file: MetricsFile | None = None

    def on_start(self, trainer: Trainer) -> None:
        """See `Callback`."""
        self._trainer = trainer
        self.file = MetricsFile(trainer.run.path, trainer.warn)
        self.file.trim(trainer.progress.step)

    def on_episode(self, step: int, metrics: Mapping[str, float]) -> None:
        """See `Callback`."""
        if self.file is not None:
            self.file.write(step, metrics)

    def on_evaluation(self, step: int, evaluation: Evaluation) -> None:
        """See `Callback`."""
        self.on_episode(step, self._trainer.evaluations.row)

    def on_end(self, outcome: Outcome | None) -> None:
        """See `Callback`."""
        if self.file is not None:
            self.file.close()


class TensorBoard(Logger):
    """Events for TensorBoard, in the folder `tensorboard` of the run.

    TensorBoard's own writers write from a background thread, which dies on a full disk and prints a
    traceback across the live view, and import an installed TensorFlow. This class writes complete
    records of TensorBoard's format, without a buffer.

    Raises:
        MerlError: the extra `tensorboard` is not installed.
    """

    _file: io.FileIO | None = None

    def __init__(self) -> None:
        self._proto = _imported("tensorboard.compat.proto.event_pb2", "tensorboard")
        self._writer = _imported("tensorboard.summary.writer.record_writer", "tensorboard")

    def open(self, trainer: Trainer) -> None:
        """Write a new file; TensorBoard drops the events of earlier files after this step."""
        folder = trainer.run.path / "tensorboard"
        folder.mkdir(exist_ok=True)
        # TensorBoard reads the files in the order of their names, so the time comes first.
        stamp = f"{time.time_ns() / 1e9:020.9f}.{socket.gethostname()}.{os.getpid()}"
        self._file = io.FileIO(folder / f"events.out.tfevents.{stamp}", "w")
        self._append(file_version="brain.Event:2")
        start = self._proto.SessionLog(status=self._proto.SessionLog.START)
        self._append(step=trainer.progress.step + 1, session_log=start)

    def log(self, step: int, values: Mapping[str, float]) -> None:
        """See `Logger`."""
        tagged = [{"tag": name, "simple_value": value} for name, value in values.items()]
        self._append(step=step, summary={"value": tagged})

    def close(self, outcome: Outcome | None) -> None:
        """See `Logger`."""
        if self._file is not None:
            self._file.close()

    def _append(self, **fields: Any) -> None:
        if self._file is None:
            self.open(self._trainer)  # it failed when the run was resumed
        assert self._file is not None
        event = self._proto.Event(wall_time=time.time(), **fields)
        record = io.BytesIO()
        self._writer.RecordWriter(record).write(event.SerializeToString())
        append_whole(self._file, record.getvalue())


class WandB(Logger):
    """A run of Weights & Biases; a resumed run continues it.

    W&B writes to `wandb/` in the working folder or in `WANDB_DIR`, and with `WANDB_MODE=offline`
    only there, for `wandb sync`. (It makes links, with which a run's folder could not be trusted.)

    Args:
        project: the project that the run belongs to.
        options: further arguments of `wandb.init`.

    Raises:
        MerlError: the extra `wandb` is not installed.
    """

    _extra = "wandb"
    _run: Any = None

    def __init__(self, project: str = "merl", **options: Any) -> None:
        self._library = _imported(self._extra, self._extra)
        self._options = {"project": project} | options

    def open(self, trainer: Trainer) -> None:
        """See `Logger`."""
        options = {"config": to_plain(trainer.config), "resume": "allow"}
        self._run = self._library.init(**options | self._named(trainer.run) | self._options)

    def log(self, step: int, values: Mapping[str, float]) -> None:
        """Log values; W&B refuses those of a step before the last one, as after a kill."""
        if self._run is None:
            self.open(self._trainer)  # it failed when the run was resumed
        if step >= getattr(self._run, "step", 0):
            self._run.log(dict(values), step=step)

    def close(self, outcome: Outcome | None) -> None:
        """See `Logger`."""
        if self._run is not None:
            self._run.finish()

    def _named(self, run: Run) -> dict[str, Any]:
        """Return the arguments by which the library finds the run again."""
        settings = self._library.Settings(console="off", silent=True, reinit="create_new")
        return {"name": run.path.name, "id": run.public_id, "settings": settings}


class Trackio(WandB):
    """A run in trackio's local database or in a Space; a resumed run continues it.

    Args:
        project: the project that the run belongs to; `trackio show --project merl` shows it.
        options: further arguments of `trackio.init`, e.g. `space_id`.

    Raises:
        MerlError: the extra `trackio` is not installed.
    """

    _extra = "trackio"

    def _named(self, run: Run) -> dict[str, Any]:
        return {"name": f"{run.path.name}-{run.public_id[:8]}"}  # the name is the only id


LOGGERS: dict[str, type[Logger]] = {
    "tensorboard": TensorBoard,
    "wandb": WandB,
    "trackio": Trackio,
}
"""The loggers of `--log`, by name."""


def make_loggers(names: Iterable[str]) -> list[Logger]:
    """Make the loggers of `TrainConfig.log`.

    Raises:
        MerlError: a name is unknown, or an extra is not installed.
    """
    for name in names:
        check_choice("--log", name, tuple(LOGGERS))
    return [LOGGERS[name]() for name in dict.fromkeys(names)]


def _imported(module: str, extra: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise MerlError(
            f"logger {extra} cannot be used ({error}): install it with "
            f"`pip install 'merl-rl[{extra}]'`"
        ) from None
