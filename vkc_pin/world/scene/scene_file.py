"""Builds the attributes of a scene from its description, and the description from a scene."""

from __future__ import annotations

import contextlib
import functools
import itertools
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import UnknownNameError, find_nearest_name
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.srdf import format_names, read_allowed_pairs
from vkc_pin.world.models.grafting import round_placement
from vkc_pin.world.models.object_file import build_object, load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot
from vkc_pin.world.models.shapes import check_start_value
from vkc_pin.world.scene import scene_schema as schema
from vkc_pin.world.scene.hold import (
    Hold,
    compute_tool_placement,
    get_attachment,
    make_holds,
    measure_grasp,
    place_held_objects,
    resolve_holds,
)
from vkc_pin.world.scene.obstacles import FLOOR, make_floor_shape, make_obstacle_shapes
from vkc_pin.world.scene.placed_object import PlacedObject


def make_scene_fields(document: Document, folder: Path) -> dict[str, Any]:
    """Return the attributes of the `Scene` that `document` describes, by name."""
    description = parse_document(document, schema.SceneSchema)
    robot = _load_robot(document, description, folder)
    _check_unique_names(document, description)
    objects = {
        item.name: _load_object(document, ("objects", index), item, folder)
        for index, item in enumerate(description.objects)
    }
    arena = (*description.arena.x, *description.arena.y)
    obstacles, visual, labels = list[pin.GeometryObject](), list[pin.GeometryObject](), list[str]()
    for index, item in enumerate(description.obstacles):
        drawn, shapes = _load_obstacle(document, ("obstacles", index), item, folder)
        visual += drawn
        obstacles += shapes
        labels += [item.name] * len(shapes)
    if description.floor:
        obstacles.append(make_floor_shape(arena))
        labels.append(FLOOR)
    _check_within_arena(document, description, arena)
    start = _make_start(document, description.start, robot)
    return {
        "name": description.name or (document.file.stem if document.file else "scene"),
        "file": document.file,
        "folder": folder,
        "robot": robot,
        "start": start,
        "objects": freeze(objects),
        "obstacles": tuple(obstacles),
        "obstacle_labels": tuple(labels),
        "obstacle_names": tuple(item.name for item in description.obstacles),
        "obstacle_visual": tuple(visual),
        "floor": description.floor,
        "arena": arena,
        "start_region": description.start_region,
        "holds": _make_holds(document, description.start.held, objects, robot, start),
        "allowed": freeze(_find_allowed_pairs(document, description, folder, robot, objects)),
        "described": description,
        "opening": description.start.opening,
    }


def make_document(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain data from which `make_scene_fields` builds the same attributes again.

    Objects that still are where the description put them keep its fields; the others are described
    by position and rpy.

    Args:
        fields: Attributes of a `Scene`, by name.
    """
    described, start, objects, region = (
        fields[key] for key in ("described", "start", "objects", "start_region")
    )
    plain = described.model_dump(
        mode="json", include={"robot", "obstacles", "objects", "allow"}, exclude_none=True
    )
    held = {}
    for hold in fields["holds"]:
        entries: dict[str, Any] = {
            "attachment": hold.attachment,
            "by": hold.frame,
            "at": list(hold.at) if any(hold.at) else None,
        }
        if hold.deviation:
            grasp = get_attachment(objects, hold)
            pose = pin.SE3ToXYZQUAT(grasp.motion(hold.at).inverse())
            entries["at"] = list(hold.at) or None
            entries["measured"] = {"position": pose[:3].tolist(), "quaternion": pose[3:].tolist()}
        held[hold.object] = {key: value for key, value in entries.items() if value is not None}
    for item, entry in zip(described.objects, plain["objects"], strict=True):
        placed = objects[item.name]
        names = placed.object.coordinates.names
        neutral = np.clip(0.0, placed.object.lower, placed.object.upper)
        entry["state"] = dict(zip(names, placed.state.tolist(), strict=True))
        in_hand = placed.object.free and item.name in held
        moved = not in_hand and not np.array_equal(
            placed.placement.homogeneous, _make_pose(item).homogeneous
        )
        entry.pop("reversed", None)
        as_described = not moved and entry["state"] == {
            **dict(zip(names, neutral.tolist(), strict=True)),
            **item.state,
        }
        # Otherwise loading the document finds the same approaches again.
        if placed.reversed or item.reversed is not None or not as_described:
            entry["reversed"] = list(placed.reversed)
        if moved:
            for orientation in ("yaw", "quaternion"):
                entry.pop(orientation, None)
            entry["position"] = placed.placement.translation.tolist()
            entry["rpy"] = pin.rpy.matrixToRpy(placed.placement.rotation).tolist()
    at_home = described.start.arm is None and np.array_equal(start[3:], fields["robot"].home)
    return {
        "name": fields["name"],
        "robot": plain["robot"],
        "start": {
            "base": start[:3].tolist(),
            **({} if described.start.z is None else {"z": described.start.z}),
            **({} if fields["opening"] is None else {"opening": fields["opening"]}),
            **({} if at_home else {"arm": start[3:].tolist()}),
            "held": held,
        },
        "arena": {"x": list(fields["arena"][:2]), "y": list(fields["arena"][2:])},
        **(
            {"start_region": {key: list(value) for key, value in vars(region).items() if value}}
            if region
            else {}
        ),
        "floor": fields["floor"],
        "obstacles": plain["obstacles"],
        "objects": plain["objects"],
        **({"allow": plain["allow"]} if plain["allow"] else {}),
    }


def _load_robot(document: Document, description: schema.SceneSchema, folder: Path) -> Robot:
    item, height = description.robot, description.start.z
    is_path = item.name.endswith((".urdf", ".yaml", ".yml")) or "/" in item.name
    is_short = isinstance(document.data["robot"], str)  # robot: husky_ur5e
    with document.annotate_errors(("robot",) if is_short else ("robot", "name")):
        name = folder / item.name if is_path else item.name
        turning = item.turning_radius
        return load_robot(
            name, base=item.base, tool_frame=item.tool_frame, height=height, turning_radius=turning
        )


def _check_unique_names(document: Document, description: schema.SceneSchema) -> None:
    used = {FLOOR: "the floor"}
    for group, items in (("obstacles", description.obstacles), ("objects", description.objects)):
        for index, item in enumerate(items):
            path = (group, index, "name")
            if item.name in used:
                raise document.make_error(
                    path,
                    "this name is already used",
                    expected="a new name",
                    got=f"{item.name}, as {used[item.name]}",
                )
            line = document.find_line(path)
            used[item.name] = f"{group}[{index}]" + (f" in line {line}" if line else "")


def _check_within_arena(
    document: Document, description: schema.SceneSchema, arena: tuple[float, float, float, float]
) -> None:
    for axis, low, high, value in (
        ("x", *arena[:2], description.start.base[0]),
        ("y", *arena[2:], description.start.base[1]),
    ):
        if not low <= value <= high:
            entry = ("start", "base", 0 if axis == "x" else 1)
            raise document.make_error(
                entry, "outside the arena", expected=f"{axis} from {low:g} to {high:g}", got=value
            )
        interval = getattr(description.start_region, axis, None)
        if interval is not None and not low <= interval[0] <= interval[1] <= high:
            path = ("start_region", axis)
            raise document.make_error(
                path,
                "outside the arena",
                expected=f"{axis} from {low:g} to {high:g}",
                got=list(interval),
            )


def _make_start(document: Document, item: schema.StartSchema, robot: Robot) -> Floats:
    names = robot.coordinates.names[3:]
    is_named = isinstance(item.arm, Mapping)
    if isinstance(item.arm, Mapping):
        arm = np.array(_fill_arm(document, item.arm, robot))
    else:
        arm = robot.home if item.arm is None else np.array(item.arm)
    if len(arm) != len(names):
        expected = f"{len(names)} values: {', '.join(names)}"
        raise document.make_error(
            ("start", "arm"), "wrong number of arm joints", expected=expected, got=len(arm)
        )
    start = np.concatenate([item.base, arm])
    lower, upper = robot.start_limits
    for index, name in enumerate(robot.coordinates.names):
        path: tuple[str, str, str | int] = ("start", "base", index)
        if index >= 3:
            path = ("start", "arm", name if is_named else index - 3)
        with document.annotate_errors(path):
            start[index] = check_start_value(start[index], lower[index], upper[index], name)
    return start


def _fill_arm(document: Document, given: Mapping[str, float], robot: Robot) -> list[float]:
    """Return the values of all arm joints; those that are not named are at home."""
    names = robot.coordinates.names[3:]
    for joint in given:
        if joint not in names:
            path, kind = ("start", "arm", joint), f"arm joint of robot '{robot.name}'"
            raise document.make_unknown_name_error(path, kind, joint, names)
    homes = zip(names, robot.home.tolist(), strict=True)
    return [given.get(joint, value) for joint, value in homes]


def _make_holds(
    document: Document,
    held: Mapping[str, schema.HeldSchema],
    objects: Mapping[str, PlacedObject],
    robot: Robot,
    start: Floats,
) -> tuple[Hold, ...]:
    attachments = {name: item.attachment for name, item in held.items()}
    by = {name: item.by for name, item in held.items() if item.by is not None}
    at = {name: item.at for name, item in held.items() if item.at is not None}
    for name in held:
        path = ("start", "held", name)
        if name not in objects:
            raise document.make_unknown_name_error(path, "object", name, objects)
        with document.annotate_errors(path):
            owner = by.get(name, "").partition(".")[0]
            both = {one: attachments[one] for one in (owner, name) if one in held}
            through = {name: by[name]} if name in by else {}
            values = {name: at[name]} if name in at else {}
            resolve_holds(objects, make_holds(both, through, values))
    with document.annotate_errors(("start", "held")):
        holds = make_holds(attachments, by, at)
        found = resolve_holds(objects, holds)
    measured = _find_measured_poses(held, found, objects, robot, start)
    for name in measured:
        with document.annotate_errors(("start", "held", name, "measured")):
            found = resolve_holds(objects, holds, {name: measured[name]})
    return resolve_holds(objects, holds, measured) if measured else found


def _find_measured_poses(
    held: Mapping[str, schema.HeldSchema],
    holds: Iterable[Hold],
    objects: Mapping[str, PlacedObject],
    robot: Robot,
    start: Floats,
) -> dict[str, pin.SE3]:
    """Return the stated or derived placements of attachments in the grasping frames."""
    tool = functools.partial(compute_tool_placement, robot, start)
    derived = {name for name, item in held.items() if item.measured == "derive"}
    now = place_held_objects(objects, tool, [one for one in holds if one.object not in derived])
    found = {}
    for hold in holds:
        stated = held[hold.object].measured
        if stated is not None:
            found[hold.object] = (
                measure_grasp(now, hold, tool) if stated == "derive" else _make_pose(stated)
            )
    return found


def _find_allowed_pairs(
    document: Document,
    description: schema.SceneSchema,
    folder: Path,
    robot: Robot,
    objects: Mapping[str, PlacedObject],
) -> dict[frozenset[str], float]:
    """Return pairs of link labels that may be close → margin [m]; the smallest of several."""
    robot_labels = {link: [link] for link in robot.links}
    labels = dict(robot_labels)
    links = dict[str, list[str]]()  # labels by the name of the link alone
    for name, placed in objects.items():
        own = [f"{name}.{link}" for link in placed.object.links]
        labels |= {label: [label] for label in own} | {name: own}
        for link, label in zip(placed.object.links, own, strict=True):
            links.setdefault(link, []).append(label)
    labels |= {item.name: [item.name] for item in description.obstacles} | (
        {FLOOR: [FLOOR]} if description.floor else {}
    )
    # In an SRDF, the name of a link stands for it without its object if it is the only one.
    labels_in_srdf = dict(labels)
    for link, found_labels in links.items():
        if len(found_labels) == 1 and (link not in labels or link in objects):
            labels_in_srdf[link] = found_labels
    models = [list(robot_labels), [name for name in labels_in_srdf if name not in robot_labels]]
    found: dict[frozenset[str], float] = {}
    for number, item in enumerate(description.allow):
        pairs: Iterable[tuple[str, ...]] = [item.pair] if item.pair is not None else []
        names = labels
        if item.srdf is not None:
            is_short = isinstance(document.data["allow"][number], str)
            file = _find_file(
                document, ("allow", number, *(() if is_short else ("srdf",))), folder, item.srdf
            )
            pairs = _read_allowed_pairs(file, models)
            names = labels_in_srdf
        for pair in pairs:
            for place, name in enumerate(pair):
                if name not in names:
                    is_short = isinstance(document.data["allow"][number], list | tuple)
                    raise document.make_unknown_name_error(
                        ("allow", number, *(() if is_short else ("pair",)), place),
                        "link, object or obstacle",
                        name,
                        names,
                    )
            margin = -np.inf if item.margin is None else item.margin
            for both in itertools.product(*(names[name] for name in pair)):
                found[frozenset(both)] = min(margin, found.get(frozenset(both), np.inf))
    return found


def _read_allowed_pairs(file: Path, models: Sequence[Collection[str]]) -> Iterable[tuple[str, str]]:
    """Return the allowed pairs of an SRDF; warn of names that the scene does not have.

    Args:
        file: The SRDF.
        models: Names of the robot's links, and of the other links.
    """
    pairs = read_allowed_pairs(file, models)
    if pairs.unknown and not pairs.allowed:
        name, line = next(iter(pairs.unknown.items()))
        known = [label for model in models for label in model]
        raise UnknownNameError(
            "link, object or obstacle",
            name,
            known,
            file=file,
            line=line,
            field="disable_collisions",
        )
    if pairs.unknown:
        text = f"skipped pairs of links that the scene does not have: {format_names(pairs.unknown)}"
        warnings.warn(f"{file}: {text}", stacklevel=2)
    return pairs.allowed


def _make_pose(item: schema.PoseSchema) -> pin.SE3:
    roll, pitch, yaw = item.rpy or (0.0, 0.0, item.yaw or 0.0)
    rotation = pin.rpy.rpyToMatrix(roll, pitch, yaw)
    if item.quaternion is not None:
        rotation = pin.Quaternion(np.array(item.quaternion)).matrix()
    return round_placement(pin.SE3(rotation, np.array(item.position)))


def _find_file(document: Document, path: tuple[str | int, ...], folder: Path, name: str) -> Path:
    with document.annotate_errors(path):
        file = check_path(folder / name, "file", "the name of a file")
    if not file.is_file():
        similar = _find_similar_name(file)
        expected = f"a file in {folder}" + (
            f", perhaps {Path(name).with_name(similar)}" if similar else ""
        )
        raise document.make_error(path, "there is no such file", expected=expected, got=name)
    return file


def _find_similar_name(file: Path) -> str | None:
    """Return the most similar name in the folder of a missing file, among files of its type."""
    with contextlib.suppress(OSError):
        return find_nearest_name(
            file.name,
            sorted(one.name for one in file.parent.iterdir() if one.suffix == file.suffix),
        )
    return None


def _load_object(
    document: Document, path: tuple[str | int, ...], item: schema.PlacedObjectSchema, folder: Path
) -> PlacedObject:
    at, kind = (*path, "type"), item.type
    with document.annotate_errors(at):
        if isinstance(kind, dict):
            loaded = build_object(_extract_part(document, at), folder)
        else:
            is_path = kind.endswith((".yaml", ".yml")) or "/" in kind
            loaded = load_object(_find_file(document, at, folder, kind) if is_path else kind)
    neutral = np.clip(0.0, loaded.lower, loaded.upper)
    placed = PlacedObject(item.name, loaded, _make_pose(item), neutral)
    for joint, value in item.state.items():
        with document.annotate_errors((*path, "state", joint)):
            placed = placed.with_state({joint: value})
    for number, attachment in enumerate(item.reversed or ()):
        with document.annotate_errors((*path, "reversed", number)):
            placed = placed.with_reversed(attachment)
    return placed


def _extract_part(document: Document, path: tuple[str | int, ...]) -> Document:
    """Return the data at `path` as a document of its own, with the same file and lines."""
    inside, data = len(path), functools.reduce(lambda data, key: data[key], path, document.data)
    lines = {
        place[inside:]: line for place, line in document.lines.items() if place[:inside] == path
    }
    return Document(data, document.file, lines)


def _load_obstacle(
    document: Document, path: tuple[str | int, ...], item: schema.ObstacleSchema, folder: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    if isinstance(item, schema.UrdfSchema | schema.MeshSchema):
        _find_file(document, (*path, "file"), folder, item.file)
    with document.annotate_errors((*path, "file")):
        return make_obstacle_shapes(item, _make_pose(item), folder)
