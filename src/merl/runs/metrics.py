"""The file `metrics.csv` of a run, written during training.

It has one row per environment step at which something was measured, first the column `step`, then
one column per metric; a cell is empty if the metric was not measured at that step. A failed write
never ends a run: the rows are kept in memory and written as soon as that is possible.
"""

from __future__ import annotations

import csv
import io
import logging
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path

from merl.core import METRICS_FILE, MerlError
from merl.core.files import append_whole, cause, read_file, replace_file

_LOG = logging.getLogger(__name__)


class MetricsFile(AbstractContextManager["MetricsFile"]):
    """The file `metrics.csv` of a run, open for writing; a context manager.

    All rows are also held in memory (a few MB for the longest run). A new step is one `write` of
    one line, so a killed process leaves at most an incomplete last line, which is removed when the
    file is opened again. If the last row gets more values, a column is new, rows are dropped, or a
    write has failed, the whole file is written to a temporary name and renamed.

    Args:
        run_dir: the folder of the run; created if missing. An existing `metrics.csv` is continued.
        warn: receives one message, once, if metrics cannot be written (e.g. the disk is full).

    Raises:
        MerlError: `metrics.csv` exists but cannot be read, or is not a metrics file.
    """

    def __init__(self, run_dir: Path | str, warn: Callable[[str], None] = _LOG.warning) -> None:
        self._path = Path(run_dir) / METRICS_FILE
        self._warn: Callable[[str], None] | None = warn  # None: the user is warned
        self._closed = False
        self._columns, self._rows = read_rows(self._path)
        self._written = 0  # number of rows that the file holds
        self._file: io.FileIO | None = None
        # Only here: a folder that is deleted during the run is not created again.
        self._guard(lambda: self._path.parent.mkdir(parents=True, exist_ok=True))
        self._guard(self._rewrite)

    def __exit__(self, *_: object) -> None:
        """Close the file, also after an exception."""
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
        row = {name: repr(float(value)) for name, value in values.items()}
        for name in row:
            if not name or name == "step" or not name.isprintable():
                raise ValueError(f"a metric cannot be named {name!r}")
        new = [name for name in row if name not in self._columns]
        appends = step != last and not new and not self.unwritten and self._file is not None
        if step == last:
            self._written = min(self._written, len(self._rows) - 1)
            self._rows[-1].update(row)
        else:
            self._rows.append({"step": str(int(step))} | row)
        self._columns += new
        self._guard(self._append if appends else self._rewrite)

    def trim(self, step: int) -> None:
        """Drop every row after `step`: call it when a run resumes from a checkpoint of `step`.

        Args:
            step: the last step to keep.
        """
        kept = [row for row in self._rows if int(row["step"]) <= step]
        if len(kept) < len(self._rows):
            self._rows, self._written = kept, 0
            self._guard(self._rewrite)

    def close(self) -> None:
        """Flush all metrics to disk and close the file; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self.unwritten or self._file is None:
            self._guard(self._rewrite)
        if self._file is not None:
            self._guard(self._sync)
            self._guard(self._file.close)

    def _guard(self, action: Callable[[], object]) -> None:
        """Run a file operation; if it fails, warn the user once and continue."""
        try:
            action()
        except OSError as error:
            warn, self._warn = self._warn, None
            if warn is not None:
                warn(
                    f"metrics cannot be written to {self._path.parent} "
                    f"({cause(error)}); training continues, and they are kept in memory "
                    "until they can be written"
                )

    def _sync(self) -> None:
        assert self._file is not None
        os.fsync(self._file.fileno())

    def _append(self) -> None:
        """Write the last row at the end of the file, which holds all rows before it."""
        assert self._file is not None
        append_whole(self._file, self._line(self._rows[-1]))
        self._written = len(self._rows)

    def _rewrite(self) -> None:
        """Replace `metrics.csv` by a file with all rows, and open it."""
        if self._file is not None:
            self._file.close()
            self._file = None
        replace_file(self._path, _csv_line(self._columns), *map(self._line, self._rows))
        self._file = io.FileIO(self._path, "r+")
        self._written = len(self._rows)

    def _line(self, row: Mapping[str, str]) -> bytes:
        return _csv_line(row.get(name, "") for name in self._columns)


def read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Return columns and rows (name -> cell text) of a metrics file.

    An incomplete last line is left out.
    """
    try:
        text = read_file(path)
    except FileNotFoundError:
        return ["step"], []
    except OSError as error:
        raise MerlError(f"{path} cannot be read: {cause(error)}") from error
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
