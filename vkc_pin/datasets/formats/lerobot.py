"""Writes datasets in LeRobot's layout 3.0.

The layout is documented in huggingface/lerobot, src/lerobot/datasets. Each robot gets a dataset,
since features have one shape. Images are PNG files in the parquet files; there are no videos.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.episode import Episode
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.models.robot import Robot

__all__ = ["VERSION", "describe_task", "require_pyarrow", "write_lerobot"]

VERSION = "v3.0"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK = 1000  # files of a folder
_SIZE = 100  # [MB] of a file; files are cut before they get there
_ROWS = 200_000  # frames of a file
_IMAGES = 90_000_000  # bytes of images in a file, after which the next one is begun
_SEEN = "_image"  # end of the names of what becomes an image
_KINDS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_HAND = ("hand_x", "hand_y", "hand_z", "hand_qx", "hand_qy", "hand_qz", "hand_qw")
_COLUMNS = {
    "observation.state": ("base_pose", "arm_position", "gripper"),
    "observation.velocity": ("base_velocity", "arm_velocity"),
    "observation.environment_state": ("hand_pose", "holding"),
    "action": ("actions",),
}
"""Feature → its parts among the samples of an episode."""


def require_pyarrow(rate: float) -> Any:
    """Return pyarrow.

    Raises:
        InputError: It is not installed, or the rate [Hz] is no whole number.
    """
    if rate != int(rate):
        raise InputError(
            "LeRobot has whole numbers of frames a second",
            field="rate",
            expected="a whole number",
            got=rate,
        )
    import_optional("pyarrow.parquet", "data", purpose="LeRobot's layout", field="lerobot")
    return import_optional("pyarrow", "data", purpose="LeRobot's layout", field="lerobot")


def describe_task(about: Mapping[str, Any]) -> str:
    """Describe an episode as an instruction for language-conditioned policies."""
    thing = str(about["kind"]).replace("_", " ")
    return (
        f"Bring the {thing} from one table to another."
        if about["task"] == "fetch-place"
        else f"Open the {thing}."
    )


def write_lerobot(path: Path, episodes: Iterable[Episode], robot: Robot, rate: float) -> Path:
    """Write episodes of one robot atomically to a folder, which is replaced; return it.

    `observation.state` is base pose, arm and gripper, `observation.velocity` base and arm velocity,
    `observation.environment_state` hand pose and whether an object is grasped, `action` the next
    state, and `observation.images.<camera>` an image.

    Args:
        path: Folder.
        episodes: Episodes, in order.
        robot: Their robot.
        rate: Frames per second, a whole number.
    """
    arrow = require_pyarrow(rate)
    with write_folder_atomically(path, force=True) as folder:
        writer = _Writer(arrow, folder, robot, rate)
        for episode in episodes:
            writer.add(episode)
        writer.close()
    return path


class _Writer:
    """Writes frames as they come, and tables and statistics at the end."""

    def __init__(self, arrow: Any, folder: Path, robot: Robot, rate: float) -> None:
        self.arrow, self.folder, self.robot, self.rate = arrow, folder, robot, int(rate)
        joints = list(robot.coordinates.names)
        names = {
            "observation.state": [*joints, "gripper"],
            "observation.velocity": joints,
            "observation.environment_state": [*_HAND, "holding"],
            "action": [*joints, "gripper"],
        }
        self.features: dict[str, dict[str, Any]] = {
            **{
                name: {"dtype": "float32", "shape": [len(own)], "names": own}
                for name, own in names.items()
            },
            **{name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _KINDS.items()},
        }
        self.tasks: dict[str, int] = {}
        self.rows: list[dict[str, Any]] = []
        self.stats: list[dict[str, dict[str, Floats]]] = []
        self.frames, self.files = 0, 0
        self._waiting: list[dict[str, Any]] = []
        self._held, self._bytes = 0, 0

    def add(self, episode: Episode) -> None:
        """Add an episode."""
        found = sample_episode(episode, self.robot, self.rate)
        count, number = len(found["time"]), len(self.rows)
        task = self.tasks.setdefault(describe_task(episode.about), len(self.tasks))
        columns: dict[str, Any] = {
            name: np.hstack([found[part] for part in parts]).astype(np.float32)
            for name, parts in _COLUMNS.items()
        }
        columns |= {
            "timestamp": (np.arange(count) / self.rate).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(self.frames, self.frames + count),
            "task_index": np.full(count, task),
        }
        stats = {name: _statistics(values) for name, values in columns.items()}
        size = 0
        for name, pixels in _pictures(episode):
            shape, axes = list(pixels.shape[1:]), ["height", "width", "channels"]
            self.features[name] = {"dtype": "image", "shape": shape, "names": axes}
            own = _statistics(pixels.reshape(-1, 3) / 255.0)
            stats[name] = {key: value.reshape(-1, 1, 1) for key, value in own.items()}
            stats[name]["count"] = np.array([count])
            columns[name] = [
                {"bytes": _png(one), "path": f"frame-{k:06d}.png"} for k, one in enumerate(pixels)
            ]
            size += sum(len(one["bytes"]) for one in columns[name])
        if self._held and (self._held + count > _ROWS or self._bytes + size > _IMAGES):
            self._flush()
        self.stats.append(stats)
        self.rows.append(
            {
                "episode_index": number,
                "tasks": [describe_task(episode.about)],
                "length": count,
                "data/chunk_index": self.files // _CHUNK,
                "data/file_index": self.files % _CHUNK,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{
                    f"stats/{name}/{key}": value.tolist()
                    for name, own in stats.items()
                    for key, value in own.items()
                },
            }
        )
        self._waiting.append(columns)
        self._held += count
        self._bytes += size
        self.frames += count

    def _flush(self) -> None:
        """Write pending frames to a file with one row group per episode."""
        arrow = self.arrow
        place = {"chunk_index": self.files // _CHUNK, "file_index": self.files % _CHUNK}
        path = self.folder / _DATA.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        fields: list[Any] = []
        for name, feature in self.features.items():
            kind = arrow.float32() if feature["dtype"] == "float32" else arrow.int64()
            if feature["dtype"] == "image":
                kind = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
            elif feature["shape"] != [1]:
                kind = arrow.list_(kind, feature["shape"][0])
            fields.append((name, kind))
        schema = arrow.schema(fields)
        with arrow.parquet.ParquetWriter(path, schema, compression="snappy") as writer:
            for columns in self._waiting:
                arrays = []
                for name, kind in fields:
                    values = columns[name]
                    if isinstance(values, list):
                        arrays.append(arrow.array(values, kind))
                        continue
                    flat = arrow.array(values.reshape(-1))
                    rows = arrow.FixedSizeListArray.from_arrays
                    arrays.append(flat if values.ndim == 1 else rows(flat, type=kind))
                writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))
        self._waiting, self._held, self._bytes, self.files = [], 0, 0, self.files + 1

    def close(self) -> None:
        """Write pending frames, tables and statistics."""
        arrow, meta = self.arrow, self.folder / "meta"
        if self._waiting:
            self._flush()
        path = self.folder / _EPISODES.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        arrow.parquet.write_table(arrow.Table.from_pylist(self.rows), path, compression="snappy")
        columns = {
            "task_index": arrow.array(list(self.tasks.values()), arrow.int64()),
            "task": arrow.array(list(self.tasks)),
        }
        table = arrow.table(columns).replace_schema_metadata({"pandas": json.dumps(_PANDAS)})
        arrow.parquet.write_table(table, meta / "tasks.parquet")
        info = {
            "codebase_version": VERSION,
            "robot_type": self.robot.name,
            "total_episodes": len(self.rows),
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": _SIZE,
            "video_files_size_in_mb": 2 * _SIZE,
            "fps": self.rate,
            "splits": {"train": f"0:{len(self.rows)}"},
            "data_path": _DATA,
            "video_path": None,
            "features": self.features,
        }
        stats = {
            name: _merge_statistics([own[name] for own in self.stats]) for name in self.features
        }
        for name, content in (("info", info), ("stats", stats)):
            text = json.dumps(content, indent=4) + "\n"
            (meta / f"{name}.json").write_text(text, encoding="utf-8")


def _pictures(episode: Episode) -> Iterator[tuple[str, Any]]:
    """Yield the feature name and images of each camera, shape (N, height, width, 3)."""
    images = episode.images()
    for name, pixels in {} if images is None else images.pictures.items():
        if name.endswith(_SEEN):
            yield f"observation.images.{name.removesuffix(_SEEN)}", pixels


def _png(pixels: Any) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()


def _statistics(values: Any) -> dict[str, Floats]:
    """Return minimum, maximum, mean and standard deviation of every column, and the row count."""
    rows = np.asarray(values, float).reshape(len(values), -1)
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
    }


_PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {
            "name": name,
            "field_name": name,
            "pandas_type": pandas_type,
            "numpy_type": numpy_type,
            "metadata": None,
        }
        for name, pandas_type, numpy_type in (
            ("task_index", "int64", "int64"),
            ("task", "unicode", "object"),
        )
    ],
    "pandas_version": "2.0.0",
}
"""Metadata of pandas for the table of tasks, whose texts are its index."""


def _merge_statistics(parts: list[dict[str, Floats]]) -> dict[str, list[float]]:
    """Merge the statistics of parts."""
    counts = np.array([part["count"][0] for part in parts], float)
    counts = counts.reshape(-1, *[1] * parts[0]["mean"].ndim)
    means, deviations = (np.array([part[name] for part in parts]) for name in ("mean", "std"))
    total = counts.sum()  # images of a camera have one size: frames weigh as pixels do
    mean = (means * counts).sum(axis=0) / total
    variance = ((deviations**2 + (means - mean) ** 2) * counts).sum(axis=0) / total
    return {
        "min": np.min([part["min"] for part in parts], axis=0).tolist(),
        "max": np.max([part["max"] for part in parts], axis=0).tolist(),
        "mean": mean.tolist(),
        "std": np.sqrt(variance).tolist(),
        "count": [int(total)],
    }
