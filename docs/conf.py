"""Sphinx configuration of the documentation site; `make docs` builds it into docs/_build."""

from __future__ import annotations

import contextlib
import io
import os
import textwrap
from itertools import groupby
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import merl
from merl.cli import main
from merl.config import flat
from merl.experiments.presets import PRESETS, compose

project = "merl"
copyright = "the merl authors"
release = version = merl.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "package.md"]
highlight_language = "text"
html_theme = "furo"
html_title = "merl"
html_show_sourcelink = False
html_copy_source = False
pygments_style, pygments_dark_style = "friendly", "monokai"
default_role = "literal"  # docstrings mark code with single backticks
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_class_signature = "separated"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
napoleon_use_ivar = True
napoleon_use_rtype = False
myst_heading_anchors = 3


class HelpOf(SphinxDirective):
    """The help that a command of merl prints: `merl-help` with the command's words."""

    optional_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Run the command with `--help`."""
        words = self.arguments[0].split() if self.arguments else []
        output = io.StringIO()
        os.environ |= {"COLUMNS": "88", "NO_COLOR": "1"}
        with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
            main([*words, "--help"])
        return [nodes.literal_block(text=filled(output.getvalue()), language="text")]


def filled(text: str) -> str:
    """Fill the indented paragraphs of a help text, which tyro breaks at the source's line ends."""
    lines = []
    for indent, group in groupby(map(str.rstrip, text.splitlines()), indentation):
        paragraph = list(group)
        if len(indent) >= 8:
            joined = " ".join(line.strip() for line in paragraph)
            paragraph = textwrap.wrap(
                joined, 86, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
            )
        lines += paragraph
    return "\n".join(lines)


def indentation(line: str) -> str:
    """Return the spaces at the start of a line."""
    return line[: len(line) - len(line.lstrip())]


class PresetTable(SphinxDirective):
    """A table of the config values in which the presets differ, for merl's own tasks."""

    def run(self) -> list[nodes.Node]:
        """Compose every preset and compare."""
        configs = [flat(compose(preset, "reach_duplo")) for preset in PRESETS]
        rows = [["value", *PRESETS]]
        for name in configs[0]:
            values = [shown(config.get(name)) for config in configs]
            if name != "preset" and len(set(values)) > 1:
                rows.append([name, *values])
        return [table(rows)]


def shown(value: Any) -> str:
    """Return a config value as text."""
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "()"
    return f"{value:,}" if type(value) is int else str(value)


def table(rows: list[list[str]]) -> nodes.table:
    """Return a table whose first row is the header and whose first column is code."""
    group = nodes.tgroup("", *[nodes.colspec(colwidth=1) for _ in rows[0]], cols=len(rows[0]))
    built = [
        nodes.row("", *[nodes.entry("", nodes.paragraph("", text)) for text in row]) for row in rows
    ]
    for row in built[1:]:
        row[0][0][:] = [nodes.literal(row[0].astext(), row[0].astext())]
    group += nodes.thead("", built[0])
    group += nodes.tbody("", *built[1:])
    return nodes.table("", group)


def setup(app: Sphinx) -> None:
    """Register the directives."""
    app.add_directive("merl-help", HelpOf)
    app.add_directive("preset-table", PresetTable)
