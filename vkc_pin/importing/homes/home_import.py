"""Imports a home: from one large file to a scene folder that can be planned in."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml

from vkc_pin.errors import InputError
from vkc_pin.importing.homes.objects import ImportedHomeObject, write_object
from vkc_pin.importing.homes.obstacles import write_obstacles
from vkc_pin.importing.homes.splitting import FLOOR_RISE, Home, split_home
from vkc_pin.importing.homes.start_pose import find_free_start
from vkc_pin.importing.objects.clean_up import (
    compute_bounds,
    load_surfaces,
    move_root,
    rename_for_scenes,
)
from vkc_pin.importing.objects.description import WEIGHTLESS
from vkc_pin.importing.objects.object_import import read_description
from vkc_pin.importing.objects.pieces import Known
from vkc_pin.importing.targets import check_target, format_comment, get_origin_marker
from vkc_pin.options import Options
from vkc_pin.utils.arguments import flag, instance, number, whole
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.resources import choose_file_names, file_path
from vkc_pin.world.files.writing import folder_at_once, write_atomically
from vkc_pin.world.files.xml import parse_xml
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene, load_scene

__all__ = ["ImportedHome", "import_home"]

_COMMAND = "import-home"
_LARGEST = 1e3  # [m] above or below zero, where a floor may be


@dataclass(frozen=True, eq=False)
class ImportedHome:
    """A home that was imported.

    Attributes:
        file: The scene, which `load_scene` takes.
        scene: It, loaded.
        things: What moves, in the order of the scene's objects.
        shapes: How many colliding shapes of the file became part of what: "floor", "obstacles" and
            "objects"; "file" is their sum unless something was left out.
        reached: Before how many things the robot's start has free floor all the way.
        notes: What the file left out, and what was changed.
    """

    file: Path
    scene: Scene
    things: tuple[ImportedHomeObject, ...]
    shapes: Mapping[str, int]
    reached: int
    notes: tuple[str, ...]

    def report(self) -> str:
        """Return what came out, as text."""
        x_low, x_high, y_low, y_high = self.scene.arena
        size = f"{x_high - x_low:.1f} × {y_high - y_low:.1f} m"
        free = sum(thing.free for thing in self.things)
        counts = f"{len(self.scene.obstacle_names)} obstacles, {len(self.things) - free} with joints, {free} to carry"
        parts = ", ".join(f"{self.shapes[key]} {key}" for key in ("obstacles", "objects", "floor"))
        base = ", ".join(f"{value:.2f}" for value in self.scene.start[:3])
        return "\n".join(
            [
                f"{self.scene.name}: {size}, {counts}",
                f"  {self.shapes['file']} shapes in the file: {parts}",
                *(f"  {note}" for note in self.notes),
                f"start at ({base}), from where the floor is free to {self.reached} of these",
                *(f"  {thing.report()}" for thing in self.things),
            ]
        )


def import_home(
    file: str | Path,
    folder: str | Path | None = None,
    *,
    floor: float = 0.0,
    robot: str | Path = "husky_ur5e",
    options: Options | None = None,
    most: int = 2,
    seed: int = 0,
    force: bool = False,
) -> ImportedHome:
    """Make a scene that can be planned in of a URDF or MJCF file of a whole home.

    What stands fixed becomes obstacles in convex pieces; a link that stands fixed and has joints on
    it becomes an object with them, and attachments are proposed for each; what moves freely becomes
    objects to carry. The robot starts at a free place on the floor from which it gets to most of
    that.

    Args:
        file: The file; its z points up.
        folder: Where to write the scene, a new or empty folder; named like the file if it is not
            given.
        floor: Height of the floor in the file [m].
        robot: Which robot is there: its name, or the path of a URDF or robot.yaml.
        options: Which clearances attachments must have.
        most: How many attachments one joint gets at most.
        seed: Of the random numbers with which a start is looked for.
        force: Whether to replace a folder that this made before.

    Raises:
        InputError: The file cannot be read, is none of a home, or nothing in it can move; the
            folder holds something; an argument is wrong; or the robot finds no place.
        UnknownNameError: There is no such robot, or the file names something that does not exist.
    """
    path = file_path(file, "file", "a URDF or MJCF file")
    floor = number(floor, "floor", "a height [m]", low=-_LARGEST, high=_LARGEST)
    whole(most, "most", low=1, high=100)
    rng = np.random.default_rng(whole(seed, "seed", low=0))
    options = Options() if options is None else instance(options, Options, "options")
    hand = load_robot(robot)
    target = file_path(folder, "folder", "a folder") if folder is not None else Path(_name(path))
    check_target(target, _COMMAND, force=flag(force, "force"))
    if parse_xml(read_text(path, "URDF or MJCF"), path).tag == "sdf":
        raise InputError(
            "homes are read from URDF and MJCF alone",
            file=path,
            expected="<robot> or <mujoco>",
            got="<sdf>",
        )
    description = move_root(
        rename_for_scenes(read_description(path, free=True)),
        pin.SE3(np.eye(3), np.array([0.0, 0.0, -floor])),
    )
    low, high = compute_bounds(description, load_surfaces(description))
    home = split_home(description)
    if not home.things:
        expected = (
            "joints that are revolute, continuous, prismatic or floating, with shapes on them"
        )
        raise InputError(
            "nothing in this file can move",
            file=path,
            expected=expected,
            got=f"{home.shapes} shapes that stand fixed",
        )
    with folder_at_once(target, force=True) as made:  # what is there may be replaced
        known: Known = {}
        names = [thing.name for thing in home.things]
        taken = {FLOOR, *names}
        clearances = {"dist_safe": options.dist_safe, "grasp_clearance": options.grasp_clearance}
        things = tuple(
            write_object(thing, hand, made, known, stem=stem, most=most, **clearances)
            for thing, stem in zip(home.things, choose_file_names(names), strict=True)
        )
        obstacles, changed = write_obstacles(home, path, made, taken, known)
        document: dict[str, Any] = {
            "name": _name(path),
            "robot": _robot(robot),
            "start": {"base": [round(float(value), 3) for value in (*(low + high)[:2] / 2.0, 0.0)]},
            "arena": {axis: _interval(low[k], high[k]) for k, axis in enumerate("xy")},
            "start_region": {axis: _interval(low[k], high[k]) for k, axis in enumerate("xy")},
            "obstacles": obstacles,
            "objects": [thing.entry for thing in things],
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # all of it is said again when the scene is loaded
            scene, reached = _started(Scene.from_document(document, made), path, rng)
        document["start"] = {"base": scene.start[:3].tolist()}
        _write(made / "scene.yaml", path, document)
    weight = (WEIGHTLESS,) if all(thing.description.is_massless for thing in home.things) else ()
    notes = (
        *home.notes,
        *weight,
        *_floor_notes(home),
        *changed,
        *(note for thing in things for note in thing.notes),
    )
    return ImportedHome(
        target / "scene.yaml",
        load_scene(target / "scene.yaml"),
        things,
        _counts(home),
        reached,
        notes,
    )


def _started(scene: Scene, path: Path, rng: np.random.Generator) -> tuple[Scene, int]:
    """Return what `find_free_start` does. Raises its error with the file's name."""
    try:
        return find_free_start(scene, rng)
    except InputError as error:
        raise InputError(
            error.problem, file=path, field=error.field, expected=error.expected, got=error.got
        ) from None


def _interval(low: float, high: float) -> list[float]:
    return [round(float(low), 3), round(float(high), 3)]


def _name(path: Path) -> str:
    """Return what to call a home."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", path.stem).strip("_")
    return choose_file_names([name], fallback="home")[0]


def _robot(robot: str | Path) -> str:
    """Return a robot as a scene in another folder names it."""
    by_path = isinstance(robot, Path) or robot.endswith((".urdf", ".yaml", ".yml")) or "/" in robot
    return str(Path(robot).resolve()) if by_path else str(robot)


def _write(file: Path, source: Path, document: Mapping[str, Any]) -> None:
    head = format_comment(f"Made of {source.name} {get_origin_marker(_COMMAND)}.")
    write_atomically(
        file,
        (
            head + yaml.safe_dump(document, sort_keys=False, width=130, default_flow_style=None)
        ).encode(),
    )


def _floor_notes(home: Home) -> list[str]:
    if not home.floor:
        return []
    names = ", ".join(dict.fromkeys(home.floor))
    return [f"no more than {1e3 * FLOOR_RISE:g} mm above the floor, and part of it: {names}"]


def _counts(home: Home) -> dict[str, int]:
    """Return how many shapes of the file became part of what."""
    objects = sum(
        len(link.solid) for thing in home.things for link in thing.description.links.values()
    )
    obstacles = sum(len(link.solid) for link in (*home.building, *home.furniture))
    return {
        "file": home.shapes,
        "obstacles": obstacles,
        "objects": objects,
        "floor": len(home.floor),
    }
