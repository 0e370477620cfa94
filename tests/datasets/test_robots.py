from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.datasets import SMALL

from vkc_pin.datasets import robots
from vkc_pin.datasets.check import check_dataset
from vkc_pin.datasets.dataset import Dataset
from vkc_pin.datasets.generation import generate
from vkc_pin.datasets.recipe import load_recipe
from vkc_pin.errors import InputError
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.models.robot_file import find_robot, load_robot
from vkc_pin.world.scene.scene import load_scene


def copy_robot(folder: Path) -> Path:
    """Copy the packaged robot as `rover` into a folder, and return its robot.yaml."""
    shutil.copytree(find_robot("husky_ur5e").parent, folder / "rover")
    return folder / "rover" / "robot.yaml"


@pytest.mark.long
def test_robot_without_a_hand_is_imported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = load_recipe({**SMALL, "robots": ["husky_ur5e", {"name": "panda", "height": 0.5}]})
    found = robots.prepare_robots(recipe, tmp_path)
    assert list(found) == ["panda"]  # the other robot describes its hand
    assert load_robot(found["panda"]).touch_links
    monkeypatch.setattr(robots, "import_robot", None)
    assert robots.prepare_robots(recipe, tmp_path) == found


@pytest.mark.parametrize(
    "file_name", ["robot.yaml", pytest.param("husky_ur5e.urdf", marks=pytest.mark.long)]
)
def test_robot_by_path_is_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file_name: str
) -> None:
    """The dataset has a copy of the robot, so that both can be moved, and the robot changed.

    Paths are relative to the working directory, and not to the folder of scenes.
    """
    pytest.importorskip("h5py")
    monkeypatch.chdir(tmp_path)
    copy_robot(Path("mine"))
    dataset = generate({**SMALL, "robots": [f"mine/rover/{file_name}"]}, 1, "out")
    (episode,) = dataset.episodes()
    assert episode.about["robot"] == ("rover" if file_name == "robot.yaml" else "husky_ur5e")
    shutil.rmtree("mine")
    Path("out").rename("moved")
    monkeypatch.chdir("/")
    (episode,) = Dataset.open(tmp_path / "moved").episodes()
    robot, original = episode.scene().robot, load_robot("husky_ur5e")
    assert robot.urdf.is_relative_to(tmp_path / "moved/robots")
    srdf = original.urdf.with_suffix(".srdf").read_bytes()
    assert robot.urdf.with_suffix(".srdf").read_bytes() == srdf
    assert robot.collision.collisionPairs.tolist() == original.collision.collisionPairs.tolist()
    assert [shape.name for shape in robot.visual.geometryObjects] == [
        shape.name for shape in original.visual.geometryObjects
    ]
    assert check_dataset(tmp_path / "moved").ok


def test_robots_with_the_same_name_are_rejected(tmp_path: Path) -> None:
    paths = [str(copy_robot(tmp_path / folder)) for folder in ("a", "b")]
    with pytest.raises(InputError, match="two robots of one name") as caught:
        load_recipe({**SMALL, "robots": paths})
    assert caught.value.field == "robots[1]"
    robots = [{"name": paths[0], "height": z} for z in (0.1, 0.2)]
    assert len(load_recipe({**SMALL, "robots": robots}).fields.robots) == 2


def write_scene_with_own_robot(folder: Path) -> Path:
    """Write a scene and its robot, the packaged ones, as files of a user; return the scene."""
    copy_robot(folder)
    scene = load_scene("drawer").with_start(base=(-0.8, 0.5, 0.4)).document
    scene["robot"]["name"] = "rover/robot.yaml"
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(scene), encoding="utf-8")
    shutil.copytree(find_resource_folder("scenes") / "objects", folder / "objects")
    return file


def test_robots_of_scenes_are_copied(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    scene = write_scene_with_own_robot(tmp_path)
    dataset = generate({**SMALL, "scenes": [str(scene)]}, 1, tmp_path / "out")
    (episode,) = dataset.episodes()
    shutil.rmtree(tmp_path / "rover")
    assert episode.scene().robot.urdf == tmp_path / "out/robots/rover/husky_ur5e.urdf"
    assert check_dataset(dataset.folder).ok


def test_robot_yaml_of_another_urdf_is_not_copied(tmp_path: Path) -> None:
    scene = write_scene_with_own_robot(tmp_path)
    for suffix in (".urdf", ".srdf"):
        packaged = tmp_path / f"rover/husky_ur5e{suffix}"
        shutil.copy(packaged, packaged.with_stem("second"))
    document = yaml.safe_load(scene.read_text(encoding="utf-8"))
    document |= {"robot": {"name": "rover/second.urdf"}, "start": {"base": [-0.8, 0.5, 0.4]}}
    scene.write_text(yaml.safe_dump(document), encoding="utf-8")
    recipe = load_recipe({**SMALL, "scenes": [str(scene)]})
    (file,) = robots.prepare_robots(recipe, tmp_path / "out").values()
    copied, original = load_robot(file), load_robot(tmp_path / "rover/second.urdf")
    assert copied.urdf == tmp_path / "out/second/second.urdf"
    assert (copied.touch_links, copied.tool_frame) == ((), original.tool_frame)
    np.testing.assert_array_equal(copied.home, original.home)


def test_scenes_have_one_robot_of_a_name(tmp_path: Path) -> None:
    scenes = [str(write_scene_with_own_robot(tmp_path / name)) for name in ("a", "b")]
    recipe = load_recipe({**SMALL, "scenes": scenes})
    with pytest.raises(InputError, match=r"different robots of one name.*b/rover/robot\.yaml"):
        robots.prepare_robots(recipe, tmp_path / "out")
