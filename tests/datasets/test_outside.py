"""Tests that resuming or checking an untrusted dataset changes nothing outside its folder."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from helpers.datasets import SMALL
from helpers.shards import change_demo, set_attribute

from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipe import RobotEntry, load_recipe
from vkc_pin.datasets.robots import prepare_robots
from vkc_pin.errors import InputError

pytest.importorskip("h5py")
EPISODES = 4
INVALID_NAMES = ["../../../evil", "/evil", "..", "", ".hidden", "a\\b", "x" * 300, "\ud800", 3]


@pytest.fixture
def copy(dataset: Dataset, tmp_path: Path) -> Path:
    """Return a dataset without shards, in a nested folder among other files."""
    folder = tmp_path / "a" / "b" / "dataset"
    shutil.copytree(dataset.folder, folder, ignore=shutil.ignore_patterns("shards"))
    for name in ("notes.txt", "a/b/evil.hdf5", "outside/shards/deep/file"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("mine")
    return folder


def read_surroundings(folder: Path, root: Path) -> dict[str, bytes | None]:
    """Return every path in `root` that is not in `folder`, with the contents of files."""
    paths = [path for path in root.rglob("*") if folder not in (path, *path.parents)]
    return {str(path): path.read_bytes() if path.is_file() else None for path in paths}


@pytest.mark.parametrize("name", INVALID_NAMES, ids=repr)
def test_robot_name_in_the_journal_is_checked(copy: Path, tmp_path: Path, name: Any) -> None:
    file = copy / "journal.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line in lines:
        for record in line.get("records", ()):
            record["robot"] = name
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    before = read_surroundings(copy, tmp_path)
    with pytest.raises(InputError, match="robot: not a plain file name") as caught:
        generate(SMALL, EPISODES, copy)
    assert (caught.value.file, caught.value.field) == (file, "robot")
    assert "at most 200 bytes of text without slashes, not beginning" in str(caught.value)
    assert read_surroundings(copy, tmp_path) == before
    assert not (copy / "shards").exists()


@pytest.mark.parametrize("name", ["../../evil", "/evil", "..", "", 3], ids=repr)
def test_scene_name_in_a_work_file_is_checked(copy: Path, tmp_path: Path, name: Any) -> None:
    file = sorted((copy / "work").iterdir())[0]
    scene = str(tmp_path / "evil") if name == "/evil" else name
    change_demo(file, set_attribute("scene", scene))
    before, scenes = read_surroundings(copy, tmp_path), sorted((copy / "scenes").iterdir())
    with pytest.raises(InputError, match="demo_0: scene: not a plain file name") as caught:
        generate(SMALL, EPISODES, copy)
    assert (caught.value.file, caught.value.field) == (file, "demo_0: scene")
    assert read_surroundings(copy, tmp_path) == before
    assert sorted((copy / "scenes").iterdir()) == scenes


def test_robot_name_of_a_recipe_is_checked(tmp_path: Path) -> None:
    recipe = load_recipe(SMALL)
    fields = recipe.fields.model_copy(update={"robots": (RobotEntry(name=f"{tmp_path}/a/.."),)})
    with pytest.raises(InputError, match="robots: not a plain file name"):
        prepare_robots(dataclasses.replace(recipe, fields=fields), tmp_path / "out" / "robots")
    assert not list(tmp_path.iterdir())


def test_symlinks_out_of_the_folder_are_rejected(copy: Path, tmp_path: Path) -> None:
    (copy / "shards").mkdir()
    (copy / "shards" / "husky_ur5e").symlink_to(tmp_path / "outside")
    before = read_surroundings(copy, tmp_path)
    with pytest.raises(InputError, match="leads out of the folder"):
        generate(SMALL, EPISODES, copy)
    assert read_surroundings(copy, tmp_path) == before
    (copy / "shards" / "husky_ur5e").unlink()
    (copy / "elsewhere").mkdir()
    (copy / "shards" / "husky_ur5e").symlink_to("../elsewhere")
    (tmp_path / "link").symlink_to(copy)
    assert len(generate(SMALL, EPISODES, tmp_path / "link").numbers()) == EPISODES
    assert [path.name for path in (copy / "elsewhere").iterdir()] == ["shard-00000.hdf5"]


def test_check_page_is_not_written_through_a_symlink(copy: Path, tmp_path: Path) -> None:
    generate(SMALL, EPISODES, copy)
    (tmp_path / "profile").write_text("mine")
    (copy / "statistics.html").symlink_to(tmp_path / "profile")
    with pytest.raises(InputError, match="leads out of the folder"):
        check_dataset(copy)
    assert (tmp_path / "profile").read_text() == "mine"
    assert check_dataset(copy, page=tmp_path / "page.html").page == tmp_path / "page.html"


def test_foreign_files_in_the_lerobot_folder_are_kept(copy: Path) -> None:
    """The error precedes planning."""
    notes = copy / "lerobot" / "husky_ur5e" / "notes.txt"
    generate(SMALL, EPISODES, copy, lerobot=True)
    notes.write_text("mine")
    with pytest.raises(InputError, match=r"would delete .*got notes\.txt\)") as caught:
        generate(SMALL, EPISODES + 1, copy, lerobot=True)
    assert caught.value.file == notes.parent
    assert notes.read_text() == "mine"
    assert len(Dataset.open(copy).numbers()) == EPISODES
