"""Images in datasets: in HDF5 beside what else is observed, and in LeRobot's layout."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import SMALL

import vkc_pin as vkc
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipes.recipe import CAMERAS, load_recipe
from vkc_pin.simulation import snapshots

h5py = pytest.importorskip("h5py")
pq = pytest.importorskip("pyarrow.parquet")
EYES: list[dict[str, Any]] = [{**camera, "width": 40, "height": 32} for camera in CAMERAS]
SEEING = {**SMALL, "simulate": True, "cameras": EYES, "rate": 5}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    try:
        with snapshots.open_gl_context((8, 8)):
            pass
    except vkc.VkcError as error:  # no OpenGL on this machine
        pytest.skip(str(error))
    return generate(SEEING, 2, tmp_path_factory.mktemp("made") / "out", lerobot=True)


def test_every_sample_has_images(made: Dataset) -> None:
    with h5py.File(made.shards[0]) as file:
        for group in file["data"].values():
            count = group.attrs["num_samples"]
            for camera in ("head", "wrist"):
                assert group[f"obs/{camera}_image"].shape == (count, 32, 40, 3)
                for kind in ("depth", "segmentation"):
                    assert group[f"obs/{camera}_{kind}"].shape == (count, 32, 40)
                    assert group[f"obs/{camera}_{kind}"].chunks == (1, 32, 40)
                assert group[f"obs/{camera}_image"][0].std() > 5.0


def test_images_are_read_back(made: Dataset) -> None:
    for episode in made.episodes():
        images = episode.images()
        assert images is not None
        thing = {name for name in images.segments if name.startswith(f"{episode.about['object']}.")}
        seen = {images.segments[k] for k in np.unique(images.pictures["wrist_segmentation"])}
        assert seen & thing  # the hand has hold of it


def test_check_renders_images_again(made: Dataset, tmp_path: Path) -> None:
    """Of three changed images and many others that are rendered again, it names those three."""
    copy = tmp_path / "copy"
    shutil.copytree(made.folder, copy, ignore=shutil.ignore_patterns("lerobot"))
    with h5py.File(Dataset.open(copy).shards[0], "r+") as file:
        demo = file["data/demo_0"]
        number, last = int(demo.attrs["number"]), len(demo["dones"]) - 1
        demo["obs/wrist_image"][0, :8] = 255 - demo["obs/wrist_image"][0, :8]
        demo["obs/head_depth"][-1, :, :10] += 500
        demo["obs/head_segmentation"][-1] = 999
    found = check_dataset(copy)
    assert not found.refused
    assert "pixels rendered again and compared: episode 0 (samples 0, " in str(found)
    names = [f"head_depth[{last}]", f"head_segmentation[{last}]", "wrist_image[0]"]
    starts = [text.partition(" differ ")[0].split(" of the pixels of ") for text in found.problems]
    assert [name for _, name in starts] == names
    assert all(start.startswith(f"episode {number}: ") for start, _ in starts)


def test_check_without_opengl_says_that_pixels_are_not_compared(
    made: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(snapshots, "_CONTEXTS", ("no_such_context",))
    found = check_dataset(made.folder)
    assert found.ok, found.lines()
    assert "pixels not compared: cannot render without a display" in str(found)


def test_lerobot_layout_has_colour_images(made: Dataset) -> None:
    image = pytest.importorskip("PIL.Image")
    root = made.folder / "lerobot/husky_ur5e"
    features = json.loads((root / "meta/info.json").read_text())["features"]
    stats = json.loads((root / "meta/stats.json").read_text())
    table = pq.read_table(root / "data/chunk-000/file-000.parquet")
    for camera in ("head", "wrist"):
        name = f"observation.images.{camera}"
        assert features[name] == {
            "dtype": "image",
            "shape": [32, 40, 3],
            "names": ["height", "width", "channels"],
        }
        own = [np.asarray(image.open(io.BytesIO(one["bytes"]))) for one in table[name].to_pylist()]
        told = np.concatenate(
            [episode.images().pictures[f"{camera}_image"] for episode in made.episodes()]
        )  # type: ignore[union-attr]
        np.testing.assert_array_equal(np.array(own), told)
        assert np.shape(stats[name]["mean"]) == (3, 1, 1)
        np.testing.assert_allclose(
            np.ravel(stats[name]["mean"]), told.mean(axis=(0, 1, 2)) / 255.0, atol=1e-9
        )
        np.testing.assert_allclose(
            np.ravel(stats[name]["std"]), told.std(axis=(0, 1, 2)) / 255.0, atol=1e-9
        )
        assert stats[name]["count"] == [len(told)]


def test_digest_depends_on_cameras() -> None:
    blind, seeing = load_recipe({**SMALL, "simulate": True}), load_recipe(SEEING)
    moved = load_recipe({**SEEING, "cameras": [{**EYES[0], "fov": 61.0}, EYES[1]]})
    assert len({blind.digest, seeing.digest, moved.digest}) == 3
    assert load_recipe({**SMALL, "simulate": True, "cameras": []}).digest == blind.digest
    assert load_recipe(seeing).cameras == seeing.cameras


@pytest.mark.parametrize(
    ("cameras", "said"),
    [
        ([{**EYES[0], "fov": 180.0}], "fov"),
        ([{**EYES[0], "target": EYES[0]["position"]}], "is undefined"),
        ([EYES[0], EYES[0]], "two cameras of one name"),
        ([{**EYES[0], "wdth": 64}], "did you mean 'width'"),
    ],
)
def test_wrong_cameras_are_refused(cameras: Any, said: str) -> None:
    with pytest.raises(vkc.InputError, match=said):
        load_recipe({**SEEING, "cameras": cameras})
