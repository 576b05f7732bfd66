"""The folder of a run: name, lock, and checks before a run starts in it."""

from __future__ import annotations

import fcntl
import itertools
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from merl.config import Source, TrainConfig
from merl.core import CONFIG_FILE, LOCK_FILE, METRICS_FILE, MerlError, suggest
from merl.core.files import cause, open_file, part_of, read_file, remove, reporting

PRETRAINED = Path(__file__).parent.parent / "pretrained"
"""Folder of the trained policies that come with merl: run folders without a replay."""
ACTORS_FILE = "actors.json"
"""File in a run folder that names the actor of each ring of the replay."""
_FILES = (METRICS_FILE, CONFIG_FILE, LOCK_FILE, ACTORS_FILE)
_FOLDERS = ("checkpoints", "replay", "tensorboard", "videos")


def run_path(config: TrainConfig, source: Source, home: Path | None = None) -> Path:
    """Return the folder that a config names, or else the first unused default folder.

    Args:
        config: the config of the run.
        source: where its values come from.
        home: the base of a relative path; the working folder if None.

    Returns:
        An absolute path.
    """
    home = Path.cwd() if home is None else home
    if config.run_dir is not None:
        return home / config.run_dir
    agent = config.agent_name if source.setting == "matched" else f"{config.agent_name}-published"
    name = f"{config.task}-{agent}-{source.preset}-s{config.seed}"
    name = re.sub(r"[^\w.-]+", "-", name)  # `module:function`, `namespace/Id-v0`
    runs = home / "runs"
    numbered = (runs / f"{name}-{number}" for number in itertools.count(2))
    return next(p for p in itertools.chain([runs / name], numbered) if not _exists(p))


def existing_run(path: Path) -> Path:
    """Return the absolute path of a run; `pretrained/NAME` is one that comes with merl.

    Raises:
        MerlError: there is no such policy in merl.
    """
    if path.parent != Path(PRETRAINED.name) or path.exists():
        return path.absolute()
    if not (PRETRAINED / path.name).is_dir():
        known = sorted(each.name for each in PRETRAINED.iterdir() if each.is_dir())
        raise MerlError(f"merl has no policy {str(path)!r}: {suggest(path.name, known)}")
    return PRETRAINED / path.name


def resume_line(folder: Path) -> str:
    """Return the command that resumes a run."""
    return f"{program()} resume {shlex.quote(str(folder))}"


def refuse_existing(path: Path) -> None:
    """Check that a new run can use a folder.

    The folder may be missing, empty, or left by a run that was killed before it wrote its config.

    Raises:
        MerlError: the folder holds other files, or the system does not allow its name.
    """
    if not _exists(path) or holds_nothing(path):
        return
    if _exists(path / CONFIG_FILE):
        way = f"resume it with `{resume_line(path)}`, or name another"
    else:
        way = "it is not a run: name another"
    raise MerlError(f"run folder {path} already exists: {way} with --run-dir")


def holds_nothing(path: Path) -> bool:
    """Return whether a folder holds at most the files that a run writes before its config."""
    try:
        files = (LOCK_FILE, part_of(path / CONFIG_FILE).name)
        return path.is_dir() and all(
            entry.name in files and not entry.is_symlink() for entry in path.iterdir()
        )
    except OSError:  # the folder is not readable
        return False


def create_folder(config: TrainConfig, source: Source, home: Path | None) -> tuple[Path, bool]:
    """Create the folder of a new run.

    Returns:
        The folder, and whether this process has created it.

    Raises:
        MerlError: the folder holds other files, or cannot be created.
    """
    while True:
        path = run_path(config, source, home)
        if config.run_dir is not None:
            refuse_existing(path)
        try:
            path.mkdir(parents=True)
        except FileExistsError as error:
            if Path(error.filename) != path:
                raise MerlError(
                    f"run folder {path} cannot be created: {error.filename} is a link to a folder "
                    "that does not exist: create it, or name another with --run-dir"
                ) from error
            if config.run_dir is None:
                continue  # another process has just taken this name
            return path, False
        except OSError as error:
            raise MerlError(f"run folder {path} cannot be created: {cause(error)}") from error
        return path, True


def _exists(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:  # the name is too long, or a folder is not searchable
        raise MerlError(f"run folder {path} cannot be used: {cause(error)}") from error
    return True


def check_links(run: Path) -> None:
    """Check that no link in a run leads out of its folder; an untrusted run may contain such links.

    Raises:
        MerlError: there is such a link, and the message names it; or the folder cannot be read.
    """
    with reporting(f"run folder {run} cannot be read"):
        root = run.resolve()
        for folder, folders, files in os.walk(run):
            for name in (*folders, *files):
                path = Path(folder, name)
                if path.is_symlink() and not _lies_in(path, root):
                    raise MerlError(
                        f"{path} is a link to {path.readlink()}, outside of the run, and merl does "
                        "not write through it: replace the link by the file or folder that it "
                        "points to"
                    )


def _lies_in(link: Path, root: Path) -> bool:
    try:
        return root in link.resolve().parents
    except (OSError, RuntimeError):  # a loop of links
        return False


def discard_folder(run: Path, created: bool) -> None:
    """Delete the files that this process has written into the folder of a new run.

    This process must hold the lock.

    Args:
        run: the folder.
        created: this process has created the folder, so the folder is deleted, too.
    """
    for name in (*_FOLDERS, *_FILES):
        remove(run / name)
        remove(part_of(run / name))
    if created:
        with suppress(OSError):  # the folder holds files of others
            run.rmdir()


@contextmanager
def lock_folder(run: Path) -> Iterator[None]:
    """Lock a folder so that no other process trains in it; the lock ends with the process.

    Raises:
        MerlError: another process has the lock or has removed the folder, or it cannot be locked.
    """
    path = run / LOCK_FILE
    with ExitStack() as stack:
        try:
            file = stack.enter_context(open_file(path, "a+b"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            same = os.path.sameopenfile(
                file.fileno(), stack.enter_context(open_file(path)).fileno()
            )
        except BlockingIOError:
            owner = f"process {_text(path)}" if _text(path) else "another process"
            raise MerlError(f"{owner} is training in {run}: stop it first") from None
        except FileNotFoundError:
            same = False
        except OSError as error:
            raise MerlError(f"{path} cannot be locked: {cause(error)}") from error
        if not same:
            raise MerlError(f"run folder {run} was just removed by another process: try again")
        with suppress(OSError):  # a full disk; the lock is valid without the number
            file.truncate(0)
            os.write(file.fileno(), str(os.getpid()).encode())
        yield


def _text(path: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return read_file(path, most=20).decode().strip()
    return ""


def program() -> str:
    """Return the command that calls this program: `merl` if the shell finds it, else its path."""
    found, called = shutil.which("merl"), Path(sys.argv[0])
    if found or called.name != "merl":
        return "merl"
    return shlex.quote(str(called))
