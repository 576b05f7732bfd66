"""The console that all commands print to."""

from __future__ import annotations

import pytest

from merl.cli.console import make_console


def test_lines_are_not_wrapped_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    line = "a line of many words " * 20
    make_console().print(line)
    assert capsys.readouterr().out == f"{line}\n"
