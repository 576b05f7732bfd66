"""Pieces of the page of a report: tables that can be sorted, figures in the page's colours."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

THEMED = {
    "#222222": "ink",
    "#6b7280": "muted",
    "#b4bbc5": "faint",
    "#e8ebef": "grid",
    "#ffffff": "paper",
}
"""Colours of the figures that follow the page's theme (light or dark)."""

Cell = tuple[str, float | str]
"""HTML of a cell, and the value that it is sorted by."""


def bullets(items: Iterable[str]) -> str:
    """Return a list; empty without items."""
    found = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f'<ul class="notes">{found}</ul>' if found else ""


def table(columns: Mapping[str, Callable[[T], Cell]], rows: Sequence[T]) -> str:
    """Return a table; a click on a heading sorts it."""
    head = "".join(f"<th><button>{name}</button></th>" for name in columns)
    body = []
    for row in rows:
        cells = (cell(row) for cell in columns.values())
        body.append("".join(f'<td data-value="{escape(str(v))}">{text}</td>' for text, v in cells))
    lines = "".join(f"<tr>{cells}</tr>" for cells in body)
    whole = f"<table><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>"
    return f'<div class="wide">{whole}</div>'


def inline_svg(path: Path) -> str:
    """Return a figure for use inside a page: without a size of its own, in the page's colours."""
    text = re.sub(r"<metadata>.*?</metadata>", "", path.read_text(), flags=re.DOTALL)
    text = text[text.index("<svg") :]
    opening, rest = text.split(">", 1)
    opening = re.sub(r' (width|height)="[^"]*"', "", opening)
    for colour, name in THEMED.items():
        rest = re.sub(colour, f"var(--{name})", rest, flags=re.IGNORECASE)
    return f'<div class="wide">{opening}>{rest}</div>'


def slug(text: str) -> str:
    """Return a text as a part of a file's name."""
    return re.sub(r"[^\w.-]+", "-", text).strip("-") or "task"


def number_cell(value: float, form: str = ".3g") -> Cell:
    """Return the cell of a number; empty for NaN."""
    return ("", "") if math.isnan(value) else (f"{value:{form}}", value)
