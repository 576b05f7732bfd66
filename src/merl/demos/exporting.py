"""Export of demonstrations to the formats of other projects; nothing is half-written."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from merl.core import MerlError
from merl.core.files import part_of, remove
from merl.demos.demonstrations import Demonstrations
from merl.demos.lerobot_writer import write_lerobot
from merl.demos.minari_data import write_minari
from merl.demos.robomimic import write_robomimic

Format = Literal["lerobot", "robomimic", "minari"]


def export_demos(
    demos: Demonstrations, form: Format, out: Path, rate: float | None, *, lossless: bool = False
) -> None:
    """Write demonstrations in the format of another project.

    Args:
        demos: the demonstrations.
        form: the format.
        out: the folder, or robomimic's file; it must not exist.
        rate: timesteps in a second.
        lossless: store images without loss in LeRobot's format too.

    Raises:
        MerlError: they do not fit the format, or cannot be read or written; nothing is written.
    """
    if not demos.lines:
        raise MerlError(f"{demos.path} holds no episode")
    out = out.absolute()
    if out.exists():
        raise MerlError(f"{out} exists: name another with --out")
    if form == "lerobot" and rate is None:
        raise MerlError("LeRobotDataset needs the steps per second: give them with --rate")
    part = part_of(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        remove(part)
        if form != "robomimic":
            part.mkdir()
        if form == "lerobot":
            assert rate is not None
            write_lerobot(demos, part, rate, lossless=lossless)
        elif form == "minari":
            write_minari(demos, part)
        else:
            write_robomimic(demos, part, rate)
        part.replace(out)
    except OSError as error:
        raise MerlError(f"{out} cannot be written: {error.strerror or error}") from None
    finally:
        remove(part)
