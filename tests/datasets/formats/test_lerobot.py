"""Tests LeRobot's layout: features, frames, tables and statistics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import SMALL

from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.formats.lerobot import describe_task
from vkc_pin.datasets.formats.samples import sample_episode
from vkc_pin.datasets.generation import generate
from vkc_pin.errors import InputError

pytest.importorskip("h5py")
pq = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def root(dataset: Dataset) -> Path:
    return dataset.folder / "lerobot" / "husky_ur5e"


def load_info(root: Path) -> Any:
    return json.loads((root / "meta/info.json").read_text())


def test_info_describes_the_features(root: Path) -> None:
    info = load_info(root)
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["fps"], info["robot_type"]) == (4, 10, "husky_ur5e")
    assert info["splits"] == {"train": "0:4"}
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        dtype = "float32" if name == "timestamp" else "int64"
        assert info["features"][name] == {"dtype": dtype, "shape": [1], "names": None}
    for name in ("observation.state", "action"):
        assert info["features"][name]["shape"] == [len(info["features"][name]["names"])]


def test_frames_are_samples_of_episodes(dataset: Dataset, root: Path) -> None:
    info = load_info(root)
    table = pq.read_table(root / info["data_path"].format(chunk_index=0, file_index=0))
    assert table.column_names == list(info["features"])
    assert len(table) == info["total_frames"]
    assert table["index"].to_pylist() == list(range(len(table)))
    state = np.array(table["observation.state"].to_pylist())
    first = 0
    for number, episode in enumerate(dataset.episodes()):
        found = sample_episode(episode, episode.scene().robot, info["fps"])
        count = len(found["time"])
        rows = slice(first, first + count)
        assert set(table["episode_index"].to_pylist()[rows]) == {number}
        assert table["frame_index"].to_pylist()[rows] == list(range(count))
        times = np.array(table["timestamp"].to_pylist()[rows])
        assert np.allclose(times * info["fps"], np.arange(count), atol=1e-4)
        assert np.allclose(state[rows, :3], found["base_pose"], atol=1e-6)
        assert np.allclose(np.array(table["action"].to_pylist())[rows], found["actions"], atol=1e-6)
        first += count
    assert first == len(table)
    # one per episode
    assert pq.ParquetFile(root / "data/chunk-000/file-000.parquet").num_row_groups == 4


def test_episode_and_task_tables_are_consistent(dataset: Dataset, root: Path) -> None:
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["episode_index"] for row in rows] == [0, 1, 2, 3]
    ends = [row["dataset_to_index"] for row in rows]
    assert [row["dataset_from_index"] for row in rows] == [0, *ends[:-1]]
    assert ends[-1] == load_info(root)["total_frames"]
    assert np.cumsum([row["length"] for row in rows]).tolist() == ends
    assert {"data/chunk_index", "data/file_index", "meta/episodes/chunk_index"} <= set(rows[0])
    assert "stats/action/mean" in rows[0]
    tasks = pq.read_table(root / "meta/tasks.parquet").to_pydict()
    indices = dict(zip(tasks["task"], tasks["task_index"], strict=True))
    described = [[describe_task(episode.about)] for episode in dataset.episodes()]
    assert [row["tasks"] for row in rows] == described
    assert sorted(indices.values()) == list(range(len(indices)))


def test_statistics_cover_all_frames(root: Path) -> None:
    stats = json.loads((root / "meta/stats.json").read_text())
    table = pq.read_table(root / "data/chunk-000/file-000.parquet")
    assert set(stats) == set(table.column_names)
    values = np.array(table["observation.velocity"].to_pylist(), float)
    found = stats["observation.velocity"]
    for name in ("mean", "std", "min", "max"):
        assert np.allclose(found[name], getattr(values, name)(axis=0), atol=1e-7)
    assert found["count"] == [len(values)]


FRACTIONS = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def estimate_quantile(column: np.ndarray, fraction: float) -> float:
    """Return LeRobot's estimate: where a histogram of 5000 bins reaches the fraction."""
    counts, edges = np.histogram(column, np.linspace(column.min(), column.max() + 1e-10, 5001))
    below = 0.0
    for count, low, high in zip(counts, edges, edges[1:], strict=False):
        if below + count >= fraction * len(column):
            part = (fraction * len(column) - below) / count
            return float(low + part * (high - low))
        below += count
    return float(column.max())


def test_every_episode_has_quantiles(root: Path) -> None:
    """Policies that normalise by quantiles refuse datasets without, and so do resumed recordings.

    LeRobot writes them in this order; its bins have a width of 1/5000 of the range.
    """
    table = pq.read_table(root / "data/chunk-000/file-000.parquet")
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    order = ["min", "max", "mean", "std", "count", *FRACTIONS]
    episodes = np.array(table["episode_index"].to_pylist())
    for name in table.column_names:
        values = np.array(table[name].to_pylist(), float).reshape(len(table), -1)
        found = [key for key in rows[0] if key.startswith(f"stats/{name}/")]
        assert found == [f"stats/{name}/{key}" for key in order]
        for number, row in enumerate(rows):
            own = values[episodes == number]
            bins = np.ptp(own, axis=0) / 5000.0 + 1e-7
            for key, fraction in FRACTIONS.items():
                stored = np.array(row[f"stats/{name}/{key}"])
                expected = [estimate_quantile(column, fraction) for column in own.T]
                assert (np.abs(stored - expected) <= 2.0 * bins).all(), (name, number, key)
                # The estimate is between the two samples next to that fraction.
                for method, sign in (("lower", 1.0), ("higher", -1.0)):
                    count = len(own)
                    low = max(fraction - 1.0 / count, 0.0) if sign > 0 else fraction + 1.0 / count
                    bound = np.quantile(own, min(low, 1.0), axis=0, method=method)
                    assert (sign * (stored - bound) >= -2.0 * bins).all(), (name, number, key)


def test_quantiles_of_all_episodes_are_means_by_their_lengths(root: Path) -> None:
    """This is how LeRobot merges them when an episode is added."""
    stats = json.loads((root / "meta/stats.json").read_text())
    rows = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    lengths = [row["length"] for row in rows]
    for name, own in stats.items():
        for key in FRACTIONS:
            parts = [row[f"stats/{name}/{key}"] for row in rows]
            expected = np.average(parts, axis=0, weights=lengths)
            np.testing.assert_allclose(own[key], expected, atol=1e-12)


def test_columns_are_described_for_readers_of_parquet(root: Path) -> None:
    """The package `datasets` reads features from the schema, as of files that LeRobot writes."""
    info = load_info(root)
    schema = pq.read_schema(root / "data/chunk-000/file-000.parquet")
    features = json.loads(schema.metadata[b"huggingface"])["info"]["features"]
    assert list(features) == schema.names
    number = {"dtype": "float32", "_type": "Value"}
    size = info["features"]["action"]["shape"][0]
    assert features["action"] == {"feature": number, "length": size, "_type": "List"}
    assert features["index"] == {"dtype": "int64", "_type": "Value"}


def test_rate_must_be_a_whole_number(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="whole numbers of frames"):
        generate({**SMALL, "rate": 12.5}, 1, tmp_path / "out", lerobot=True)
    assert not (tmp_path / "out").exists()  # the error must precede planning
