"""Adds measured points to a scene: their frame, the removal of known ones, and their record."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_array
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.collision.distances import find_near_points
from vkc_pin.world.collision.point_cloud import divide_points
from vkc_pin.world.collision.solids import convert_solid, flatten_placements
from vkc_pin.world.files.points import MAX_POINTS, decode_points
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

if TYPE_CHECKING:
    from vkc_pin.world.models.robot import Robot
    from vkc_pin.world.scene import scene_schema as schema

OWN_DISTANCE = 0.03
"""Points this close to the robot or an object at the start count as theirs [m]."""
FLOOR_HEIGHT = 0.05
"""Points below this height count as the floor's, where a scene has one [m]."""
_LARGEST = 1e4  # [m] of coordinates: single precision resolves 1 mm there


Reason = Literal["robot", "objects", "floor", "not_finite"]


class Surroundings(NamedTuple):
    """The robot at its start, objects and the floor, whose points are no obstacles."""

    robot: Robot
    start: Floats
    opening: float | None
    held: tuple[PlacedObject, ...]
    others: tuple[PlacedObject, ...]
    floor: bool


class PointCounts(NamedTuple):
    """What became of the points of an obstacle.

    Attributes:
        kept: Points that are obstacles.
        robot: Points that were removed within 3 cm of the robot or a held object at the start.
        objects: Points that were removed within 3 cm of other objects as they are.
        floor: Points that were removed below 5 cm above the floor.
        not_finite: Points of a file that were removed since they are not finite.
    """

    kept: int
    robot: int = 0
    objects: int = 0
    floor: int = 0
    not_finite: int = 0


def check_points(points: Any, field: str = "points") -> Floats:
    """Return an array of points, shape (n, 3) [m].

    Raises:
        InputError: It has another shape, no or too many points, or one that is not finite.
    """
    array = check_array(points, field, "an array of shape (n, 3)")
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(
            "not an array of points", field=field, expected="the shape (n, 3)", got=array.shape
        )
    is_finite = np.isfinite(array).all(axis=1)
    if not is_finite.all():
        first = int(np.argmin(is_finite))
        raise InputError(
            f"{np.count_nonzero(~is_finite)} of {len(array)} points are not finite",
            field=f"{field}[{first}]",
            expected="finite numbers",
            got=array[first].tolist(),
        )
    check_count(array, field)
    return array


def check_count(points: Floats, field: str | None, file: Any = None) -> None:
    """Check number and size of finite points, shape (n, 3) [m]."""
    if not len(points):
        raise InputError("no points", file=file, field=field, expected="at least one point")
    if len(points) > MAX_POINTS:
        expected = f"at most {MAX_POINTS}, e.g. one in each cube of 1 cm"
        raise InputError(
            "too many points", file=file, field=field, expected=expected, got=len(points)
        )
    largest = np.abs(points).max(axis=1)
    if largest.max() > _LARGEST:
        first = int(np.argmax(largest))
        place = f"{field}[{first}]" if field else f"point {first}"
        raise InputError(
            "a point is too far away",
            file=file,
            field=place,
            expected=f"coordinates up to {_LARGEST:g} m",
            got=points[first].tolist(),
        )


def remove_known_points(
    points: Floats, radius: float, around: Surroundings
) -> tuple[Floats, PointCounts]:
    """Return points without those of the robot, of objects and of the floor.

    Args:
        points: Finite points in the world frame, shape (n, 3) [m].
        radius: Radius of each [m].
        around: Shapes whose points are removed.

    Raises:
        InputError: No point is left.
    """
    # Single precision, as in files of scenes and plans, which restore the same obstacles.
    points = points.astype(np.float32).astype(float)
    is_floor = np.zeros(len(points), bool)
    if around.floor:
        is_floor = points[:, 2] < FLOOR_HEIGHT
    robot_shapes = [*_place_robot(around), *_place_objects(around.held)]
    is_robot = ~is_floor & _find_own_points(points, radius, robot_shapes)
    object_shapes = _place_objects(around.others)
    is_object = ~(is_floor | is_robot) & _find_own_points(points, radius, object_shapes)
    is_kept = ~(is_floor | is_robot | is_object)
    counts = PointCounts(
        kept=int(np.count_nonzero(is_kept)),
        robot=int(np.count_nonzero(is_robot)),
        objects=int(np.count_nonzero(is_object)),
        floor=int(np.count_nonzero(is_floor)),
    )
    if not counts.kept:
        raise InputError(
            f"no points are left: {counts.robot} are within {OWN_DISTANCE} m of the robot or of a "
            f"held object, {counts.objects} of other objects, {counts.floor} below "
            f"{FLOOR_HEIGHT} m above the floor",
            field="points",
            expected="points of obstacles in the world frame",
        )
    return points[is_kept], counts


_Shape = tuple[coal.CollisionGeometry, pin.SE3]


def _place_robot(around: Surroundings) -> list[_Shape]:
    """Return the shapes of the robot at its start, in the world frame."""
    robot = around.robot
    geometry = robot.opened(robot.opening(around.opening)).collision
    geometry_data = geometry.createData()
    q = robot.coordinates.q(around.start)
    pin.updateGeometryPlacements(robot.model, robot.model.createData(), geometry, geometry_data, q)
    geometries = [shape.geometry for shape in geometry.geometryObjects]
    return list(zip(geometries, geometry_data.oMg, strict=True))


def _place_objects(objects: Iterable[PlacedObject]) -> list[_Shape]:
    """Return the shapes of objects in the world frame."""
    found = list[_Shape]()
    for placed in objects:
        found += [(shape.geometry, shape.placement) for shape in make_world_shapes(placed)]
    return found


def _find_own_points(points: Floats, radius: float, shapes: Iterable[_Shape]) -> Bools:
    """Return which points are near one of some shapes, shape (n,)."""
    is_near = np.zeros(len(points), bool)
    reach = OWN_DISTANCE + radius
    for shape, placement in shapes:
        lower, upper = compute_world_box(shape, placement)
        is_in_box = ((points > lower - reach) & (points < upper + reach)).all(axis=1)
        inside = np.flatnonzero(is_in_box & ~is_near)
        if len(inside):
            row = flatten_placements([placement])[0]
            is_near[inside] = find_near_points(convert_solid(shape), row, points[inside], reach)
    return is_near


def make_cloud_shapes(
    item: schema.PointsSchema, pose: pin.SE3
) -> tuple[list[pin.GeometryObject], list[pin.GeometryObject]]:
    """Return the visual and the collision shapes of measured points, in the world frame."""
    # The schema checks both.
    assert item.data is not None
    assert item.radius is not None
    points = check_points(decode_points(item.data), "data")
    visual = list[pin.GeometryObject]()
    collision = list[pin.GeometryObject]()
    for k, (cloud, center) in enumerate(divide_points(points, item.radius)):
        placement = pose * pin.SE3(np.eye(3), center)
        for group in (visual, collision):
            shape = pin.GeometryObject(f"{item.name}_{k}", 0, 0, placement, cloud)
            shape.meshColor = np.array(item.colour)
            shape.overrideMaterial = True
            group.append(shape)
    return visual, collision


def get_counts(item: schema.PointsSchema) -> PointCounts:
    """Return what became of the points of an obstacle."""
    assert item.data is not None
    removed = item.removed
    return PointCounts(
        kept=len(decode_points(item.data)),
        robot=removed.get("robot", 0),
        objects=removed.get("objects", 0),
        floor=removed.get("floor", 0),
        not_finite=removed.get("not_finite", 0),
    )


def summarize_removals(counts: PointCounts) -> dict[Reason, int]:
    """Return the numbers of removed points, without zeros."""
    removed: dict[Reason, int] = {
        "robot": counts.robot,
        "objects": counts.objects,
        "floor": counts.floor,
        "not_finite": counts.not_finite,
    }
    return {reason: number for reason, number in removed.items() if number}
