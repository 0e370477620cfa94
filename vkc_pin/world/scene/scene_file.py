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
from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.pickling import freeze
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.points import DEFAULT_RADIUS, encode_points, read_points
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.srdf import format_names, read_allowed_pairs
from vkc_pin.world.models.grafting import round_placement
from vkc_pin.world.models.measured_joint import MeasuredJoint
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
from vkc_pin.world.scene.map_obstacles import MAP, MapObstacle
from vkc_pin.world.scene.measured_points import (
    PointCounts,
    Surroundings,
    remove_known_points,
    summarize_removals,
)
from vkc_pin.world.scene.obstacles import (
    FLOOR,
    make_floor_shape,
    make_obstacle_shapes,
    move_obstacle_shape,
)
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.robot_velocity import make_robot_velocity


def make_scene_fields(document: Document, folder: Path) -> dict[str, Any]:
    """Return the attributes of the `Scene` that `document` describes, by name."""
    description = parse_document(document, schema.SceneSchema)
    robot = _load_robot(document, description, folder)
    _check_unique_names(document, description)
    objects = dict[str, PlacedObject]()
    for index, placed_item in enumerate(description.objects):
        placed = _load_object(document, ("objects", index), placed_item, folder)
        objects[placed_item.name] = placed
    start = _make_start(document, description.start, robot)
    start_velocity = _make_start_velocity(document, description.start, robot, start)
    holds = _make_holds(document, description.start.held, objects, robot, start)
    around = find_surroundings(
        robot=robot,
        start=start,
        opening=description.start.opening,
        objects=objects,
        holds=holds,
        floor=description.floor,
    )
    description = _load_points(document, description, folder, around)
    map_obstacle = _load_map(document, description.map, folder)
    arena = _make_arena(description.arena, map_obstacle)
    obstacles = list[pin.GeometryObject]()
    labels = list[str]()
    visual = list[pin.GeometryObject]()
    visual_labels = list[str]()
    for index, item in enumerate(description.obstacles):
        visual_shapes, shapes = _load_obstacle(document, ("obstacles", index), item, folder)
        visual += visual_shapes
        visual_labels += [item.name] * len(visual_shapes)
        obstacles += shapes
        labels += [item.name] * len(shapes)
    if map_obstacle is not None:
        with document.annotate_errors(("map",)):
            map_shapes = map_obstacle.make_shapes(arena)
        visual += map_shapes
        visual_labels += [MAP] * len(map_shapes)
        obstacles += map_shapes
        labels += [MAP] * len(map_shapes)
    if description.floor:
        obstacles.append(make_floor_shape(arena))
        labels.append(FLOOR)
    _check_within_arena(document, description, arena)
    return {
        "name": description.name or (document.file.stem if document.file else "scene"),
        "file": document.file,
        "folder": folder,
        "robot": robot,
        "start": start,
        "start_velocity": start_velocity,
        "objects": freeze(objects),
        "obstacles": tuple(obstacles),
        "obstacle_labels": tuple(labels),
        "obstacle_names": tuple(item.name for item in description.obstacles),
        "obstacle_visual": tuple(visual),
        "obstacle_visual_labels": tuple(visual_labels),
        "floor": description.floor,
        "arena": arena,
        "start_region": description.start_region,
        "holds": holds,
        "allowed": freeze(_find_allowed_pairs(document, description, folder, robot, objects)),
        "described": description,
        "opening": description.start.opening,
    }


def find_surroundings(
    *,
    robot: Robot,
    start: Floats,
    opening: float | None,
    objects: Mapping[str, PlacedObject],
    holds: Sequence[Hold],
    floor: bool,
) -> Surroundings:
    """Return what measured points are compared with; the arguments are attributes of a scene."""
    placed = place_held_objects(objects, lambda: compute_tool_placement(robot, start), holds)
    names = [hold.object for hold in holds]
    held = tuple(placed[name] for name in names)
    others = tuple(one for name, one in placed.items() if name not in names)
    return Surroundings(robot, start, opening, held, others, floor)


def add_points(
    fields: Mapping[str, Any], name: str, points: Floats, radius: float, counts: PointCounts
) -> dict[str, Any]:
    """Return the attributes of a scene that change when measured points are added, by name.

    Args:
        fields: Attributes of a `Scene`, by name.
        name: Name of the obstacle; measured points of that name are replaced.
        points: Points in the world frame, shape (n, 3) [m].
        radius: Radius of each [m].
        counts: What became of the points.
    """
    described = fields["described"]
    item = schema.PointsSchema(
        name=name,
        type="points",
        radius=radius,
        data=encode_points(points),
        removed=summarize_removals(counts),
    )
    others = [one for one in described.obstacles if one.name != name]
    changed = {"described": described.model_copy(update={"obstacles": (*others, item)})}
    changed["obstacle_names"] = (*(one.name for one in others), name)
    visual_shapes, shapes = make_obstacle_shapes(item, _make_pose(item), fields["folder"])
    for key, added in (("obstacle", shapes), ("obstacle_visual", visual_shapes)):
        shapes_key = "obstacles" if key == "obstacle" else key
        labels_key = f"{key}_labels"
        kept_shapes = []
        kept_labels = []
        floor_shapes = []
        for shape, label in zip(fields[shapes_key], fields[labels_key], strict=True):
            if label == FLOOR:
                floor_shapes.append(shape)
            elif label != name:
                kept_shapes.append(shape)
                kept_labels.append(label)
        # The floor is last, as in a scene from a file.
        changed[shapes_key] = (*kept_shapes, *added, *floor_shapes)
        floor_labels = [FLOOR] * len(floor_shapes)
        changed[labels_key] = (*kept_labels, *[name] * len(added), *floor_labels)
    return changed


def allow_pair(fields: Mapping[str, Any], pair: tuple[str, str], margin: float) -> dict[str, Any]:
    """Return the attributes of a scene that change when two links may be close, by name.

    Args:
        fields: Attributes of a `Scene`, by name.
        pair: Labels of the links.
        margin: Distance that they keep [m].

    Raises:
        UnknownNameError: There is no such link.
    """
    described = fields["described"]
    labels, _ = _list_labels(described, fields["robot"], fields["objects"])
    links = [label for label in labels if labels[label] == [label]]
    for name, argument in zip(pair, ("first", "second"), strict=True):
        check_choice(name, links, "link", argument)
    key = frozenset(pair)
    least = min(margin, fields["allowed"].get(key, np.inf))
    item = schema.AllowSchema(pair=pair, margin=least)
    return {
        "allowed": freeze({**fields["allowed"], key: least}),
        "described": described.model_copy(update={"allow": (*described.allow, item)}),
    }


def make_document(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain data from which `make_scene_fields` builds the same attributes again.

    Objects that still are where the description put them keep its fields; the others are described
    by position and rpy.

    Args:
        fields: Attributes of a `Scene`, by name.
    """
    described = fields["described"]
    start = fields["start"]
    objects = fields["objects"]
    region = fields["start_region"]
    plain = described.model_dump(
        mode="json", include={"robot", "map", "obstacles", "objects", "allow"}, exclude_none=True
    )
    held = {hold.object: _describe_hold(hold, objects) for hold in fields["holds"]}
    for item, entry in zip(described.objects, plain["objects"], strict=True):
        _update_object_entry(entry, item, objects[item.name], is_held=item.name in held)
    start_entry: dict[str, Any] = {"base": start[:3].tolist()}
    if described.start.z is not None:
        start_entry["z"] = described.start.z
    if fields["opening"] is not None:
        start_entry["opening"] = fields["opening"]
    is_at_home = np.array_equal(start[3:], fields["robot"].home)
    if described.start.arm is not None or not is_at_home:
        start_entry["arm"] = start[3:].tolist()
    if fields["start_velocity"].any():
        names = fields["robot"].coordinates.names
        velocities = zip(names, fields["start_velocity"].tolist(), strict=True)
        start_entry["velocity"] = {name: value for name, value in velocities if value != 0.0}
    start_entry["held"] = held
    document = {
        "name": fields["name"],
        "robot": plain["robot"],
        "start": start_entry,
        "arena": {"x": list(fields["arena"][:2]), "y": list(fields["arena"][2:])},
    }
    if region:
        intervals = {key: list(value) for key, value in vars(region).items() if value}
        document["start_region"] = intervals
    document["floor"] = fields["floor"]
    if described.map is not None:
        document["map"] = plain["map"]
    document["obstacles"] = plain["obstacles"]
    document["objects"] = plain["objects"]
    if plain["allow"]:
        document["allow"] = plain["allow"]
    return document


def move_obstacle(fields: Mapping[str, Any], name: str, placement: pin.SE3) -> dict[str, Any]:
    """Return the attributes of a scene that change when an obstacle moves, by name.

    The moved obstacle is described by position and rpy, and placed as this description says, so
    that a saved scene has the same placement.

    Args:
        fields: Attributes of a `Scene`, by name.
        name: Name of the obstacle.
        placement: Its new placement in the world frame.
    """
    described = fields["described"]
    index = fields["obstacle_names"].index(name)
    item = described.obstacles[index]
    pose = {
        "position": tuple(placement.translation.tolist()),
        "rpy": tuple(pin.rpy.matrixToRpy(placement.rotation).tolist()),
        "yaw": None,
        "quaternion": None,
    }
    moved_item = item.model_copy(update=pose)
    before = _make_pose(item)
    after = _make_pose(moved_item)

    def move_shapes(
        shapes: Sequence[pin.GeometryObject], labels: Sequence[str]
    ) -> tuple[pin.GeometryObject, ...]:
        moved = list(shapes)
        for k, label in enumerate(labels):
            if label == name:
                moved[k] = move_obstacle_shape(item, shapes[k], before, after)
        return tuple(moved)

    obstacles = (
        *described.obstacles[:index],
        moved_item,
        *described.obstacles[index + 1 :],
    )
    return {
        "obstacles": move_shapes(fields["obstacles"], fields["obstacle_labels"]),
        "obstacle_visual": move_shapes(fields["obstacle_visual"], fields["obstacle_visual_labels"]),
        "described": described.model_copy(update={"obstacles": obstacles}),
    }


def _describe_hold(hold: Hold, objects: Mapping[str, PlacedObject]) -> dict[str, Any]:
    """Return a hold as plain data; see `scene_schema.HeldSchema`."""
    entry: dict[str, Any] = {"attachment": hold.attachment}
    if hold.frame is not None:
        entry["by"] = hold.frame
    if any(hold.at) or (hold.deviation and hold.at):
        entry["at"] = list(hold.at)
    if hold.deviation:
        grasp = get_attachment(objects, hold)
        entry["measured"] = _describe_pose(grasp.motion(hold.at).inverse())
    return entry


def _describe_pose(placement: pin.SE3) -> dict[str, Any]:
    """Return a placement as plain data; see `scene_schema.PoseSchema`."""
    pose = pin.SE3ToXYZQUAT(placement)
    return {"position": pose[:3].tolist(), "quaternion": pose[3:].tolist()}


def _update_object_entry(
    entry: dict[str, Any],
    item: schema.PlacedObjectSchema,
    placed: PlacedObject,
    *,
    is_held: bool,
) -> None:
    """Make the entry of an object that of the object as it is placed.

    Args:
        entry: Plain data of its description, changed in place.
        item: Its description.
        placed: The object.
        is_held: Whether the robot holds it.
    """
    names = placed.object.coordinates.names
    entry["state"] = dict(zip(names, placed.state.tolist(), strict=True))
    entry.pop("reversed", None)
    _update_measured_joints(entry, item, placed)
    is_in_hand = placed.object.free and is_held
    described_placement = _make_pose(item).homogeneous
    is_moved = not is_in_hand and not np.array_equal(
        placed.placement.homogeneous, described_placement
    )
    neutral = np.clip(0.0, placed.object.lower, placed.object.upper)
    described_state = {**dict(zip(names, neutral.tolist(), strict=True)), **item.state}
    is_as_described = not is_moved and entry["state"] == described_state and not placed.measured
    # Otherwise loading the document finds the same approaches again.
    if placed.reversed or item.reversed is not None or not is_as_described:
        entry["reversed"] = list(placed.reversed)
    if is_moved:
        for orientation in ("yaw", "quaternion"):
            entry.pop(orientation, None)
        entry["position"] = placed.placement.translation.tolist()
        entry["rpy"] = pin.rpy.matrixToRpy(placed.placement.rotation).tolist()


def _update_measured_joints(
    entry: dict[str, Any], item: schema.PlacedObjectSchema, placed: PlacedObject
) -> None:
    """Make the measured joints in the entry of an object those of the object as it is placed."""
    described = entry.pop("measured")
    joints = dict[str, Any]()
    for joint, measured in placed.measured.items():
        joints[joint] = {
            "placement": _describe_pose(measured.placement),
            "link": _describe_pose(measured.link),
        }
        if joint in item.measured:
            before = _make_measured_joint(item.measured[joint])
            if before.placement == measured.placement and before.link == measured.link:
                joints[joint] = described[joint]
    if joints:
        entry["measured"] = joints


def _load_map(
    document: Document, item: schema.MapSchema | None, folder: Path
) -> MapObstacle | None:
    if item is None:
        return None
    is_short = isinstance(document.data["map"], str)  # map: map.yaml
    path = ("map",) if is_short else ("map", "file")
    _find_file(document, path, folder, item.file)
    with document.annotate_errors(path):
        return MapObstacle(item, folder)


def _make_arena(
    item: schema.ArenaSchema | None, map_obstacle: MapObstacle | None
) -> tuple[float, float, float, float]:
    """Return the stated arena, else that of the map, else the default, as in `Scene.arena`."""
    if item is None and map_obstacle is not None:
        return map_obstacle.bounds
    stated = schema.ArenaSchema() if item is None else item
    return (*stated.x, *stated.y)


def _load_robot(document: Document, description: schema.SceneSchema, folder: Path) -> Robot:
    item = description.robot
    is_path = item.name.endswith((".urdf", ".yaml", ".yml")) or "/" in item.name
    is_short = isinstance(document.data["robot"], str)  # robot: husky_ur5e
    with document.annotate_errors(("robot",) if is_short else ("robot", "name")):
        return load_robot(
            folder / item.name if is_path else item.name,
            base=item.base,
            tool_frame=item.tool_frame,
            height=description.start.z,
            turning_radius=item.turning_radius,
        )


def _check_unique_names(document: Document, description: schema.SceneSchema) -> None:
    used = {FLOOR: "the floor"}
    if description.map is not None:
        used[MAP] = "the map"
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
            place = f"{group}[{index}]"
            line = document.find_line(path)
            used[item.name] = f"{place} in line {line}" if line else place


def _check_within_arena(
    document: Document, description: schema.SceneSchema, arena: tuple[float, float, float, float]
) -> None:
    x_min, x_max, y_min, y_max = arena
    for index, (axis, low, high) in enumerate((("x", x_min, x_max), ("y", y_min, y_max))):
        expected = f"{axis} from {low:g} to {high:g}"
        value = description.start.base[index]
        if not low <= value <= high:
            raise document.make_error(
                ("start", "base", index), "outside the arena", expected=expected, got=value
            )
        interval = getattr(description.start_region, axis, None)
        if interval is not None and not low <= interval[0] <= interval[1] <= high:
            raise document.make_error(
                ("start_region", axis), "outside the arena", expected=expected, got=list(interval)
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


def _make_start_velocity(
    document: Document, item: schema.StartSchema, robot: Robot, start: Floats
) -> Floats:
    names = robot.coordinates.names
    for name in item.velocity:
        if name not in names:
            kind = f"coordinate of robot '{robot.name}'"
            path = ("start", "velocity", name)
            raise document.make_unknown_name_error(path, kind, name, names)
    with document.annotate_errors(("start", "velocity")):
        return make_robot_velocity(robot, start, item.velocity)


def _fill_arm(document: Document, given: Mapping[str, float], robot: Robot) -> list[float]:
    """Return the values of all arm joints; those that are not named are at home."""
    names = robot.coordinates.names[3:]
    for joint in given:
        if joint not in names:
            kind = f"arm joint of robot '{robot.name}'"
            raise document.make_unknown_name_error(("start", "arm", joint), kind, joint, names)
    home = dict(zip(names, robot.home.tolist(), strict=True))
    return [given.get(joint, home[joint]) for joint in names]


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
        # Each hold alone, with the object through which it holds: errors name its entry.
        with document.annotate_errors(path):
            own_attachments = {name: attachments[name]}
            own_by = {}
            if name in by:
                carrier, _, _ = by[name].partition(".")
                own_by[name] = by[name]
                if carrier in held:
                    own_attachments = {carrier: attachments[carrier], name: attachments[name]}
            own_at = {name: at[name]} if name in at else {}
            resolve_holds(objects, make_holds(own_attachments, own_by, own_at))
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
    placed_in_hand = [hold for hold in holds if held[hold.object].measured != "derive"]
    measured_objects = place_held_objects(objects, tool, placed_in_hand)
    found = {}
    for hold in holds:
        stated = held[hold.object].measured
        if stated == "derive":
            found[hold.object] = measure_grasp(measured_objects, hold, tool)
        elif stated is not None:
            found[hold.object] = _make_pose(stated)
    return found


def _find_allowed_pairs(
    document: Document,
    description: schema.SceneSchema,
    folder: Path,
    robot: Robot,
    objects: Mapping[str, PlacedObject],
) -> dict[frozenset[str], float]:
    """Return pairs of link labels that may be close → margin [m]; the smallest of several."""
    labels, srdf_labels = _list_labels(description, robot, objects)
    robot_links = list(robot.links)
    other_links = [name for name in srdf_labels if name not in robot_links]
    found: dict[frozenset[str], float] = {}
    for number, item in enumerate(description.allow):
        path: tuple[str | int, ...] = ("allow", number)
        data = document.data["allow"][number]
        pairs: Iterable[tuple[str, str]] = []
        names = labels
        if item.pair is not None:
            if not isinstance(data, list | tuple):
                path = (*path, "pair")
            pairs = [item.pair]
        elif item.srdf is not None:
            if not isinstance(data, str):
                path = (*path, "srdf")
            file = _find_file(document, path, folder, item.srdf)
            pairs = _read_allowed_pairs(file, [robot_links, other_links])
            names = srdf_labels
        margin = -np.inf if item.margin is None else item.margin
        for pair in pairs:
            for place, name in enumerate(pair):
                if name not in names:
                    kind = "link, object or obstacle"
                    raise document.make_unknown_name_error((*path, place), kind, name, names)
            first, second = pair
            for labels_of_pair in itertools.product(names[first], names[second]):
                key = frozenset(labels_of_pair)
                found[key] = min(margin, found.get(key, np.inf))
    return found


def _list_labels(
    description: schema.SceneSchema, robot: Robot, objects: Mapping[str, PlacedObject]
) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return the names that `allow` knows, and those that its SRDFs know → their labels.

    The name of an object stands for all its links.
    """
    labels = {link: [link] for link in robot.links}
    labels_by_link = dict[str, list[str]]()  # by the name of a link without its object
    for name, placed in objects.items():
        own_labels = list[str]()
        for link in placed.object.links:
            label = f"{name}.{link}"
            own_labels.append(label)
            labels[label] = [label]
            same_link = labels_by_link.setdefault(link, [])
            same_link.append(label)
        labels[name] = own_labels
    for item in description.obstacles:
        labels[item.name] = [item.name]
    if description.map is not None:
        labels[MAP] = [MAP]
    if description.floor:
        labels[FLOOR] = [FLOOR]
    # In an SRDF, the name of a link stands for it without its object if it is the only one.
    srdf_labels = dict(labels)
    for link, same_link in labels_by_link.items():
        if len(same_link) == 1 and (link not in labels or link in objects):
            srdf_labels[link] = same_link
    return labels, srdf_labels


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
        expected = f"a file in {folder}"
        similar = _find_similar_name(file)
        if similar:
            expected += f", perhaps {Path(name).with_name(similar)}"
        raise document.make_error(path, "there is no such file", expected=expected, got=name)
    return file


def _find_similar_name(file: Path) -> str | None:
    """Return the most similar name in the folder of a missing file, among files of its type."""
    with contextlib.suppress(OSError):
        neighbours = [one.name for one in file.parent.iterdir() if one.suffix == file.suffix]
        return find_nearest_name(file.name, sorted(neighbours))
    return None


def _load_object(
    document: Document, path: tuple[str | int, ...], item: schema.PlacedObjectSchema, folder: Path
) -> PlacedObject:
    type_path = (*path, "type")
    with document.annotate_errors(type_path):
        if isinstance(item.type, dict):
            loaded = build_object(_extract_part(document, type_path), folder)
        elif item.type.endswith((".yaml", ".yml")) or "/" in item.type:
            loaded = load_object(_find_file(document, type_path, folder, item.type))
        else:
            loaded = load_object(item.type)
    neutral = np.clip(0.0, loaded.lower, loaded.upper)
    placed = PlacedObject(item.name, loaded, _make_pose(item), neutral)
    for joint, value in item.state.items():
        with document.annotate_errors((*path, "state", joint)):
            placed = placed.with_state({joint: value})
    for number, attachment in enumerate(item.reversed or ()):
        with document.annotate_errors((*path, "reversed", number)):
            placed = placed.with_reversed(attachment)
    for joint, one in item.measured.items():
        with document.annotate_errors((*path, "measured", joint)):
            placed = placed.with_measured_joint(joint, _make_measured_joint(one))
    return placed


def _make_measured_joint(item: schema.MeasuredJointSchema) -> MeasuredJoint:
    return MeasuredJoint(_make_pose(item.placement), _make_pose(item.link))


def _extract_part(document: Document, path: tuple[str | int, ...]) -> Document:
    """Return the data at `path` as a document of its own, with the same file and lines."""
    data = document.data
    for key in path:
        data = data[key]
    depth = len(path)
    lines = {}
    for place, line in document.lines.items():
        if place[:depth] == path:
            lines[place[depth:]] = line
    return Document(data, document.file, lines)


def _load_points(
    document: Document, description: schema.SceneSchema, folder: Path, around: Surroundings
) -> schema.SceneSchema:
    """Return the description with the points of files in it, without those of the robot."""
    obstacles = list(description.obstacles)
    for index, item in enumerate(obstacles):
        if not isinstance(item, schema.PointsSchema) or item.file is None:
            continue
        path = ("obstacles", index, "file")
        file = _find_file(document, path, folder, item.file)
        with document.annotate_errors(path):
            loaded = read_points(file)
            radius = item.radius
            if radius is None:
                radius = DEFAULT_RADIUS if loaded.radius is None else loaded.radius
            pose = _make_pose(item)
            world_points = loaded.points @ pose.rotation.T + pose.translation
            kept, counts = remove_known_points(world_points, radius, around)
        counts = counts._replace(not_finite=loaded.dropped)
        in_frame = (kept - pose.translation) @ pose.rotation
        update = {
            "file": None,
            "radius": radius,
            "data": encode_points(in_frame),
            "removed": summarize_removals(counts),
        }
        obstacles[index] = item.model_copy(update=update)
    return description.model_copy(update={"obstacles": tuple(obstacles)})


def _load_obstacle(
    document: Document, path: tuple[str | int, ...], item: schema.ObstacleSchema, folder: Path
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    if isinstance(item, schema.UrdfSchema | schema.MeshSchema):
        _find_file(document, (*path, "file"), folder, item.file)
    with document.annotate_errors((*path, "file")):
        return make_obstacle_shapes(item, _make_pose(item), folder)
