"""Prepares the robots of a recipe and checks their frames."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import yaml

from vkc_pin.datasets.recipe import Recipe, check_robot, get_robot_name, is_path
from vkc_pin.errors import InputError
from vkc_pin.importing.robots.mesh_pieces import copy_meshes
from vkc_pin.importing.robots.robot_import import import_robot
from vkc_pin.simulation.physics import import_mujoco
from vkc_pin.simulation.snapshots import open_gl_context
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.urdf import read_urdf
from vkc_pin.world.files.writing import check_name, write_atomically
from vkc_pin.world.models.camera import check_frame
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import find_robot, find_robot_files, load_robot
from vkc_pin.world.scene.scene import load_scene

# configurations for pairs that need no check, as of robots that are loaded without an SRDF
_SAMPLES = 1000


def check_frames(recipe: Recipe) -> None:
    """Check that cameras can take images and that robots have the frames of cameras and terms.

    Raises:
        InputError: MuJoCo is not installed.
        UnknownNameError: A robot lacks a frame.
        VkcError: OpenGL needs a display.
    """
    if not recipe.cameras and not recipe.terms:
        return
    if recipe.cameras:
        import_mujoco()
        with open_gl_context((8, 8)):
            pass
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings were issued when robots were prepared
        fields = recipe.fields
        for name in fields.scenes or [entry.name for entry in fields.robots]:
            robot = load_scene(name).robot if fields.scenes else load_robot(name)
            for camera in recipe.cameras:
                check_frame(robot, camera.frame)
            check_robot(robot, recipe.terms)


def prepare_robots(recipe: Recipe, folder: Path) -> dict[str, str]:
    """Return name in the recipe → file, for robots that are imported or given by path.

    Args:
        recipe: Recipe.
        folder: Folder of the dataset's robots, visible to all workers. Robots without a described
            hand are imported once; others by path, and those of scenes, are copied with their
            meshes.

    Raises:
        InputError: A robot cannot be imported, one of its meshes is missing, or scenes have
            different robots of one name.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the robot's folder lists guesses
        if recipe.fields.scenes:
            return _prepare_robots_of_scenes(recipe.fields.scenes, folder)
        found: dict[str, str] = {}
        for entry in recipe.fields.robots:
            target = folder / check_name(get_robot_name(entry.name), "robots")
            if not (target / "robot.yaml").is_file():
                robot = load_robot(entry.name)
                if not robot.touch_links:
                    import_robot(find_robot(entry.name), target, samples=_SAMPLES)
                elif Path(entry.name).is_absolute():
                    _copy_robot(robot, find_robot(entry.name), target)
                else:
                    continue
            found[entry.name] = str((target / "robot.yaml").resolve())
    return found


def _prepare_robots_of_scenes(scenes: Sequence[str], folder: Path) -> dict[str, str]:
    """Copy the robots that scenes give by path; see `prepare_robots`."""
    found: dict[str, str] = {}
    sources: dict[str, Path] = {}
    for name in scenes:
        scene = load_scene(name)
        given = str(scene.document["robot"]["name"])
        if not is_path(given):
            continue
        source = find_robot(scene.folder / given)
        robot = check_name(scene.robot.name, "robot.name")
        if sources.setdefault(robot, source.resolve()) != source.resolve():
            raise InputError(
                "scenes have different robots of one name",
                field="scenes",
                expected=f"robots in folders of different names, or only {sources[robot]}",
                got=source.resolve(),
            )
        if not (folder / robot / "robot.yaml").is_file():
            _copy_robot(scene.robot, source, folder / robot)
        found[robot] = str((folder / robot / "robot.yaml").resolve())
    return found


def _copy_robot(robot: Robot, source: Path, folder: Path) -> None:
    """Copy a robot's files into a folder, robot.yaml last."""
    description, srdf = find_robot_files(source)
    about = {} if description is None else yaml.safe_load(read_text(description, "YAML"))
    # Without the couplings that were added to the robot's own tree.
    root = copy_meshes(read_urdf(robot.urdf, robot.file.packages), folder)
    about["urdf"] = robot.urdf.name
    if srdf is not None:
        about["srdf"] = f"{robot.urdf.stem}.srdf"
        write_atomically(folder / about["srdf"], srdf.read_bytes())
    write_atomically(folder / about["urdf"], ElementTree.tostring(root, encoding="utf-8"))
    text = yaml.safe_dump(about, sort_keys=False, allow_unicode=True)
    write_atomically(folder / "robot.yaml", text.encode())
