"""Metrics of a run, written during training: `metrics.csv` and TensorBoard events.

`metrics.csv` is authoritative: one row per environment step at which something was measured, first
the column `step`, then one column per metric; a cell is empty if the metric was not measured at
that step. TensorBoard shows the same metrics. A failed write never ends a run: the rows are kept in
memory and written as soon as that is possible.
"""

from __future__ import annotations

import csv
import errno
import io
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from merl.core import METRICS_FILE, MerlError

TENSORBOARD_FOLDER = "tensorboard"

_LOG = logging.getLogger(__name__)


class MetricsWriter(AbstractContextManager["MetricsWriter"]):
    """Writer of the metrics of a run; a context manager.

    All rows are also held in memory (a few MB for the longest run). If a new column appears, rows
    are dropped, or a write has failed, the whole file is written to a temporary name and renamed.
    Otherwise each row is one `write` of one line, so a killed process leaves at most an incomplete
    last line, which is removed when the file is opened again.

    Args:
        run_dir: the folder of the run; created if missing. An existing `metrics.csv` is continued.
        warn: receives one message, once, if metrics cannot be written (e.g. the disk is full).

    Raises:
        MerlError: `metrics.csv` exists but cannot be read, or is not a metrics file.
    """

    def __init__(
        self,
        run_dir: Path | str,
        warn: Callable[[str], None] = _LOG.warning,
    ) -> None:
        self._path = Path(run_dir) / METRICS_FILE
        self._warn = warn
        self._warned = False
        self._closed = False
        self._columns, self._rows = _read_rows(self._path)
        self._written = 0  # number of rows that the file holds
        self._tail = 0  # byte offset of the last row
        self._file: io.FileIO | None = None  # None: outdated, rewrite the whole file
        self._events: _EventFile | None = None
        # Only here: a folder that is deleted during the run is not created again.
        self._guard(lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
        self._guard(lambda: self._rewrite(None))
        self._guard(self._event_file)

    def __exit__(self, *_: object) -> None:
        """Close the writer, also after an exception."""
        self.close()

    @property
    def last_step(self) -> int | None:
        """Return the step of the last row; None if there is no row."""
        return int(self._rows[-1]["step"]) if self._rows else None

    @property
    def unwritten(self) -> int:
        """Return the number of rows in memory that could not be written to the file."""
        return len(self._rows) - self._written

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record the metrics of `step`.

        A second call with the same step adds to the row of that step, so that every step has one
        row; the later value of a metric replaces the earlier one. Without values, nothing is
        written.

        Args:
            step: environment steps so far; at least the step of the last row.
            values: name -> value; names like `train/return`, printable, and not `step`.

        Raises:
            ValueError: the step is before the last row (after a resume, call `trim` first), a
                name cannot be a column, or the writer is closed.
        """
        if self._closed:
            raise ValueError(f"the writer of {self._path} is closed")
        if not values:
            return
        last = self.last_step
        if last is not None and step < last:
            raise ValueError(f"step {step} is before the last step {last}: call trim({step}) first")
        numbers = {name: float(value) for name, value in values.items()}
        for name in numbers:
            if not name or name == "step" or not name.isprintable():
                raise ValueError(f"a metric cannot be named {name!r}")
        new = [name for name in numbers if name not in self._columns]

        file = self._take_file()
        begin = self._tail
        if file is not None and step != last:
            begin = file.seek(0, io.SEEK_END)
        self._written = min(self._written, len(self._rows) - (step == last))
        if step != last:
            self._rows.append({"step": str(int(step))})
        self._rows[-1].update({name: repr(value) for name, value in numbers.items()})
        self._columns += new
        if new or file is None:
            self._guard(lambda: self._rewrite(file))
        else:
            self._guard(lambda: self._put_last_row(file, begin))
        self._guard(lambda: self._event_file().scalars(step, numbers))

    def trim(self, step: int) -> None:
        """Drop every row after `step`: call it when a run resumes from a checkpoint of `step`.

        TensorBoard drops the same events.

        Args:
            step: the last step to keep.
        """
        kept = [row for row in self._rows if int(row["step"]) <= step]
        if len(kept) < len(self._rows):
            file = self._take_file()
            self._rows = kept
            self._written = min(self._written, len(kept))
            self._guard(lambda: self._rewrite(file))
            self._guard(lambda: self._event_file().forget_from(step + 1))

    def close(self) -> None:
        """Flush all metrics to disk and close the files; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._file is None:
            self._guard(lambda: self._rewrite(None))
        file = self._file
        if file is not None:
            self._guard(lambda: os.fsync(file.fileno()))
            self._guard(file.close)
        if self._events is not None:
            self._guard(self._events.close)

    def _guard(self, action: Callable[[], object]) -> None:
        """Run a file operation; if it fails, warn the user once and continue."""
        try:
            action()
        except OSError as error:
            if not self._warned:
                self._warned = True
                reason = error.strerror or str(error)
                self._warn(
                    f"metrics cannot be written to {self._path.parent} ({reason}); training "
                    "continues, and they are kept in memory until they can be written"
                )

    def _take_file(self) -> io.FileIO | None:
        """Return the open file and set `_file` to None before the rows in memory change.

        The next successful write sets `_file` again. If an interrupt prevents it, the file counts
        as outdated.
        """
        file, self._file = self._file, None
        return file

    def _put_last_row(self, file: io.FileIO, begin: int) -> None:
        """Write the last row at byte `begin` in one write, and truncate the file after it."""
        try:
            _write_whole(file, _csv_line(self._cells(self._rows[-1])), begin)
        except BaseException:
            file.close()
            raise
        self._file, self._tail = file, begin
        self._written = len(self._rows)

    def _rewrite(self, old: io.FileIO | None) -> None:
        """Write all rows to a temporary file, replace `metrics.csv` by it, and open it."""
        if old is not None:
            old.close()
        lines = [_csv_line(self._columns), *(_csv_line(self._cells(row)) for row in self._rows)]
        temporary = self._path.with_name(f".{self._path.name}.part")
        try:
            with temporary.open("wb") as file:
                file.writelines(lines)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self._path)
        except OSError:
            with suppress(OSError):  # a disk that is not writable may also refuse to delete
                temporary.unlink(missing_ok=True)
            raise
        self._file = io.FileIO(self._path, "r+")
        self._tail = sum(map(len, lines)) - len(lines[-1])
        self._written = len(self._rows)

    def _cells(self, row: Mapping[str, str]) -> Iterable[str]:
        return (row.get(name, "") for name in self._columns)

    def _event_file(self) -> _EventFile:
        if self._events is None:
            self._events = _EventFile(self._path.parent / TENSORBOARD_FOLDER)
        return self._events


class _EventFile:
    """One TensorBoard event file; each record is written completely and without a buffer.

    TensorBoard's own `EventFileWriter`, which torch's `SummaryWriter` uses, writes from a
    background thread. On a full disk that thread dies and prints a traceback across the live view.
    Therefore this class writes TensorBoard's record format directly. It also does not import an
    installed TensorFlow.
    """

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2  # type: ignore[import-untyped]
        from tensorboard.summary.writer.record_writer import (  # type: ignore[import-untyped]
            RecordWriter,
        )

        self._event_pb2: Any = event_pb2
        self._summary_pb2: Any = summary_pb2
        self._record_writer: Any = RecordWriter
        folder.mkdir(exist_ok=True)
        # TensorBoard reads the files in the order of their names, so the time comes first.
        stamp = f"{time.time_ns() / 1e9:020.9f}.{socket.gethostname()}.{os.getpid()}"
        self._file = io.FileIO(folder / f"events.out.tfevents.{stamp}", "w")
        try:
            self._append(file_version="brain.Event:2")
        except OSError:
            self._file.close()
            raise

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Write the values of one step."""
        Summary = self._summary_pb2.Summary  # noqa: N806 - a class
        tagged = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._append(step=step, summary=Summary(value=tagged))

    def forget_from(self, step: int) -> None:
        """Make TensorBoard drop the events of earlier files at `step` and later."""
        log = self._event_pb2.SessionLog
        self._append(step=step, session_log=log(status=log.START))

    def close(self) -> None:
        self._file.close()

    def _append(self, **fields: Any) -> None:
        event = self._event_pb2.Event(wall_time=time.time(), **fields)
        record = io.BytesIO()
        self._record_writer(record).write(event.SerializeToString())
        _write_whole(self._file, record.getvalue(), self._file.seek(0, io.SEEK_END))


def _read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Return columns and rows (name -> cell text) of a metrics file.

    An incomplete last line is left out.
    """
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return ["step"], []
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {error.strerror}") from None
    whole = text[: text.rfind(b"\n") + 1]
    if not whole:
        return ["step"], []
    try:
        columns, *lines = csv.reader(whole.decode().splitlines(), strict=True)
        rows = [
            {name: cell for name, cell in zip(columns, line, strict=True) if cell} for line in lines
        ]
        steps = [int(row["step"]) for row in rows]
    except (ValueError, KeyError, csv.Error):
        columns, rows, steps = [], [], []
    if columns[:1] != ["step"] or steps != sorted(set(steps)):
        raise MerlError(
            f"{path} is not a metrics file that can be continued (a line does not match the "
            "header, or the steps are out of order): move it away"
        )
    return columns, rows


def _csv_line(cells: Iterable[str]) -> bytes:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue().encode()


def _write_whole(file: io.FileIO, data: bytes, begin: int) -> None:
    """Write `data` at byte `begin` and truncate after it; on failure truncate at `begin`."""
    file.seek(begin)
    try:
        if (file.write(data) or 0) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file.truncate()
    except OSError:
        file.truncate(begin)
        raise
