"""Tests camera images in datasets, in HDF5 and in LeRobot's layout."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import SMALL
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipe import CAMERAS, load_recipe
from vkc_pin.simulation import snapshots

h5py = pytest.importorskip("h5py")
pq = pytest.importorskip("pyarrow.parquet")
SMALL_CAMERAS: list[dict[str, Any]] = [{**camera, "width": 40, "height": 32} for camera in CAMERAS]
RECIPE = {**SMALL, "simulate": True, "cameras": SMALL_CAMERAS, "rate": 5}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    try:
        with snapshots.open_gl_context((8, 8)):
            pass
    except vkc.VkcError as error:  # no OpenGL on this machine
        pytest.skip(str(error))
    return generate(RECIPE, 2, tmp_path_factory.mktemp("made") / "out", lerobot=True)


def test_every_sample_has_images(dataset: Dataset) -> None:
    with h5py.File(dataset.shards[0]) as file:
        for group in file["data"].values():
            count = group.attrs["num_samples"]
            for camera in ("head", "wrist"):
                assert group[f"obs/{camera}_image"].shape == (count, 32, 40, 3)
                for kind in ("depth", "segmentation"):
                    assert group[f"obs/{camera}_{kind}"].shape == (count, 32, 40)
                    assert group[f"obs/{camera}_{kind}"].chunks == (1, 32, 40)
                assert group[f"obs/{camera}_image"][0].std() > 5.0


def test_images_are_read_back(dataset: Dataset) -> None:
    for episode in dataset.episodes():
        images = episode.images()
        assert images is not None
        visible = {images.segments[k] for k in np.unique(images.pictures["wrist_segmentation"])}
        # the wrist camera sees the grasped object
        assert any(name.startswith(f"{episode.about['object']}.") for name in visible)


@pytest.mark.long
def test_check_renders_images_again(copy: Path, shard: Path) -> None:
    """The check reports the three modified images and no others."""
    with h5py.File(shard, "r+") as file:
        demo = file["data/demo_0"]
        number, last = int(demo.attrs["number"]), len(demo["dones"]) - 1
        demo["obs/wrist_image"][0, :8] = 255 - demo["obs/wrist_image"][0, :8]
        demo["obs/head_depth"][-1, :, :10] += 500
        demo["obs/head_segmentation"][-1] = 999
    shutil.rmtree(copy / "lerobot")
    found = check_dataset(copy)
    assert not found.refused
    assert "pixels rendered again and compared: episode 0 (samples 0, " in str(found)
    names = [f"head_depth[{last}]", f"head_segmentation[{last}]", "wrist_image[0]"]
    starts = [text.partition(" differ ")[0].split(" of the pixels of ") for text in found.problems]
    assert [name for _, name in starts] == names
    assert all(start.startswith(f"episode {number}: ") for start, _ in starts)


@pytest.mark.long
def test_check_without_opengl_reports_that_pixels_are_not_compared(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "_CONTEXTS", ("no_such_context",))
    found = check_dataset(dataset.folder)
    assert found.ok, found.lines()
    assert "pixels not compared: cannot render without a display" in str(found)


def test_lerobot_layout_has_colour_images(dataset: Dataset) -> None:
    image = pytest.importorskip("PIL.Image")
    root = dataset.folder / "lerobot/husky_ur5e"
    features = json.loads((root / "meta/info.json").read_text())["features"]
    stats = json.loads((root / "meta/stats.json").read_text())
    table = pq.read_table(root / "data/chunk-000/file-000.parquet")
    for camera in ("head", "wrist"):
        name = f"observation.images.{camera}"
        assert (features[name]["dtype"], features[name]["shape"]) == ("image", [32, 40, 3])
        decoded = [image.open(io.BytesIO(entry["bytes"])) for entry in table[name].to_pylist()]
        pictures = [episode.images().pictures for episode in dataset.episodes()]  # type: ignore[union-attr]
        expected = np.concatenate([each[f"{camera}_image"] for each in pictures])
        np.testing.assert_array_equal([np.asarray(each) for each in decoded], expected)
        assert np.shape(stats[name]["mean"]) == (3, 1, 1)
        for key in ("mean", "std"):
            of_colours = getattr(expected, key)(axis=(0, 1, 2)) / 255.0
            np.testing.assert_allclose(np.ravel(stats[name][key]), of_colours, atol=1e-9)
        assert stats[name]["count"] == [len(expected)]
        for key, fraction in (("q01", 0.01), ("q50", 0.5), ("q99", 0.99)):
            per_episode = [
                np.quantile(each[f"{camera}_image"], fraction, axis=(0, 1, 2)) / 255.0
                for each in pictures
            ]
            lengths = [len(each[f"{camera}_image"]) for each in pictures]
            of_colours = np.average(per_episode, axis=0, weights=lengths)
            assert np.shape(stats[name][key]) == (3, 1, 1)
            np.testing.assert_allclose(np.ravel(stats[name][key]), of_colours, atol=1.0 / 255.0)
        described = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
        assert described[name] == {"_type": "Image"}


@pytest.mark.long
def test_cameras_that_look_see_the_attachment_more_often(tmp_path: Path) -> None:
    """The statistics state the share of samples until the grasp at which the head sees it."""
    head = {"name": "head", "frame": "base", "position": [0.3, 0, 1.2], "target": [1.5, 0, 0.9]}
    shares = []
    for look in (0.0, 0.3):
        recipe = {**RECIPE, "tasks": ["drive-open"], "cameras": [head], "look": look}
        made = generate(recipe, 3, tmp_path / f"look_{look}")
        found = check_dataset(made.folder)
        assert found.ok, found
        shares.append([record["seen"]["head"] for record in found.records])
        assert found.page is not None
        assert "cameras see the attachment" in found.page.read_text()
    assert np.mean(shares[1]) > np.mean(shares[0])


def test_nothing_looks_without_cameras() -> None:
    with expect_error(r"look.*`cameras` as well"):
        load_recipe({**SMALL, "look": 0.1})
