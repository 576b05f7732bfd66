from __future__ import annotations

import errno
import io
import os
from pathlib import Path

import pytest

from faults import Faults, with_faults
from merl.core import MerlError
from merl.core.files import append_whole, entries, is_gone, part_of, replace_file, reporting


def test_an_error_of_the_system_becomes_one_line() -> None:
    with pytest.raises(MerlError) as caught, reporting("x cannot be written"):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), "a long path")
    assert str(caught.value) == "x cannot be written: Read-only file system"


def test_a_file_that_cannot_be_replaced_keeps_its_content(tmp_path: Path) -> None:
    file, size = tmp_path / "file", 4
    replace_file(file, b"old", b"er")
    for at in range(1, 20):

        def replace() -> int:
            try:
                replace_file(file, b"new" * size)
            except OSError:
                return 1
            return 0

        ended = with_faults(replace, Faults(tmp_path, at, errno.EIO))
        expected = b"older" if ended.code else b"new" * size
        assert file.read_bytes() == expected
        assert ended.code in (0, 1), ended.err
        if at > len(ended.names):
            break
        if ended.code:
            assert not part_of(file).exists() or "remove" in ended.names[-1]
        replace_file(file, b"older")
    assert at > 3


def test_a_half_written_line_is_removed(tmp_path: Path) -> None:
    class Full(io.FileIO):
        def write(self, data: bytes) -> int:  # type: ignore[override]
            return super().write(data[:2])

    file = tmp_path / "lines"
    file.write_bytes(b"one\n")
    with Full(file, "r+") as opened, pytest.raises(OSError, match="No space left"):
        append_whole(opened, b"two\n")
    assert file.read_bytes() == b"one\n"


def test_a_folder_that_cannot_be_read_is_not_empty(tmp_path: Path) -> None:
    assert entries(tmp_path / "none") == []
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        entries(tmp_path / "file")


def test_a_file_is_gone_only_if_the_disk_says_so(tmp_path: Path) -> None:
    def ask() -> int:
        return int(is_gone(tmp_path / "file"))

    assert ask() == 1
    assert with_faults(ask, Faults(tmp_path, 1, errno.ESTALE)).code == 0
