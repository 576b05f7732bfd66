"""The places of actors in the replay, and the file that keeps them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from merl.core import MerlError
from merl.link.places import place_of


def test_an_actor_keeps_its_place_and_a_new_one_takes_a_free_one(tmp_path: Path) -> None:
    assert [place_of(name, tmp_path, 3) for name in ("a", "b", "a", "c")] == [0, 1, 0, 2]
    with pytest.raises(MerlError, match=r"all places of the run are taken \(--num-envs 3\)"):
        place_of("d", tmp_path, 3)
    (tmp_path / "actors.json").write_text(json.dumps(["a", None, "c"]))
    assert place_of("d", tmp_path, 3) == 1
    assert json.loads((tmp_path / "actors.json").read_text()) == ["a", "d", "c"]


@pytest.mark.parametrize(
    "content", [b"", b"[0, ", b"{}", b'"a"', b"null", b"[null, null, null]", b"\xff"]
)
def test_a_damaged_list_is_named_in_one_line_and_kept(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "actors.json"
    file.write_bytes(content)
    with pytest.raises(MerlError, match=r"actors\.json is damaged \(.*\): restore it") as caught:
        place_of("a", tmp_path, 2)
    assert "\n" not in str(caught.value)
    assert file.read_bytes() == content
