"""Finds where cameras of the robot see a point, and where the robot itself is in between."""

from __future__ import annotations

from collections.abc import Iterator

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.models.camera import Camera
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.terms import Sight
from vkc_pin.world.task.views import Target, make_sight
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [m] at the ends of a line of sight that do not count: of the camera's housing, and of the target
_HOUSING = 0.05
_SEEN = 0.1
_THICKNESS = 1e-4  # [m], radius of the capsule that stands for a line


def compute_visibility(
    scene: Scene, trajectory: Trajectory, camera: Camera, target: Target, times: Floats
) -> Bools:
    """Return at which times a camera of the robot sees a point, shape (T,).

    The point is inside the image, 5 cm before the camera or more, and no link of the robot but the
    camera's own is in between. Objects and obstacles, and the first 5 cm of the line of sight and
    its last 10 cm, do not count.

    Args:
        scene: Scene at the start.
        trajectory: Motion of the scene.
        camera: The camera.
        target: The point, as for `keep_in_view`.
        times: Times of the motion, shape (T,) [s].

    Raises:
        UnknownNameError: The robot lacks the camera's frame, or the scene the target.
    """
    world = World(scene)
    sight = make_sight(scene, camera, target)
    rows = world.compute_positions(trajectory, times)
    configurations = world.coordinates.q(rows)
    model = world.model
    batch = BatchedModel.of_frames(model, [model.getFrameId(sight.frame)])
    rotations, origins = batch.compute_poses(configurations)
    points = _compute_points(model, configurations, sight.target, sight.point)
    in_frame = np.einsum("rji,rj->ri", rotations[:, 0], points - origins[:, 0])
    inside = (in_frame - camera.placement.translation) @ camera.placement.rotation
    depths = -inside[:, 2]
    height = np.tan(np.radians(camera.fov) / 2.0)
    width = height * camera.width / camera.height
    seen = depths >= _HOUSING
    seen &= np.abs(inside[:, 0]) <= width * depths
    seen &= np.abs(inside[:, 1]) <= height * depths
    for row, _ in find_occlusions(world, rows, sight, np.flatnonzero(seen)):
        seen[row] = False
    return np.asarray(seen)


def find_occlusions(world: World, z: Floats, sight: Sight, rows: Ints) -> Iterator[tuple[int, str]]:
    """Yield the configurations in which a link of the robot is before a point, and the link.

    The link of the camera never is. The first 5 cm of the line and its last 10 cm do not count.

    Args:
        world: The scene.
        z: Its minimal coordinates, shape (S, n).
        sight: The line of sight.
        rows: Rows of `z` to check, shape (R,).
    """
    model = world.model
    camera = model.frames[model.getFrameId(sight.frame)]
    robot_shapes = len(world.scene.robot.collision.geometryObjects)
    boxes = dict[int, tuple[Floats, float]]()  # by shape: centre in its frame, and radius around it
    for number, shape in enumerate(world.bodies.geometryObjects[:robot_shapes]):
        if shape.parentJoint != camera.parentJoint:
            center, half = compute_bounding_box(shape)
            boxes[number] = (center, float(np.linalg.norm(half)))
    configurations = world.coordinates.q(z[rows])
    placements = BatchedModel.of_shapes(model, world.bodies)
    rotations, origins = placements.compute_poses(configurations)
    begins = _compute_points(model, configurations, sight.frame, sight.position)
    ends = _compute_points(model, configurations, sight.target, sight.point)
    hands = _compute_points(model, configurations, sight.hand, (0.0, 0.0, 0.0))
    is_far = np.linalg.norm(ends - hands, axis=1) > sight.until
    lengths = np.linalg.norm(ends - begins, axis=1)
    for row in np.flatnonzero(is_far & (lengths > _HOUSING + _SEEN)):
        direction = (ends[row] - begins[row]) / lengths[row]
        length = float(lengths[row]) - _HOUSING - _SEEN
        middle = begins[row] + direction * (_HOUSING + length / 2.0)
        line = coal.Capsule(_THICKNESS, length)
        along = pin.SE3(pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction), middle)
        for number, (center, radius) in boxes.items():
            at = pin.SE3(rotations[row, number], origins[row, number])
            offset = at.act(center) - middle
            beside = offset - np.clip(offset @ direction, -length / 2.0, length / 2.0) * direction
            if np.linalg.norm(beside) > radius:
                continue
            solid = world.bodies.geometryObjects[number].geometry
            if compute_shape_distance(line, along, solid, at) <= 0.0:
                yield int(rows[row]), world.collision_labels[number]
                break


def _compute_points(
    model: pin.Model, configurations: Floats, frame: str, point: tuple[float, float, float]
) -> Floats:
    """Return the positions of a point of a frame ("": the world) in the world, shape (R, 3) [m]."""
    if not frame:
        return np.tile(np.array(point), (len(configurations), 1))
    batch = BatchedModel.of_frames(model, [model.getFrameId(frame)])
    rotations, origins = batch.compute_poses(configurations)
    return np.asarray(origins[:, 0] + rotations[:, 0] @ np.array(point), float)
