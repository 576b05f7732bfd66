"""Files beside a run that are not what they seem are refused in one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from disguises import DISGUISES, at_most
from merl.cli import main

DEMOS = Path(__file__).parents[1] / "data" / "demos_format_1"
TRAIN = ["train", "merl.envs.dot:whole", "--agent", "bc", "--preset", "smoke", "--steps", "40"]


def commands(folder: Path) -> dict[Path, tuple[list[str], ...]]:
    """Return the commands that read a file, by the file."""
    demos, card, sweep = folder / "demos", folder / "policy.onnx.json", folder / "sweep.toml"
    shown = ["demos", "show", str(demos)]
    learnt = [*TRAIN, "--run-dir", str(folder / "run"), "--demos", str(demos)]
    out = ["--out", str(folder / "exported"), "--to", "robomimic"]
    return {
        demos / "demos.json": (shown, learnt),
        demos / "00000.npz": (shown, learnt, ["demos", "export", str(demos), *out]),
        card: (["run", str(folder / "policy.onnx")],),
        sweep: (["sweep", str(sweep)],),
    }


@pytest.mark.parametrize("disguise", DISGUISES, ids=lambda each: each.__name__)
def test_a_file_that_is_not_what_it_seems_is_refused(
    disguise: Callable[[Path], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file, lines in commands(tmp_path).items():
        shutil.rmtree(tmp_path)
        shutil.copytree(DEMOS, tmp_path / "demos")
        (tmp_path / "policy.onnx").touch()
        file.unlink(missing_ok=True)
        disguise(file)
        for line in lines:
            with at_most(30):
                code = main(line)
            err = capsys.readouterr().err
            assert code == 2, (line, err)
            assert err.count("\n") == 1, (line, err)
            assert err.startswith("merl: error: "), (line, err)
            assert str(file) in err, (line, err)
