"""Imports a home from one large file as a scene folder."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description
from vkc_pin.importing.formats.detection import check_no_arguments
from vkc_pin.importing.formats.reading import FORMATS
from vkc_pin.importing.homes.allowed_contacts import read_home_contacts
from vkc_pin.importing.homes.mesh_rooms import MESH_SUFFIXES, read_mesh_room
from vkc_pin.importing.homes.splitting import FLOOR_RISE, Home, add_floor, split_home
from vkc_pin.importing.homes.writing import ImportedHomeObject, write_parts
from vkc_pin.importing.objects.clean_up import (
    compute_bounds,
    load_surfaces,
    move_root,
    rename_for_scenes,
)
from vkc_pin.importing.objects.object_reading import WEIGHTLESS, read_object
from vkc_pin.importing.scenes import (
    HORIZONTAL,
    locate_robot,
    refer_to_robot,
    round_interval,
    write_scene,
)
from vkc_pin.importing.targets import check_source, check_target
from vkc_pin.options import Options
from vkc_pin.planning.base_paths.reachable_floor import CELL, find_free_floor
from vkc_pin.utils.arguments import check_bool, check_instance, check_integer, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.resources import check_path, choose_file_names
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene

_COMMAND = "import-home"
_LARGEST = 1e3  # [m] largest height of a floor
_STANDOFF = 0.9  # [m] typical distance of a robot's base from a handle that it grasps
_RADIUS = 0.5  # [m] around this position within which free floor counts as reaching the handle
_TRIES = 4000  # sampled poses
_CHOICE = 12  # free poses of which the one with the largest clearance is chosen


@dataclass(frozen=True, eq=False)
class ImportedHome:
    """An imported home.

    Attributes:
        file: Scene file for `load_scene`.
        scene: The loaded scene.
        objects: Movable objects, in the order of the scene's objects.
        shapes: Number of collision shapes of the file that became "floor", "obstacles" and
            "objects"; "file" is their sum unless some were left out.
        reached: Number of objects to which the floor is free from the robot's start.
        notes: Changes and omissions.
    """

    file: Path
    scene: Scene
    objects: tuple[ImportedHomeObject, ...]
    shapes: Mapping[str, int]
    reached: int
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Return a readable report."""
        x_low, x_high, y_low, y_high = self.scene.arena
        size = f"{x_high - x_low:.1f} × {y_high - y_low:.1f} m"
        free = sum(item.free for item in self.objects)
        counts = (
            f"{len(self.scene.obstacle_names)} obstacles, "
            f"{len(self.objects) - free} articulated objects, {free} free objects"
        )
        parts = ", ".join(f"{self.shapes[key]} {key}" for key in ("obstacles", "objects", "floor"))
        base = ", ".join(f"{value:.2f}" for value in self.scene.start[:3])
        start = f"start at ({base})"
        if self.objects:
            start += f", with free floor to {self.reached} of these objects"
        lines = [
            f"{self.scene.name}: {size}, {counts}",
            f"  {self.shapes['file']} shapes in the file: {parts}",
        ]
        lines += [f"  {note}" for note in self.notes]
        lines.append(start)
        lines += [f"  {item.summary()}" for item in self.objects]
        return "\n".join(lines)


def import_home(  # noqa: PLR0913 - keyword options of a public call
    file: str | Path,
    folder: str | Path | None = None,
    *,
    floor: float | None = None,
    robot: str | Path = "husky_ur5e",
    options: Options | None = None,
    most: int = 2,
    seed: int = 0,
    force: bool = False,
    srdf: str | Path | None = None,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
) -> ImportedHome:
    """Import a URDF, xacro, MJCF, SDF, USD or MoveIt .scene file, or a mesh, of a home as a scene.

    Fixed links become obstacles of convex pieces. A fixed link with joints becomes an articulated
    object, for whose joints attachments are proposed. Floating links become free objects. The arena
    covers the home and, on sides without walls, 2 m of floor around it. The robot starts at a free
    pose from which it reaches most objects. A mesh, such as a scan, is divided into its floor and
    connected surfaces, which become obstacles. Long imports log their progress to the logger
    ``vkc_pin.importing``.

    Args:
        file: The file; its z axis points up, except in glTF, which is turned.
        folder: Output folder, new or empty; defaults to one named like the file.
        floor: Height of the floor in the file [m]. Default: 0, and of a mesh that of most
            horizontal area in its lower half.
        robot: Robot of the scene: its name, or the path of a URDF or robot.yaml.
        options: Options with the clearances of attachments.
        most: Largest number of attachments of one joint.
        seed: Random seed of the search for a start pose.
        force: Whether to replace a folder that an earlier import wrote.
        srdf: An SRDF whose pairs of links may touch; defaults to the one beside the file or in
            ../srdf.
        packages: Folders of packages by name; others are searched for around the file.
        arguments: Arguments of a xacro file.

    Raises:
        InputError: The file cannot be read or does not describe a home; the folder holds other
            files; an argument is invalid; or the robot finds no start pose.
        UnknownNameError: The robot is unknown, or the file refers to an undefined name.
    """
    path = check_path(file, "file", f"a {FORMATS} file, or a mesh")
    if floor is not None:
        floor = check_number(floor, "floor", "a height [m]", low=-_LARGEST, high=_LARGEST)
    check_integer(most, "most", low=1, high=100)
    rng = np.random.default_rng(check_integer(seed, "seed", low=0))
    options = Options() if options is None else check_instance(options, Options, "options")
    loaded_robot = load_robot(robot)
    name = _choose_name(path)
    target = Path(name) if folder is None else check_path(folder, "folder", "a folder")
    check_source(path, f"a {FORMATS} file, or a mesh")
    check_target(target, _COMMAND, force=check_bool(force, "force"))
    srdf_path = None if srdf is None else check_path(srdf, "srdf")
    original, height = _read_home(path, floor, packages, arguments)
    description = rename_for_scenes(original)
    contacts = read_home_contacts(path, srdf_path, original.links, description.links)
    description = move_root(description, pin.SE3(np.eye(3), np.array([0.0, 0.0, -height])))
    low, high = compute_bounds(description, load_surfaces(description))
    home = split_home(description)
    # `check_target` allowed replacing it
    with write_folder_atomically(target, force=True, source=path) as staging:
        parts = write_parts(home, path, loaded_robot, staging, options=options, most=most)
        objects = parts.objects
        allowed, contact_notes = contacts.find_scene_pairs(home, parts.obstacle_links)
        floor_low, floor_high = add_floor(home, low, high)
        x, y = (floor_low + floor_high)[:2] / 2.0
        x_range = round_interval(floor_low[0], floor_high[0])
        y_range = round_interval(floor_low[1], floor_high[1])
        document: dict[str, Any] = {
            "name": name,
            "robot": locate_robot(robot),
            "start": {"base": [round(float(x), 3), round(float(y), 3), 0.0]},
            "arena": {"x": x_range, "y": y_range},
            "start_region": {"x": list(x_range), "y": list(y_range)},
            "obstacles": parts.obstacles,
            "objects": [item.entry for item in objects],
        }
        if allowed:
            document["allow"] = allowed
        with warnings.catch_warnings():
            # They are repeated when the scene is loaded.
            warnings.simplefilter("ignore")
            scene, reached = find_free_start(Scene.from_document(document, staging), rng, path)
        document["start"] = {"base": scene.start[:3].tolist()}
        document["robot"] = refer_to_robot(robot, target)
        write_scene(staging / "scene.yaml", path, document, _COMMAND)
    notes = [
        *home.notes,
        *_note_movable_parts(home),
        *_note_floor_shapes(home),
        *_note_open_sides((low, high), (floor_low, floor_high)),
        *_note_high_objects(scene, rng),
        *contacts.notes,
        *contact_notes,
        *parts.notes,
    ]
    for written in objects:
        notes += [f"{written.name}: {note}" for note in written.notes]
    return ImportedHome(
        target / "scene.yaml",
        load_scene(target / "scene.yaml"),
        objects,
        _count_shapes(home),
        reached,
        tuple(notes),
    )


def _read_home(
    path: Path,
    floor: float | None,
    packages: Mapping[str, str | Path] | None,
    arguments: Mapping[str, str] | None,
) -> tuple[Description, float]:
    """Return the description of a home, and the height of its floor [m]."""
    if path.suffix.lower() in MESH_SUFFIXES:
        check_no_arguments(path, arguments or {})
        return read_mesh_room(path, floor)
    description = read_object(path, free=True, packages=packages, arguments=arguments)
    return description.check_meshes(is_home=True), 0.0 if floor is None else floor


def _choose_name(path: Path) -> str:
    """Return a name for a home."""
    name = re.sub(r"[^A-Za-z0-9_]+", "_", path.stem).strip("_")
    (name,) = choose_file_names([name], fallback="home")
    return name


def _note_movable_parts(home: Home) -> Iterator[str]:
    if not home.objects:
        kinds = "no joint or free body that moves a shape"
        yield f"nothing moves ({kinds}): the scene has obstacles only"
    elif all(item.description.is_massless for item in home.objects):
        yield WEIGHTLESS


def _note_floor_shapes(home: Home) -> list[str]:
    if not home.floor:
        return []
    names = ", ".join(dict.fromkeys(home.floor))
    return [f"at most {1e3 * FLOOR_RISE:g} mm above the floor, hence part of it: {names}"]


def _note_open_sides(before: tuple[Floats, Floats], after: tuple[Floats, Floats]) -> Iterator[str]:
    sides = list[str]()
    for sign, old, new in zip("-+", before, after, strict=True):
        for axis, moved in zip("xy", old != new, strict=False):
            if moved:
                sides.append(f"{sign}{axis}")
    if sides:
        yield f"2 m of floor lie beyond the sides without walls: {', '.join(sides)}"


def _note_high_objects(scene: Scene, rng: np.random.Generator) -> Iterator[str]:
    """Note objects whose attachments are all above the hand's reach, as above a wrong floor."""
    top = _compute_reaching_height(scene.robot, rng)
    high = list[str]()
    for name, placed in scene.objects.items():
        heights = list[float]()
        for attachment in placed.object.attachments.values():
            link = placed.link_placement(attachment.link)
            heights.append(link.act(attachment.placement.translation)[2])
        if heights and min(heights) > top:
            high.append(f"{name} ({min(heights):.1f} m)")
    if high:
        text = f"attachments above the hand, which reaches {top:.1f} m high: {', '.join(high)}"
        yield f"{text}; is the floor at another height (`floor`)?"


def _compute_reaching_height(robot: Robot, rng: np.random.Generator) -> float:
    """Return the largest height of the hand over random configurations of the arm [m]."""
    data = robot.model.createData()
    frame = robot.model.getFrameId(robot.tool_frame)
    low = np.maximum(robot.lower, -np.pi)
    high = np.maximum(low, np.minimum(robot.upper, np.pi))
    heights = list[float]()
    for z in rng.uniform(low, high, (_TRIES, len(low))):
        pin.forwardKinematics(robot.model, data, robot.coordinates.q(z))
        heights.append(pin.updateFramePlacement(robot.model, data, frame).translation[2])
    return float(max(heights))


def _count_shapes(home: Home) -> dict[str, int]:
    """Return the number of collision shapes by their role."""
    object_shapes = 0
    for item in home.objects:
        object_shapes += sum(len(link.solid) for link in item.description.links.values())
    return {
        "file": home.shapes,
        "obstacles": sum(len(link.solid) for link in (*home.building, *home.furniture)),
        "objects": object_shapes,
        "floor": len(home.floor),
    }


def find_free_start(
    scene: Scene, rng: np.random.Generator, file: Path | None = None
) -> tuple[Scene, int]:
    """Return the scene with a free start pose, and the number of objects that it reaches.

    The start is on the connected floor from which most objects can be reached. All joints count as
    closed. The floor is checked with discs inside the base, the start with the whole robot.
    """
    from scipy import ndimage

    cells, free = find_free_floor(scene)
    # Connected cells of free floor have the number of their region, from 1; others have 0.
    regions, count = ndimage.label(free)
    middles = np.stack(np.broadcast_arrays(*cells.centers()), axis=-1)
    reached = np.zeros(count + 1, int)
    for positions in _find_grasp_positions(scene).values():
        is_near = np.zeros(cells.shape, bool)
        for position in positions:
            is_near |= np.linalg.norm(middles - position, axis=-1) < _RADIUS
        reached[np.setdiff1d(regions[is_near], [0])] += 1
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    # The region that reaches most objects comes first, of equal ones the largest.
    order = sorted(range(1, count + 1), key=lambda region: (-reached[region], -sizes[region]))
    for region in order:
        places = middles[regions == region]
        start = _sample_free_start(scene, places, rng, _TRIES // len(order) + 1)
        if start is not None:
            return start, int(reached[region])
    raise InputError(
        f"no start pose of {scene.robot.name} has a clearance of {START_CLEARANCE} m",
        file=file,
        field="robot, floor",
        expected="a home with free floor for the robot, at the height `floor`",
        got=f"none in {_TRIES} tries",
    )


def _sample_free_start(
    scene: Scene, places: Floats, rng: np.random.Generator, tries: int
) -> Scene | None:
    """Return the scene with the clearest of some free start poses in cells, or None.

    Args:
        scene: The scene.
        places: Middles of the cells, shape (n, 2) [m].
        rng: Generator of random poses.
        tries: Largest number of poses.
    """
    x_low, x_high, y_low, y_high = scene.arena
    low = np.array([x_low, y_low])
    high = np.array([x_high, y_high])
    free_count = 0
    best = None
    best_clearance = -np.inf
    for _ in range(tries):
        drawn = scene.with_start(base=_sample_pose(places, rng, low, high))
        clearance = drawn.start_clearance(reach=1.0)
        if clearance < START_CLEARANCE:
            continue
        if clearance > best_clearance:
            best = drawn
            best_clearance = clearance
        free_count += 1
        if free_count == _CHOICE:
            break
    return best


def _sample_pose(
    places: Floats, rng: np.random.Generator, low: Floats, high: Floats
) -> list[float]:
    """Return a random position in one of some cells, and a random heading."""
    middle = places[int(rng.integers(len(places)))]
    position = middle + rng.uniform(-0.5, 0.5, 2) * CELL
    x, y = np.clip(position, low, high).round(3).tolist()
    yaw = round(float(rng.uniform(-np.pi, np.pi)), 3)
    return [x, y, yaw]


def _find_grasp_positions(scene: Scene) -> dict[str, list[Floats]]:
    """Return the base positions from which a robot grasps each object, shape (2,) [m] each."""
    found = dict[str, list[Floats]]()
    for name, placed in scene.objects.items():
        for attachment in placed.object.attachments.values():
            tool = placed.link_placement(attachment.link) * attachment.placement
            direction = tool.rotation[:2, 2]
            length = float(np.linalg.norm(direction))
            # A grasp from above has no direction: the floor below it counts.
            back = -direction / length if length > HORIZONTAL else np.zeros(2)
            found.setdefault(name, []).append(tool.translation[:2] + _STANDOFF * back)
    return found
