"""Writes datasets in LeRobot's layout 3.0.

The layout is documented in huggingface/lerobot, src/lerobot/datasets. Each robot gets a dataset,
since features have one shape. Images are PNG files in the parquet files; there are no videos.
"""

from __future__ import annotations

import io
import itertools
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.datasets.episode import Episode
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.documents import parse_json, read_text
from vkc_pin.world.files.writing import MANIFEST, write_folder_atomically
from vkc_pin.world.models.robot import Robot

VERSION = "v3.0"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
# files of a folder
_CHUNK = 1000
# [MB] of a file; files are cut before they get there
_SIZE = 100
# frames of a file
_ROWS = 200_000
# bytes of images in a file, after which the next one is begun
_IMAGES = 90_000_000
# of numbers made on another machine, relative and absolute
_TOLERANCE = 1e-5
# metadata of the package `datasets` in the schema of a Parquet file
_SCHEMA_KEY = "huggingface"
# end of the names of pictures that are stored; depths and segments are not
_IMAGE_SUFFIX = "_image"
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
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
# bins of the histograms for quantiles, as in LeRobot
_BINS = 5000
# beyond the smallest and the largest value, as in LeRobot
_PADDING = 1e-10


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
    name = str(about["kind"]).replace("_", " ")
    if about["task"] == "fetch-place":
        return f"Bring the {name} from one table to another."
    return f"Open the {name}."


def write_lerobot(path: Path, episodes: Iterator[Episode], rate: float) -> Path:
    """Write episodes of one robot atomically to a folder, which is replaced; return it.

    `observation.state` is base pose, arm and gripper, `observation.velocity` base and arm velocity,
    `observation.environment_state` hand pose and whether an object is grasped, `action` the next
    state, and `observation.images.<camera>` an image.

    Args:
        path: Folder.
        episodes: Episodes, in order; at least one.
        rate: Frames per second, a whole number.
    """
    arrow = require_pyarrow(rate)
    with write_folder_atomically(path, force=True) as folder:
        _Writer(arrow, folder, rate).run(episodes)
    return path


def find_differences(path: Path, episodes: Iterator[Episode], rate: float) -> list[str]:
    """Return differences of a folder to what `write_lerobot` writes, one per line.

    Args:
        path: Folder.
        episodes: Its episodes, in order; at least one.
        rate: Frames per second, a whole number.

    Raises:
        InputError: A file is missing or damaged, or has other columns or sizes.
    """
    comparison = _Comparison(require_pyarrow(rate), path, rate)
    comparison.run(episodes)
    known = {*comparison.files, path / MANIFEST}
    others = sorted(file for file in path.rglob("*") if not file.is_dir() and file not in known)
    return comparison.found + [f"{file.relative_to(path)}: an unknown file" for file in others]


class _Writer:
    """Writes frames as they come, and tables and statistics at the end."""

    def __init__(self, arrow: Any, folder: Path, rate: float) -> None:
        self.arrow = arrow
        self.folder = folder
        self.rate = int(rate)

    def run(self, episodes: Iterator[Episode]) -> None:
        """Write all episodes."""
        first = next(episodes)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown during generation
            self._begin(first.scene().robot)
        for episode in itertools.chain([first], episodes):
            self.add(episode)
        self._close()

    def _write_tables(self, path: Path, tables: Sequence[Any]) -> None:
        """Write tables as the row groups of a file."""
        path.parent.mkdir(parents=True, exist_ok=True)
        parquet = self.arrow.parquet
        with parquet.ParquetWriter(path, tables[0].schema, compression="snappy") as writer:
            for table in tables:
                writer.write_table(table)

    def _write_json(self, path: Path, content: Any) -> None:
        path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")

    def _begin(self, robot: Robot) -> None:
        self.robot = robot
        joints = list(robot.coordinates.names)
        names = {
            "observation.state": [*joints, "gripper"],
            "observation.velocity": joints,
            "observation.environment_state": [*_HAND, "holding"],
            "action": [*joints, "gripper"],
        }
        self.features: dict[str, dict[str, Any]] = {}
        for name, own in names.items():
            self.features[name] = {"dtype": "float32", "shape": [len(own)], "names": own}
        for name, kind in _KINDS.items():
            self.features[name] = {"dtype": kind, "shape": [1], "names": None}
        self.tasks: dict[str, int] = {}
        self.rows: list[dict[str, Any]] = []
        self.stats: list[dict[str, dict[str, Floats]]] = []
        self.frame_count = 0
        self.file_count = 0  # files with frames
        self._pending: list[dict[str, Any]] = []  # columns of episodes, for the next file
        self._pending_frames = 0
        self._pending_bytes = 0  # of images

    def add(self, episode: Episode) -> None:
        """Add an episode."""
        number = len(self.rows)
        task = describe_task(episode.about)
        samples = sample_episode(episode, self.robot, self.rate)
        count = len(samples["time"])
        columns: dict[str, Any] = {}
        for name, parts in _COLUMNS.items():
            columns[name] = np.hstack([samples[part] for part in parts]).astype(np.float32)
        columns["timestamp"] = (np.arange(count) / self.rate).astype(np.float32)
        columns["frame_index"] = np.arange(count)
        columns["episode_index"] = np.full(count, number)
        columns["index"] = np.arange(self.frame_count, self.frame_count + count)
        columns["task_index"] = np.full(count, self.tasks.setdefault(task, len(self.tasks)))
        stats = {name: _describe_rows(values) for name, values in columns.items()}
        byte_count = 0
        for name, pixels in _iterate_images(episode):
            shape = list(pixels.shape[1:])
            axes = ["height", "width", "channels"]
            self.features[name] = {"dtype": "image", "shape": shape, "names": axes}
            stats[name] = _describe_images(pixels)
            files = [_encode_png(image) for image in pixels]
            columns[name] = [
                {"bytes": file, "path": f"frame-{k:06d}.png"} for k, file in enumerate(files)
            ]
            byte_count += sum(len(file) for file in files)
        has_many_frames = self._pending_frames + count > _ROWS
        has_many_bytes = self._pending_bytes + byte_count > _IMAGES
        if self._pending_frames and (has_many_frames or has_many_bytes):
            self._flush()
        row = {
            "episode_index": number,
            "tasks": [task],
            "length": count,
            "data/chunk_index": self.file_count // _CHUNK,
            "data/file_index": self.file_count % _CHUNK,
            "dataset_from_index": self.frame_count,
            "dataset_to_index": self.frame_count + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for name, own in stats.items():
            for key, value in own.items():
                row[f"stats/{name}/{key}"] = value.tolist()
        self.rows.append(row)
        self.stats.append(stats)
        self._pending.append(columns)
        self._pending_frames += count
        self._pending_bytes += byte_count
        self.frame_count += count

    def _flush(self) -> None:
        """Write pending frames to a file with one row group per episode."""
        arrow = self.arrow
        fields = [(name, self._choose_type(feature)) for name, feature in self.features.items()]
        described = {"info": {"features": self._describe_features()}}
        schema = arrow.schema(fields, metadata={_SCHEMA_KEY: json.dumps(described)})
        tables: list[Any] = []
        for columns in self._pending:
            arrays = [self._make_array(columns[name], kind) for name, kind in fields]
            tables.append(arrow.Table.from_arrays(arrays, schema=schema))
        path = _DATA.format(
            chunk_index=self.file_count // _CHUNK, file_index=self.file_count % _CHUNK
        )
        self._write_tables(self.folder / path, tables)
        self.file_count += 1
        self._pending = []
        self._pending_frames = 0
        self._pending_bytes = 0

    def _choose_type(self, feature: Mapping[str, Any]) -> Any:
        """Return the type of a feature in Parquet files."""
        arrow = self.arrow
        if feature["dtype"] == "image":
            return arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
        kind = arrow.float32() if feature["dtype"] == "float32" else arrow.int64()
        if feature["shape"] == [1]:
            return kind
        return arrow.list_(kind, feature["shape"][0])

    def _make_array(self, values: Any, kind: Any) -> Any:
        """Return a column for Parquet files from numbers, shape (N,) or (N, n), or images."""
        arrow = self.arrow
        if isinstance(values, list):
            return arrow.array(values, kind)
        flat = arrow.array(values.reshape(-1))
        if values.ndim == 1:
            return flat
        return arrow.FixedSizeListArray.from_arrays(flat, type=kind)

    def _describe_features(self) -> dict[str, Any]:
        """Describe the columns as the package `datasets` does: readers then decode images."""
        found: dict[str, Any] = {}
        for name, feature in self.features.items():
            value = {"dtype": feature["dtype"], "_type": "Value"}
            if feature["dtype"] == "image":
                found[name] = {"_type": "Image"}
            elif feature["shape"] == [1]:
                found[name] = value
            else:
                found[name] = {"feature": value, "length": feature["shape"][0], "_type": "List"}
        return found

    def _close(self) -> None:
        """Write pending frames, tables and statistics."""
        arrow = self.arrow
        meta = self.folder / "meta"
        if self._pending:
            self._flush()
        path = self.folder / _EPISODES.format(chunk_index=0, file_index=0)
        self._write_tables(path, [arrow.Table.from_pylist(self.rows)])
        columns = {
            "task_index": arrow.array(list(self.tasks.values()), arrow.int64()),
            "task": arrow.array(list(self.tasks)),
        }
        table = arrow.table(columns).replace_schema_metadata({"pandas": json.dumps(_PANDAS)})
        self._write_tables(meta / "tasks.parquet", [table])
        info = {
            "codebase_version": VERSION,
            "robot_type": self.robot.name,
            "total_episodes": len(self.rows),
            "total_frames": self.frame_count,
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
        stats: dict[str, dict[str, list[float]]] = {}
        for name in self.features:
            stats[name] = _merge_statistics([own[name] for own in self.stats])
        self._write_json(meta / "info.json", info)
        self._write_json(meta / "stats.json", stats)


class _Comparison(_Writer):
    """Compares files with what would be written.

    Older datasets have no quantiles, and no description of their columns.

    Attributes:
        found: Differences.
        files: All files.
    """

    def __init__(self, arrow: Any, folder: Path, rate: float) -> None:
        super().__init__(arrow, folder, rate)
        self.found: list[str] = []
        self.files: list[Path] = []

    def _write_json(self, path: Path, content: Any) -> None:
        self.files.append(path)
        stored = parse_json(read_text(path, "JSON"), path)
        if path.name == "stats.json" and not _has_quantiles(stored):
            content = {name: _drop_quantiles(own) for name, own in content.items()}
        self._compare(path, "", stored, content)

    def _write_tables(self, path: Path, tables: Sequence[Any]) -> None:
        self.files.append(path)
        if not path.is_file() or path.is_symlink():
            raise InputError("there is no such file", file=path, expected="a file of the dataset")
        try:
            with self.arrow.parquet.ParquetFile(path) as file:
                self._compare_tables(path, file, tables)
        except (self.arrow.ArrowException, OSError, MemoryError) as error:
            raise InputError(
                "not a Parquet file, or a damaged one",
                file=path,
                expected="a file of the dataset",
                got=str(error),
            ) from error

    def _compare_tables(self, path: Path, file: Any, tables: Sequence[Any]) -> None:
        """Compare the row groups of a Parquet file with tables."""
        groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
        sizes = [table.num_rows for table in tables]
        names = file.schema_arrow.names
        if not any(_is_quantile(name) for name in names):
            kept = [name for name in tables[0].column_names if not _is_quantile(name)]
            tables = [table.select(kept) for table in tables]
        schema = tables[0].schema
        if groups != sizes or not file.schema_arrow.equals(schema):
            raise InputError(
                "other columns or sizes",
                file=path,
                expected=f"row groups of {sizes} with {schema.names}",
                got=f"{groups[:100]} with {names[:100]}",
            )
        self._compare_descriptions(path, file.schema_arrow, schema)
        for k, table in enumerate(tables):
            stored = file.read_row_group(k)
            for name in table.column_names:
                column = stored[name]
                truth = table[name]
                if column.equals(truth):
                    continue
                statistics = table.to_pydict() if _is_quantile(name) else {}
                tolerance = _choose_tolerance(name, statistics)
                where = f"row group {k}: {name}"
                self._compare(path, where, column.to_pylist(), truth.to_pylist(), tolerance)

    def _compare_descriptions(self, path: Path, stored: Any, truth: Any) -> None:
        """Compare the descriptions of columns in the schemas of a file, if both have one."""
        key = _SCHEMA_KEY.encode()
        stored_metadata = stored.metadata or {}
        true_metadata = truth.metadata or {}
        if key in stored_metadata and key in true_metadata:
            described = parse_json(stored_metadata[key].decode(errors="replace"), path)
            expected = parse_json(true_metadata[key].decode(errors="replace"), path)
            self._compare(path, _SCHEMA_KEY, described, expected)

    def _compare(
        self, path: Path, where: str, stored: Any, truth: Any, tolerance: float = _TOLERANCE
    ) -> None:
        """Record the first difference of plain data, numbers up to a tolerance."""
        difference = _find_difference(stored, truth, tolerance)
        if difference:
            name = str(path.relative_to(self.folder))
            parts = [name, where, difference] if where else [name, difference]
            self.found.append(": ".join(parts))


def _has_quantiles(stored: Any) -> bool:
    """Return whether the content of stats.json has a quantile of any feature."""
    if not isinstance(stored, dict):
        return False
    features = [own for own in stored.values() if isinstance(own, dict)]
    return any(not _QUANTILES.keys().isdisjoint(own) for own in features)


def _drop_quantiles(statistics: Mapping[str, Any]) -> dict[str, Any]:
    """Return statistics without quantiles."""
    return {key: value for key, value in statistics.items() if key not in _QUANTILES}


def _choose_tolerance(name: str, statistics: Mapping[str, Any]) -> float:
    """Return the tolerance of a column or field, given those beside it by name.

    A value that is rounded differently may be in the next bin of the histogram for quantiles.
    """
    if not _is_quantile(name):
        return _TOLERANCE
    begin = name.removesuffix(name.rpartition("/")[2])
    span = np.array(statistics[f"{begin}max"]) - np.array(statistics[f"{begin}min"])
    return _TOLERANCE + 2.0 / _BINS * float(np.max(span))


def _find_difference(stored: Any, truth: Any, tolerance: float = _TOLERANCE) -> str:
    """Return the first difference of plain data as text; none: an empty one."""
    if isinstance(truth, dict) and isinstance(stored, dict):
        if set(stored) != set(truth):
            return f"the fields {format_value(list(stored))}, not {format_value(list(truth))}"
        for name, value in truth.items():
            difference = _find_difference(stored[name], value, _choose_tolerance(name, truth))
            if difference:
                return difference
        return ""
    if isinstance(truth, list) and isinstance(stored, list):
        if len(stored) != len(truth):
            return f"{len(stored)} entries, not {len(truth)}"
        for stored_value, value in zip(stored, truth, strict=True):
            difference = _find_difference(stored_value, value, tolerance)
            if difference:
                return difference
        return ""
    if _agrees(stored, truth, tolerance):
        return ""
    return f"{format_value(stored)}, not {truth!r:.300}"


def _agrees(stored: Any, truth: Any, tolerance: float) -> bool:
    """Return whether two values agree, numbers up to a tolerance, and images pixel by pixel."""
    if isinstance(truth, bytes) and isinstance(stored, bytes):
        return stored == truth or _decode(stored, truth) == _decode(truth, truth)
    if isinstance(truth, float) and isinstance(stored, float):
        return bool(np.isclose(stored, truth, rtol=_TOLERANCE, atol=tolerance))
    return bool(type(stored) is type(truth) and stored == truth)


def _decode(image: bytes, like: bytes) -> bytes:
    """Return the pixels of a PNG file, if it has the size of another one."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(image), formats=["PNG"]) as shown:
            if shown.size != Image.open(io.BytesIO(like)).size or shown.mode != "RGB":
                return b""
            return shown.tobytes()
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # no image
        return b""


def _iterate_images(episode: Episode) -> Iterator[tuple[str, Any]]:
    """Yield the feature name and images of each camera, shape (N, height, width, 3)."""
    images = episode.images()
    if images is None:
        return
    for name, pixels in images.pictures.items():
        if name.endswith(_IMAGE_SUFFIX):
            yield f"observation.images.{name.removesuffix(_IMAGE_SUFFIX)}", pixels


def _encode_png(pixels: Any) -> bytes:
    """Return an image as a PNG file."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG", compress_level=4)
    return buffer.getvalue()


def _describe_rows(rows: Any) -> dict[str, Floats]:
    """Return the statistics of every column, and the number of rows, (N, n) or (N,)."""
    columns = rows.reshape(len(rows), -1).T
    weights = np.ones(len(rows))
    return _collect([_describe_values(column, weights) for column in columns], len(rows))


def _describe_images(pixels: Any) -> dict[str, Floats]:
    """Return the statistics of every colour from 0 to 1, and the number of images.

    Args:
        pixels: Images, shape (N, height, width, 3).
    """
    colours: list[dict[str, float]] = []
    for colour in np.moveaxis(pixels, -1, 0):
        weights = np.bincount(colour.ravel(), minlength=256)
        levels = np.flatnonzero(weights).astype(np.uint8)
        colours.append(_describe_values(levels, weights[levels]))
    found = _collect(colours, len(pixels))
    scaled = {name: value.reshape(-1, 1, 1) / 255.0 for name, value in found.items()}
    scaled["count"] = found["count"]
    return scaled


def _collect(columns: Sequence[Mapping[str, float]], count: int) -> dict[str, Floats]:
    """Return name → values of all columns, in the order of LeRobot's tables."""
    found: dict[str, Floats] = {}
    quantiles: dict[str, Floats] = {}
    for name in columns[0]:
        values = np.array([column[name] for column in columns])
        if name in _QUANTILES:
            quantiles[name] = values
        else:
            found[name] = values
    found["count"] = np.array([count])
    found.update(quantiles)
    return found


def _describe_values(values: Any, weights: Any) -> dict[str, float]:
    """Return the statistics of values with their numbers of occurrences.

    Quantiles are those of LeRobot's `compute_stats.py`: of a histogram of 5000 bins, within each of
    which values are evenly distributed, in single precision if the values are.
    """
    exact = values.astype(float)
    mean = np.average(exact, weights=weights)
    found = {
        "min": exact.min(),
        "max": exact.max(),
        "mean": mean,
        "std": np.sqrt(np.average((exact - mean) ** 2, weights=weights)),
    }
    coarse = values.astype(np.result_type(values.dtype, np.float32))
    edges = np.linspace(coarse.min() - _PADDING, coarse.max() + _PADDING, _BINS + 1)
    counts, _ = np.histogram(coarse, bins=edges, weights=weights)
    sums = np.cumsum(counts)
    for name, fraction in _QUANTILES.items():
        target = fraction * sums[-1]
        k = int(np.searchsorted(sums, target))
        # LeRobot takes the lower edge if the value is in the first bin.
        part = (target - sums[k] + counts[k]) / counts[k] if k > 0 else 0.0
        found[name] = edges[k] + part * (edges[k + 1] - edges[k])
    return found


def _is_quantile(name: str) -> bool:
    """Return whether a column has quantiles, such as `stats/action/q50`."""
    return name.rpartition("/")[2] in _QUANTILES


_PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": "task",
            "field_name": "task",
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ],
    "pandas_version": "2.0.0",
}
"""Metadata of pandas for the table of tasks, whose texts are its index."""


def _merge_statistics(parts: list[dict[str, Floats]]) -> dict[str, list[float]]:
    """Merge the statistics of parts.

    With n_i values of mean m_i and deviation s_i in part i, and n in all, the mean is
    m = Σ n_i m_i / n and the variance Σ n_i (s_i² + (m_i − m)²) / n.
    """
    means = np.array([part["mean"] for part in parts])
    deviations = np.array([part["std"] for part in parts])
    counts = np.array([part["count"][0] for part in parts], float)
    counts = counts.reshape(-1, *([1] * (means.ndim - 1)))
    total = counts.sum()  # images of a camera have one size: frames weigh as pixels do
    mean = (means * counts).sum(axis=0) / total
    variance = ((deviations**2 + (means - mean) ** 2) * counts).sum(axis=0) / total
    merged = {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([int(total)]),
    }
    for name in _QUANTILES:  # as LeRobot merges them, since frames are not kept
        quantiles = np.array([part[name] for part in parts])
        merged[name] = (quantiles * counts).sum(axis=0) / total
    return {name: value.tolist() for name, value in merged.items()}
