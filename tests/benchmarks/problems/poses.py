"""Samples collision-free starts and reachable tool poses in random rooms."""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.procedural.rooms.parts import Part
from vkc_pin.procedural.rooms.random_room import Layout
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box
from vkc_pin.world.scene.scene import Scene

CLEAR = 0.03  # [m] from everything, the robot itself too
NEAR = 0.15  # [m] from something, at most, for a pose among furniture
FAR = 1.5  # [m] from the start to where the robot stands, at least, for the same
_TRIES = 200_000  # configurations


def sample_pose_over(
    layout: Layout, scene: Scene, table: Part, rng: np.random.Generator
) -> pin.SE3:
    """Sample a tool pose over a table, within 0.5 m of its accessible side.

    Raises:
        InputError: No configuration was found.
    """
    depth, width, height = table.size
    into = pin.SE3(
        pin.rpy.rpyToMatrix(0.0, 0.0, table.frame.yaw),
        np.array([table.frame.x, table.frame.y, 0.0]),
    )
    own = into.inverse()
    for _ in range(_TRIES):
        ahead, side = rng.uniform((0.4, -0.6), (1.0, 0.6))
        base = (
            *table.frame.transform_point(-depth / 2.0 - ahead, side),
            rng.uniform(-np.pi, np.pi),
        )
        at, z = _sample_pose(scene, base, rng)
        x, y, up = own.act(at.translation)
        over = (
            -depth / 2.0 < x < min(-depth / 2.0 + 0.5, depth / 2.0)
            and abs(y) < width / 2.0
            and 0.05 < up - height < 0.45
        )
        if over and _free(scene, z):
            return at
    raise InputError(
        "no configuration reaches over the table",
        field="pose",
        expected=f"one of {_TRIES}",
        got=table.name,
    )


def sample_pose_among(layout: Layout, scene: Scene, rng: np.random.Generator) -> pin.SE3:
    """Sample a tool pose 0.2 to 1.4 m high where some of the robot is within `NEAR` of an obstacle.

    The base can turn there, and is connected with the start, at least `FAR` away.

    Raises:
        InputError: No configuration was found.
    """
    half = np.array([layout.floor.width, layout.floor.depth]) / 2.0
    standing = [part.footprint for part in layout.parts]
    for _ in range(_TRIES):
        x, y, yaw = rng.uniform([*-half, -np.pi], [*half, np.pi])
        apart = np.hypot(x - layout.start[0], y - layout.start[1]) >= FAR
        if not apart or not layout.floor.find_free(standing, layout.radius, [[x, y]])[0]:
            continue
        at, z = _sample_pose(scene, (x, y, yaw), rng)
        free = 0.2 < at.translation[2] < 1.4 and _free(scene, z, NEAR)
        if free and layout.floor.is_connected(standing, layout.radius, [layout.start[:2], (x, y)]):
            return at
    raise InputError(
        "no configuration is near anything",
        field="pose",
        expected=f"one of {_TRIES}",
        got=scene.name,
    )


def sample_random_start(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with a random base pose in its start region and a random arm posture.

    Raises:
        InputError: There is no start region, or no configuration was found.
    """
    if scene.start_region is None:
        raise InputError(
            "the scene has no start region",
            file=scene.file,
            field="start_region",
            expected="x and y intervals",
        )
    for x, y, yaw in itertools.islice(scene.start_region.sample_poses(rng), _TRIES):
        _, z = _sample_pose(scene, (x, y, yaw), rng)
        if _free(scene, z):
            return scene.with_start(base=z[:3], arm=z[3:])
    problem = f"no free configuration of the robot in {_TRIES} tries"
    raise InputError(
        problem,
        file=scene.file,
        field="start_region",
        expected=f"a clearance of {CLEAR} m somewhere",
    )


def _sample_pose(
    scene: Scene, base: tuple[float, float, float], rng: np.random.Generator
) -> tuple[pin.SE3, Floats]:
    """Return tool placement and configuration, shape (n,), with a random arm posture."""
    robot = scene.robot
    lower = np.maximum(robot.lower, -np.pi)[3:]
    upper = np.minimum(robot.upper, np.pi)[3:]
    z = np.concatenate([base, rng.uniform(lower, upper)])
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(z))
    return data.oMf[robot.model.getFrameId(robot.tool_frame)].copy(), z


def _free(scene: Scene, z: Floats, near: float = np.inf) -> bool:
    """Return whether the robot keeps `CLEAR` from everything, and is within `near` of the scene."""
    robot = scene.robot
    data = robot.model.createData()
    shapes = robot.collision.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.collision, shapes, robot.coordinates.q(z))
    geometry = robot.collision.geometryObjects
    for shape, where in zip(geometry, shapes.oMg, strict=True):
        if shape.parentJoint > 1 and compute_world_box(shape.geometry, where)[0][2] < CLEAR:
            return False
    for pair in robot.collision.collisionPairs:
        one, two = (geometry[k].geometry for k in (pair.first, pair.second))
        if (
            compute_shape_distance(one, shapes.oMg[pair.first], two, shapes.oMg[pair.second])
            < CLEAR
        ):
            return False
    try:
        there = scene.with_start(base=z[:3], arm=z[3:])
    except InputError:  # outside the arena
        return False
    clearance = there.start_clearance()
    return CLEAR <= clearance < near
