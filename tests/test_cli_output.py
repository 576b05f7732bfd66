"""What commands print reaches every reader: whole lines, in any encoding."""

from __future__ import annotations

import io
import sys

import pytest

from merl.cli.output import allow_any_character, make_console


def test_where_no_terminal_is_lines_are_not_wrapped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    line = "a line of many words " * 20
    make_console().print(line)
    assert capsys.readouterr().out == f"{line}\n"


@pytest.mark.parametrize(
    ("encoding", "errors", "expected"),
    [
        ("ascii", "surrogateescape", b"?? largest ??er \xf6"),
        ("latin-1", "strict", b"?? largest \xd6\xdfer \xf6"),
        ("utf-8", "strict", "▁█ largest Ößer ".encode() + b"\xf6"),
    ],
)
def test_no_character_is_an_error(
    encoding: str, errors: str, expected: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also not a byte of a file name that is none in UTF-8, which is printed as it is."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors=errors)
    monkeypatch.setattr(sys, "stdout", stream)
    allow_any_character()
    print("▁█ largest Ößer \udcf6", end="", flush=True)
    assert stream.buffer.getvalue() == expected  # type: ignore[attr-defined]
