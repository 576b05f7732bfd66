"""Reader of LeRobotDataset v3: tables in Parquet, frames in MP4 or as PNG in the tables.

meta/info.json                        features, frames per second, patterns of the files' names
meta/episodes/chunk-*/file-*.parquet  a row for each episode: its length, its files, its times
data/chunk-*/file-*.parquet           a row for each timestep
videos/KEY/chunk-*/file-*.mp4         frames of one camera; a file holds several episodes
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.core.files import check_kind, read_json, reporting
from merl.demos.lerobot_frames import VideoFrames, decoded
from merl.demos.packages import require
from merl.demos.source import Feature, RawEpisode, at_each_step

VERSION = "v3."
INFO = "meta/info.json"
ACTION, REWARD, DONE, SUCCESS = "action", "next.reward", "next.done", "next.success"
TERMINATED, INTENDED = "next.terminated", "action.intended"
"""The last two are merl's: by them an exported folder is imported as it was."""
OBSERVATION = "observation"


class LeRobotDataset:
    """A folder in the format LeRobotDataset v3; see `merl.demos.source.Source`.

    Args:
        path: the folder.

    Raises:
        MerlError: a file is missing or damaged, or the folder has another version.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.format = path, "LeRobotDataset v3"
        require("pyarrow", "LeRobotDataset")
        info = _info(path)
        try:
            self.rate: float | None = float(info["fps"])
            if not 0 < self.rate < float("inf"):
                raise ValueError(f"fps {self.rate}")
            features = {
                str(key): (str(value["dtype"]), tuple(int(n) for n in value["shape"]))
                for key, value in info["features"].items()
            }
            self._patterns = str(info["data_path"]), info.get("video_path")
            (self.action_size,) = features[ACTION][1]
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise MerlError(f"{path / INFO} is damaged: {error!r}") from None
        self._stored = features
        self.features: Mapping[str, Feature] = {
            key: _feature(*value)
            for key, value in features.items()
            if key.startswith(OBSERVATION) and value[0] not in ("string", "language")
        }
        self._rows = self._episodes()
        self.count = len(self._rows)

    def episodes(self, keys: tuple[str, ...]) -> Iterator[RawEpisode]:
        """Read the episodes with these features; see `Source`."""
        columns = [key for key in keys if self._stored[key][0] != "video"]
        others = [
            key for key in (ACTION, INTENDED, REWARD, SUCCESS, TERMINATED) if key in self._stored
        ]
        videos: dict[str, VideoFrames] = {}
        table, opened = None, None
        for row in self._rows:
            index, length = int(row["episode_index"]), int(row["length"])
            name = f"episode {index}"
            file = self._file(self._patterns[0], row, "data", name)
            if file != opened:
                table, opened = _table(file, [*columns, *others, "episode_index"]), file
            assert table is not None
            if "episode_index" not in table.column_names:
                raise MerlError(f"{file} lacks column 'episode_index'")
            rows = np.flatnonzero(table.column("episode_index").to_numpy() == index)
            if len(rows) != length:
                raise MerlError(
                    f"{file} has {len(rows)} rows of {name}, and its index says {length}: copy the "
                    "dataset again"
                )
            part = table.take(rows)
            values = {key: self._values(part, key, file) for key in (*columns, *others)}
            for key in keys:
                if key not in columns:
                    values[key] = self._frames(videos, key, row, length, name)
            flags = {
                key: values[key].reshape(-1).astype(bool)
                for key in (SUCCESS, TERMINATED)
                if key in values
            }
            ended = bool(flags[TERMINATED][-1]) if TERMINATED in flags else None
            solved = flags.get(SUCCESS)
            yield RawEpisode(
                name,
                {key: values[key] for key in keys},
                values[ACTION],
                values.get(INTENDED),
                values[REWARD].reshape(-1) if REWARD in values else None,
                ended,
                None if solved is None else bool(solved[-1]),
                None if solved is None else at_each_step(solved, terminated=bool(ended)),
            )

    def _episodes(self) -> list[dict[str, Any]]:
        """Return the rows of the index, in the order of the episodes."""
        files = sorted(self.path.glob("meta/episodes/*/*.parquet"))
        if not files:
            raise MerlError(f"{self.path} holds no episode: meta/episodes has no table")
        rows: list[dict[str, Any]] = []
        for file in files:
            table = _table(file, None)
            wanted = [name for name in table.column_names if not name.startswith("stats/")]
            rows += table.select(wanted).to_pylist()
        for row in rows:
            if not isinstance(row.get("episode_index"), int) or not row.get("length"):
                raise MerlError(f"{files[0].parent}: a row lacks episode_index or length: {row}")
        return sorted(rows, key=lambda row: int(row["episode_index"]))

    def _file(
        self, pattern: Any, row: Mapping[str, Any], kind: str, name: str, **more: Any
    ) -> Path:
        try:
            chunk, file = row[f"{kind}/chunk_index"], row[f"{kind}/file_index"]
            found = self.path / str(pattern).format(chunk_index=chunk, file_index=file, **more)
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise MerlError(f"{self.path}: the index of {name} is damaged: {error!r}") from None
        if not found.resolve().is_relative_to(self.path.resolve()):
            raise MerlError(f"{self.path / INFO} names {found}, which is outside of the folder")
        with reporting(f"{found} cannot be read"):
            check_kind(found)
        return found

    def _values(self, table: Any, key: str, file: Path) -> NDArray[Any]:
        """Return a column of a table, (T, *shape)."""
        kind, shape = self._stored[key]
        if key not in table.column_names:
            raise MerlError(f"{file} lacks column {key!r}, which {INFO} names")
        column = table.column(key).combine_chunks()
        try:
            if kind == "image":
                return np.stack([decoded(each["bytes"]) for each in column.to_pylist()])
            while hasattr(column, "flatten") and hasattr(column.type, "value_type"):
                column = column.flatten()
            flat: NDArray[Any] = column.to_numpy(zero_copy_only=False)
            return flat.astype(np.dtype(kind)).reshape(table.num_rows, *shape)
        except (ValueError, TypeError, av.FFmpegError) as error:
            raise MerlError(f"{file}: column {key!r} is not {kind} {shape}: {error}") from None

    def _frames(
        self,
        videos: dict[str, VideoFrames],
        key: str,
        row: Mapping[str, Any],
        length: int,
        name: str,
    ) -> NDArray[np.uint8]:
        """Return the frames of an episode from a video, (T, H, W, 3)."""
        file = self._file(self._patterns[1], row, f"videos/{key}", name, video_key=key)
        if key not in videos or videos[key].path != file:
            videos[key] = VideoFrames(file)
        begin, rate = row.get(f"videos/{key}/from_timestamp"), self.rate
        if not isinstance(begin, int | float) or not np.isfinite(begin) or rate is None:
            raise MerlError(f"{self.path}: the index of {name} has no time of {key!r}")
        return np.stack([videos[key].at(begin + i / rate, 0.5 / rate) for i in range(length)])


def _info(path: Path) -> dict[str, Any]:
    file = path / INFO
    try:
        info = read_json(file)
    except FileNotFoundError:
        raise MerlError(f"{path} is no LeRobotDataset v3: it has no {INFO}") from None
    except (OSError, ValueError) as error:
        raise MerlError(f"{file} cannot be read: {error}") from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not isinstance(version, str) or not version.startswith(VERSION):
        raise MerlError(
            f"{path} has version {version!r}, and merl reads {VERSION}0: convert it with LeRobot"
        )
    return dict(info)


def _feature(kind: str, shape: tuple[int, ...]) -> Feature:
    if kind not in ("image", "video"):
        return Feature(shape, kind)
    # Some datasets say (C, H, W); the decoded frame is (H, W, C).
    if len(shape) == 3 and shape[0] == 3 and shape[2] != 3:
        shape = (shape[1], shape[2], shape[0])
    return Feature(shape, "uint8", image=True, lossy=kind == "video")


def _table(file: Path, columns: list[str] | None) -> Any:
    import pyarrow
    from pyarrow import parquet

    try:
        if columns is not None:  # `_values` reports those that are missing
            names = parquet.read_schema(file).names
            columns = [column for column in columns if column in names]
        return parquet.read_table(file, columns=columns)
    except FileNotFoundError:
        raise MerlError(f"{file} is missing: copy the dataset again") from None
    except (OSError, pyarrow.ArrowException) as error:
        what = str(error).split("\n")[0]
        raise MerlError(f"{file} cannot be read: {what}") from None
