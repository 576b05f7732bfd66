"""The numbers of a run, written while it goes on: `metrics.csv` and TensorBoard events.

`metrics.csv` is the truth: one row per environment step at which something was measured, `step`
first, one column per name, an empty cell where a name was not measured. TensorBoard shows the same
names. Neither may end a run: what cannot be written is kept in memory and written when it can be.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from merl.core import METRICS_FILE, MerlError

TENSORBOARD_FOLDER = "tensorboard"

_LOG = logging.getLogger(__name__)


class MetricsWriter:
    """Appends the numbers of a run to its folder; a context manager.

    The rows are also held in memory (a few MB for the longest run), so the file can be rewritten
    whole, to a temporary name and then renamed, when a new column appears, when rows are dropped,
    or after a failed write. Between those a row is one `write` of one line, so a killed process
    leaves at most a torn last line, which reopening removes.

    Args:
        run_dir: the run's folder; made if missing. An existing `metrics.csv` is continued.
        warn: is told, once, in one line, that the numbers cannot be written (a full disk).

    Raises:
        MerlError: `metrics.csv` is there but cannot be read, or is not a file of metrics.
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
        self._written = 0  # rows that the file holds as memory does
        self._tail = 0  # byte at which the last row's line begins
        self._file: io.FileIO | None = None  # None: the file is behind memory, rewrite it whole
        self._events: _EventFile | None = None
        # Only here: a folder that is taken away during the run stays away.
        self._guard(lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
        self._guard(lambda: self._rewrite(None))
        self._guard(self._open_events)

    def __enter__(self) -> Self:
        """The writer itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close, whatever happened."""
        self.close()

    @property
    def last_step(self) -> int | None:
        """The last step that has a row; None if there is no row."""
        return int(self._rows[-1]["step"]) if self._rows else None

    @property
    def unwritten(self) -> int:
        """How many rows are in memory alone, since they could not be written."""
        return len(self._rows) - self._written

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record what was measured at `step`.

        A second call with the same step adds to that step's row (a name given twice keeps its
        later value), so that every step has one row. Nothing is written for no values.

        Args:
            step: environment steps so far, at least that of the last row.
            values: name -> value; names like `train/return`, on one line, never `step`.

        Raises:
            ValueError: a step before the last one (after resuming, call `trim` first), a name
                that cannot be a column, or a closed writer.
        """
        if self._closed:
            raise ValueError(f"the writer of {self._path} is closed")
        if not values:
            return
        last = self.last_step
        if last is not None and step < last:
            raise ValueError(f"step {step} comes after step {last}: trim({step}) first")
        numbers = {name: float(value) for name, value in values.items()}
        for name in numbers:
            if not name or name == "step" or not name.isprintable():
                raise ValueError(f"a metric cannot be named {name!r}")
        new = [name for name in numbers if name not in self._columns]

        begin = self._tail if step == last else self._end()
        file = self._take_file()
        self._written = min(self._written, len(self._rows) - (step == last))
        if step != last:
            self._rows.append({"step": str(int(step))})
        self._rows[-1].update({name: repr(value) for name, value in numbers.items()})
        self._columns += new
        if new or file is None:
            self._guard(lambda: self._rewrite(file))
        else:
            self._guard(lambda: self._put_last_row(file, begin))
        self._guard(lambda: self._log_events(step, numbers))

    def trim(self, step: int) -> None:
        """Drop every row after `step`: call it when a run goes on from a checkpoint of `step`.

        TensorBoard is told to forget the same part.

        Args:
            step: the last step to keep.
        """
        kept = [row for row in self._rows if int(row["step"]) <= step]
        if len(kept) < len(self._rows):
            file = self._take_file()
            self._rows = kept
            self._written = min(self._written, len(kept))
            self._guard(lambda: self._rewrite(file))
            self._guard(lambda: self._forget_events(step))

    def close(self) -> None:
        """Bring the numbers safely to disk and close the files; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._file is None:
            self._guard(lambda: self._rewrite(None))
        if self._file is not None:
            self._guard(self._sync)
            self._guard(self._file.close)
        if self._events is not None:
            self._guard(self._events.close)

    def _guard(self, action: Callable[[], None]) -> None:
        """Do something with files; if they fail, the run goes on and its user hears of it once."""
        try:
            action()
        except OSError as error:
            if not self._warned:
                self._warned = True
                reason = error.strerror or str(error)
                self._warn(
                    f"metrics cannot be written to {self._path.parent} ({reason}); training goes "
                    "on, the numbers are kept in memory and written as soon as they can be"
                )

    def _sync(self) -> None:
        assert self._file is not None
        os.fsync(self._file.fileno())

    def _take_file(self) -> io.FileIO | None:
        """The file, before memory changes; it is put back when it has followed.

        Whatever comes between, an interrupt too, the file then counts as behind.
        """
        file, self._file = self._file, None
        return file

    def _end(self) -> int:
        """Bytes in the file now."""
        return 0 if self._file is None else self._file.seek(0, io.SEEK_END)

    def _put_last_row(self, file: io.FileIO, begin: int) -> None:
        """Write the last row's line at byte `begin`, in one piece; nothing remains behind it."""
        try:
            _write_whole(file, _csv_line(self._cells(self._rows[-1])), begin)
        except BaseException:
            file.close()
            raise
        self._file, self._tail = file, begin
        self._written = len(self._rows)

    def _rewrite(self, old: io.FileIO | None) -> None:
        """Write every row to a temporary file, put it in place of `metrics.csv`, and open that."""
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
            _remove(temporary)
            raise
        self._file = io.FileIO(self._path, "r+")
        self._tail = sum(map(len, lines)) - len(lines[-1])
        self._written = len(self._rows)

    def _cells(self, row: Mapping[str, str]) -> Iterable[str]:
        return (row.get(name, "") for name in self._columns)

    def _open_events(self) -> None:
        self._events = _EventFile(self._path.parent / TENSORBOARD_FOLDER)

    def _log_events(self, step: int, values: Mapping[str, float]) -> None:
        if self._events is None:
            self._open_events()
        assert self._events is not None
        self._events.scalars(step, values)

    def _forget_events(self, step: int) -> None:
        if self._events is None:
            self._open_events()
        assert self._events is not None
        self._events.forget_from(step + 1)


class _EventFile:
    """One TensorBoard event file, written in whole records and flushed after each.

    TensorBoard's own `EventFileWriter`, which is under torch's `SummaryWriter`, writes from a
    background thread; on a full disk that thread dies with a traceback across the live view. Its
    record format is used directly instead; that leaves an installed TensorFlow alone, too.
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
        # The order of names is the order in which TensorBoard reads them, so time comes first.
        stamp = f"{time.time_ns() / 1e9:020.9f}.{socket.gethostname()}.{os.getpid()}"
        self._file = io.FileIO(folder / f"events.out.tfevents.{stamp}", "w")
        try:
            self._append(file_version="brain.Event:2")
        except OSError:
            self._file.close()
            raise

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Record the values of one step."""
        Summary = self._summary_pb2.Summary  # noqa: N806 - a class
        tagged = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
        self._append(step=step, summary=Summary(value=tagged))

    def forget_from(self, step: int) -> None:
        """Tell TensorBoard to drop what earlier files hold at `step` and after it."""
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
    """Columns and rows (name -> text of a cell) of a metrics file, without a torn last line."""
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
            f"{path} is not a file of metrics that can be continued (a line that does not fit its "
            "first, or steps out of order); move it away"
        )
    return columns, rows


def _csv_line(cells: Iterable[str]) -> bytes:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue().encode()


def _write_whole(file: io.FileIO, data: bytes, begin: int) -> None:
    """Let the file end with `data` from byte `begin` on, or, if that fails, at `begin`."""
    file.seek(begin)
    try:
        if (file.write(data) or 0) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file.truncate()
    except OSError:
        file.truncate(begin)
        raise


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):  # where nothing can be written, perhaps nor removed
        path.unlink(missing_ok=True)
