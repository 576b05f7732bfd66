"""The console that all commands print to."""

from __future__ import annotations

import pytest

from merl.cli.output import make_console


def test_where_no_terminal_is_lines_are_not_wrapped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    line = "a line of many words " * 20
    make_console().print(line)
    assert capsys.readouterr().out == f"{line}\n"
