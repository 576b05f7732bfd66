"""Writer of LeRobotDataset v3; `merl.demos.lerobot_reader` describes the files.

Images become H.264 videos, with loss, or PNG in the tables, without. LeRobot has no observation
after the last action: it is left out.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merl.core import MerlError
from merl.demos.demonstrations import Demonstrations
from merl.demos.episode import Episode
from merl.demos.lerobot_frames import VideoFile, png
from merl.demos.lerobot_reader import (
    ACTION,
    DONE,
    INFO,
    INTENDED,
    OBSERVATION,
    REWARD,
    SUCCESS,
    TERMINATED,
)
from merl.demos.packages import require

EPISODES_PER_FILE = 50
CHUNK = 1000
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
TIMES = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64"}
TIMES |= {"index": "int64", "task_index": "int64"}
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def lerobot_name(key: str, image: bool) -> str:
    """Return LeRobot's name of an observation."""
    return f"{OBSERVATION}.images.{key}" if image else f"{OBSERVATION}.{key}"


def write_lerobot(demos: Demonstrations, out: Path, rate: float, *, lossless: bool) -> None:
    """Write demonstrations as a LeRobotDataset v3.

    Args:
        demos: the demonstrations.
        out: the folder, which exists and is empty.
        rate: timesteps in a second.
        lossless: store images as PNG in the tables in place of videos.

    Raises:
        MerlError: a package is missing, the rate is no whole number, or an image does not fit a
            video.
    """
    require("pyarrow", "LeRobotDataset")
    _Writer(demos, out, rate, lossless).write()


class _Writer:
    def __init__(self, demos: Demonstrations, out: Path, rate: float, lossless: bool) -> None:
        if rate != int(rate):
            raise MerlError(
                f"LeRobotDataset needs a whole number of frames per second, not {rate:g}: give it "
                "with --rate"
            )
        self.demos, self.out, self.rate, self.lossless = demos, out, int(rate), lossless
        self.keys: dict[str, str] = {}
        self.features: dict[str, dict[str, Any]] = {}
        for key, space in demos.observation_space.spaces.items():
            shape = space.shape or ()
            image = space.dtype == np.uint8 and len(shape) == 3
            self.keys[key] = name = lerobot_name(key, image)
            if not image:
                self.features[name] = _numbers(str(space.dtype), shape or (1,))
                continue
            if shape[2] != 3:
                raise MerlError(f"LeRobotDataset holds RGB images, and {key!r} is {shape}")
            if not lossless and (shape[0] % 2 or shape[1] % 2):
                raise MerlError(
                    f"a video needs an even height and width, and {key!r} is {shape}: use "
                    "--lossless, which stores PNG"
                )
            self.features[name] = {
                "dtype": "image" if lossless else "video",
                "shape": list(shape),
                "names": ["height", "width", "channels"],
            }
            if not lossless:
                self.features[name]["info"] = self._video_info(shape)
        size = demos.action_space.shape[0]
        own = {ACTION: ("float32", (size,)), INTENDED: ("float32", (size,))}
        own |= {REWARD: ("float32", (1,))}
        # Without the feature, success is not known.
        self.knows = all(line.success is not None for line in demos.lines)
        flags = (DONE, SUCCESS, TERMINATED) if self.knows else (DONE, TERMINATED)
        own |= dict.fromkeys(flags, ("bool", (1,)))
        own |= {name: (kind, (1,)) for name, kind in TIMES.items()}
        self.features |= {name: _numbers(*value) for name, value in own.items()}
        self.videos = [k for k, name in self.keys.items() if self._kind(name) == "video"]

    def write(self) -> None:
        from pyarrow import parquet

        rows: list[dict[str, Any]] = []
        statistics: dict[str, list[NDArray[Any]]] = {}  # of images: counts of each pixel value
        first, schema = 0, self._schema()
        tables: Any = None
        streams: dict[str, VideoFile] = {}
        for index, episode in enumerate(self.demos.episodes()):
            file, chunk = index // EPISODES_PER_FILE % CHUNK, index // EPISODES_PER_FILE // CHUNK
            if index % EPISODES_PER_FILE == 0:
                _close(tables, streams)
                path = self._path(DATA, chunk_index=chunk, file_index=file)
                tables = parquet.ParquetWriter(path, schema, compression="snappy")
                streams = {
                    key: VideoFile(
                        self._path(
                            VIDEO, chunk_index=chunk, file_index=file, video_key=self.keys[key]
                        ),
                        self.rate,
                    )
                    for key in self.videos
                }
            values = self._values(episode, index, first)
            tables.write_table(self._table(values, schema))
            row: dict[str, Any] = {
                "episode_index": index,
                "tasks": [self.demos.task],
                "length": len(episode),
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": first,
                "dataset_to_index": first + len(episode),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for key in self.videos:
                begin = streams[key].seconds
                for frame in values[self.keys[key]]:
                    streams[key].add(frame)
                name = f"videos/{self.keys[key]}"
                row |= {f"{name}/chunk_index": chunk, f"{name}/file_index": file}
                row |= {f"{name}/from_timestamp": begin}
                row |= {f"{name}/to_timestamp": streams[key].seconds}
            rows.append(row)
            for name, value in values.items():
                if self._kind(name) not in ("image", "video"):
                    statistics.setdefault(name, []).append(value.reshape(len(value), -1))
                    continue
                counts = np.stack(
                    [np.bincount(v.ravel(), minlength=256) for v in np.rollaxis(value, 3)]
                )
                statistics[name] = [counts + (statistics[name][0] if name in statistics else 0)]
            first += len(episode)
        _close(tables, streams)
        self._write_index(rows, first, statistics)

    def _write_index(
        self, rows: list[dict[str, Any]], frames: int, values: Mapping[str, list[NDArray[Any]]]
    ) -> None:
        import pyarrow
        from pyarrow import parquet

        parquet.write_table(pyarrow.Table.from_pylist(rows), self._path(EPISODES))
        tasks = pyarrow.table({"task_index": [0], "task": [self.demos.task]})
        # LeRobot looks a task up by its name, the index of a pandas table.
        told = {
            "index_columns": ["task"],
            "column_indexes": [],
            "columns": [
                _pandas("task_index", "int64", "int64"),
                _pandas("task", "unicode", "object"),
            ],
            "pandas_version": "2.0.0",
        }
        tasks = tasks.replace_schema_metadata({"pandas": json.dumps(told)})
        parquet.write_table(tasks, self._path("meta/tasks.parquet"))
        info = {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": len(rows),
            "total_frames": frames,
            "total_tasks": 1,
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.rate,
            "splits": {"train": f"0:{len(rows)}"},
            "data_path": DATA,
            "video_path": VIDEO if self.videos else None,
            "features": self.features,
        }
        self._path(INFO).write_text(json.dumps(info, indent=4) + "\n")
        statistics: dict[str, Any] = {}
        for name, parts in values.items():
            found: dict[str, Any]
            if self._kind(name) in ("image", "video"):
                channels = [_statistics_of_counts(counts) for counts in parts[0]]
                found = {key: [[[each[key]]] for each in channels] for key in channels[0]}
            else:
                found = _statistics(np.concatenate(parts).astype(np.float64))
            statistics[name] = found | {"count": [frames]}
        self._path("meta/stats.json").write_text(json.dumps(statistics, indent=4) + "\n")

    def _values(self, episode: Episode, index: int, first: int) -> dict[str, NDArray[Any]]:
        """Return the value of each feature at each timestep."""
        steps = len(episode)
        last = np.arange(steps) == steps - 1
        values = {name: episode.observations[key][:steps] for key, name in self.keys.items()}
        values |= {ACTION: episode.actions, INTENDED: episode.intended, REWARD: episode.rewards}
        values |= {DONE: last, TERMINATED: last & episode.terminated}
        if self.knows:
            known = episode.successes
            values[SUCCESS] = last & bool(episode.success) if known is None else known
        numbers = np.arange(steps)
        values |= {
            "timestamp": numbers / self.rate,
            "frame_index": numbers,
            "episode_index": np.full(steps, index),
            "index": first + numbers,
            "task_index": np.zeros(steps),
        }
        return values

    def _table(self, values: Mapping[str, NDArray[Any]], schema: Any) -> Any:
        import pyarrow

        columns = []
        for field in schema:
            value = values[field.name]
            if self._kind(field.name) == "image":
                rows: list[Any] = [{"bytes": png(frame), "path": None} for frame in value]
            else:
                shape = tuple(self.features[field.name]["shape"])
                rows = list(value.reshape(len(value), *(() if shape == (1,) else shape)))
                rows = [row.tolist() for row in rows]
            columns.append(pyarrow.array(rows, field.type))
        return pyarrow.Table.from_arrays(columns, schema=schema)

    def _schema(self) -> Any:
        import pyarrow

        fields = []
        for name, feature in self.features.items():
            kind, shape = feature["dtype"], feature["shape"]
            if kind == "video":
                continue
            if kind == "image":
                told = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
            else:
                told = pyarrow.from_numpy_dtype(np.dtype(kind))
                if len(shape) == 1 and shape != [1]:
                    told = pyarrow.list_(told, shape[0])
                elif len(shape) > 1:
                    for _ in shape:
                        told = pyarrow.list_(told)
            fields.append((name, told))
        return pyarrow.schema(fields)

    def _kind(self, name: str) -> str:
        return str(self.features[name]["dtype"])

    def _path(self, pattern: str, **values: Any) -> Path:
        path = self.out / pattern.format(**values)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _video_info(self, shape: tuple[int, ...]) -> dict[str, Any]:
        return {
            "video.height": shape[0],
            "video.width": shape[1],
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": self.rate,
            "video.channels": shape[2],
            "has_audio": False,
        }


def _close(tables: Any, videos: Mapping[str, VideoFile]) -> None:
    if tables is not None:
        tables.close()
    for video in videos.values():
        video.close()


def _pandas(name: str, kind: str, numpy: str) -> dict[str, Any]:
    """Return how pandas describes a column."""
    return {
        "name": name,
        "field_name": name,
        "pandas_type": kind,
        "numpy_type": numpy,
        "metadata": None,
    }


def _numbers(kind: str, shape: tuple[int, ...]) -> dict[str, Any]:
    return {"dtype": kind, "shape": list(shape), "names": None}


def _statistics(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Return the statistics by which LeRobot normalises, of (N, size)."""
    found = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0)}
    found |= {"std": values.std(0)}
    found |= {name: np.quantile(values, share, axis=0) for name, share in QUANTILES.items()}
    return {name: value.tolist() for name, value in found.items()}


def _statistics_of_counts(counts: NDArray[Any]) -> dict[str, float]:
    """Return the statistics of pixels in [0, 1], from the counts of their 256 values."""
    values, total = np.arange(256) / 255.0, counts.sum()
    present, shares = np.flatnonzero(counts), np.cumsum(counts) / total
    mean = float((values * counts).sum() / total)
    found = {"min": float(values[present[0]]), "max": float(values[present[-1]]), "mean": mean}
    found["std"] = float(np.sqrt((counts * (values - mean) ** 2).sum() / total))
    return found | {
        name: float(values[np.searchsorted(shares, share)]) for name, share in QUANTILES.items()
    }
