"""The folder of a run: its name, its lock, and what may lie in it before a run begins."""

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

from merl.config import TrainConfig
from merl.core import CONFIG_FILE, METRICS_FILE, MerlError

LOCK_FILE = "lock"
PART = f".{CONFIG_FILE}.part"
"""`config.json` while it is written."""
_FILES = (METRICS_FILE, f".{METRICS_FILE}.part", CONFIG_FILE, PART, LOCK_FILE)
_FOLDERS = ("checkpoints", "replay", "tensorboard", "videos")


def run_path(config: TrainConfig, home: Path | None = None) -> Path:
    """Return the folder that a config names, or the first of the default ones that is free.

    Args:
        config: of the run.
        home: where a relative folder lies; the working folder if None.

    Returns:
        An absolute path.
    """
    home = Path.cwd() if home is None else home
    if config.run_dir is not None:
        return home / config.run_dir
    agent = config.agent_name if config.setting == "matched" else f"{config.agent_name}-published"
    task = re.sub(r"[^\w.-]+", "-", config.task)  # `module:function`, `namespace/Id-v0`
    name = f"{task}-{agent}-{config.preset}-s{config.seed}"
    runs = home / "runs"
    numbered = (runs / f"{name}-{number}" for number in itertools.count(2))
    return next(p for p in itertools.chain([runs / name], numbered) if not _exists(p))


def resume_line(folder: Path) -> str:
    """Return the command that resumes a run."""
    return f"{program()} resume {shlex.quote(str(folder))}"


def refuse_existing(path: Path) -> None:
    """Never write into a folder that holds something.

    A folder that is empty, or that a run left which was killed at its very start, holds nothing.

    Raises:
        MerlError: the folder holds something, or its name is refused by the system.
    """
    if not _exists(path) or holds_nothing(path):
        return
    if _exists(path / CONFIG_FILE):
        way = f"go on with `{resume_line(path)}`, or name another"
    else:
        way = "it is not a run: name another"
    raise MerlError(f"run folder {path} exists already: {way} with --run-dir")


def holds_nothing(path: Path) -> bool:
    """Whether nothing is there but what a run writes before its config."""
    try:
        return path.is_dir() and all(
            entry.name in (LOCK_FILE, PART) and not entry.is_symlink() for entry in path.iterdir()
        )
    except OSError:  # it may not be read
        return False


def create_folder(config: TrainConfig, home: Path | None) -> tuple[Path, bool]:
    """The folder of a new run, and whether this process has created it.

    Raises:
        MerlError: it holds something, or cannot be made.
    """
    while True:
        path = run_path(config, home)
        refuse_existing(path)
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            if config.run_dir is None:
                continue  # another process has just taken this name
            return path, False
        except OSError as error:
            raise MerlError(f"the run's folder {path} cannot be made: {error.strerror}") from None
        return path, True


def _exists(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:  # too long a name, a folder that may not be searched
        raise MerlError(f"run folder {path} cannot be used: {error.strerror}") from None
    return True


def check_links(run: Path) -> None:
    """Refuse to write through links that lead out of the folder, where a stranger put them.

    Raises:
        MerlError: naming the link.
    """
    root = run.resolve()
    for folder, folders, files in os.walk(run):
        for name in (*folders, *files):
            path = Path(folder, name)
            if path.is_symlink() and not _lies_in(path, root):
                raise MerlError(
                    f"{path} is a link to {path.readlink()}, outside of the run, and is not "
                    "written to: replace it by what it leads to"
                )


def _lies_in(link: Path, root: Path) -> bool:
    try:
        return root in link.resolve().parents
    except (OSError, RuntimeError):  # a loop of links
        return False


def discard_folder(run: Path, created: bool) -> None:
    """Remove what this process has written into the folder of a new run, whose lock it has.

    Args:
        run: the folder.
        created: this process has created the folder, too.
    """
    for name in (*_FOLDERS, *_FILES):
        path = run / name
        if name in _FOLDERS:
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink(missing_ok=True)
    if created:
        with suppress(OSError):  # somebody has put a file into it
            run.rmdir()


@contextmanager
def lock_folder(run: Path) -> Iterator[None]:
    """Keep every other process from training in a folder; the lock dies with the process.

    Raises:
        MerlError: another process trains here.
    """
    path = run / LOCK_FILE
    with ExitStack() as stack:
        try:
            file = stack.enter_context(path.open("a+"))
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            same = os.path.sameopenfile(file.fileno(), stack.enter_context(path.open()).fileno())
        except BlockingIOError:
            owner = f"process {_text(path)}" if _text(path) else "another process"
            raise MerlError(f"{owner} is training in {run}: stop it first") from None
        except FileNotFoundError:
            same = False
        except OSError as error:
            raise MerlError(f"{path} cannot be locked: {error.strerror}") from None
        if not same:
            raise MerlError(f"run folder {run} was removed by another process just now: try again")
        with suppress(OSError):  # a full disk; the lock holds without the number
            file.truncate(0)
            os.write(file.fileno(), str(os.getpid()).encode())
        yield


def _text(path: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text().strip()
    return ""


def program() -> str:
    """What to type to call this program again: `merl` if the shell would find it."""
    found, called = shutil.which("merl"), Path(sys.argv[0])
    if found or called.name != "merl":
        return "merl"
    return shlex.quote(str(called))
