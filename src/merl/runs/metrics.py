"""The file `metrics.csv` of a run, written during training.

It has one row per environment step at which something was measured, first the column `step`, then
one column per metric; a cell is empty if the metric was not measured at that step. A failed write
never ends a run: the rows are kept in memory and written as soon as that is possible.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import logging
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from merl.core import METRICS_FILE, MerlError

_LOG = logging.getLogger(__name__)


class MetricsFile:
    """The file `metrics.csv` of a run, open for writing; a context manager.

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
        self._columns, self._rows = read_rows(self._path)
        self._written = 0  # number of rows that the file holds
        self._tail = 0  # byte offset of the last row
        self._file: io.FileIO | None = None  # None: outdated, rewrite the whole file
        # Only here: a folder that is deleted during the run is not created again.
        self._guard(lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
        self._guard(lambda: self._rewrite(None))

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
                name cannot be a column, or the file is closed.
        """
        if self._closed:
            raise ValueError(f"{self._path} is closed")
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

    def trim(self, step: int) -> None:
        """Drop every row after `step`: call it when a run resumes from a checkpoint of `step`.

        Args:
            step: the last step to keep.
        """
        kept = [row for row in self._rows if int(row["step"]) <= step]
        if len(kept) < len(self._rows):
            file = self._take_file()
            self._rows = kept
            self._written = min(self._written, len(kept))
            self._guard(lambda: self._rewrite(file))

    def close(self) -> None:
        """Flush all metrics to disk and close the files; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._file is None:
            self._guard(lambda: self._rewrite(None))
        if self._file is not None:
            self._guard(self._sync)
            self._guard(self._file.close)

    def _guard(self, action: Callable[[], None]) -> None:
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

    def _sync(self) -> None:
        assert self._file is not None
        os.fsync(self._file.fileno())

    def _take_file(self) -> io.FileIO | None:
        """Return the open file and set `_file` to None before the rows in memory change.

        The next successful write sets `_file` again. If an interrupt prevents it, the file counts
        as outdated.
        """
        file, self._file = self._file, None
        return file

    def _end(self) -> int:
        """Return the size of the file in bytes."""
        return 0 if self._file is None else self._file.seek(0, io.SEEK_END)

    def _put_last_row(self, file: io.FileIO, begin: int) -> None:
        """Write the last row at byte `begin` in one write, and truncate the file after it."""
        try:
            write_whole(file, _csv_line(self._cells(self._rows[-1])), begin)
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
            _remove(temporary)
            raise
        self._file = io.FileIO(self._path, "r+")
        self._tail = sum(map(len, lines)) - len(lines[-1])
        self._written = len(self._rows)

    def _cells(self, row: Mapping[str, str]) -> Iterable[str]:
        return (row.get(name, "") for name in self._columns)


def read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
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


def write_whole(file: io.FileIO, data: bytes, begin: int) -> None:
    """Write `data` at byte `begin` and truncate after it; on failure truncate at `begin`."""
    file.seek(begin)
    try:
        if (file.write(data) or 0) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        file.truncate()
    except OSError:
        file.truncate(begin)
        raise


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):  # a disk that is not writable may also refuse to delete
        path.unlink(missing_ok=True)
