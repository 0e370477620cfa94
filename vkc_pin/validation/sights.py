"""Checks that the robot does not cross the lines of sight of its cameras."""

from __future__ import annotations

from collections.abc import Iterator

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.samples import Samples
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance
from vkc_pin.world.task.terms import Sight

# [m] at the ends of a line of sight that do not count: of the camera's housing, and of the target
_HOUSING = 0.05
_SEEN = 0.1
_THICKNESS = 1e-4  # [m], radius of the capsule that stands for a line


def find_occlusions(samples: Samples, sight: Sight, rows: Ints) -> Iterator[tuple[int, str]]:
    """Yield the samples at which a link of the robot is between a camera and a point, and the link.

    The link of the camera never is. The first 5 cm of the line and its last 10 cm do not count.

    Args:
        samples: Samples of the motion.
        sight: The line of sight.
        rows: Samples to check, shape (R,).
    """
    world = samples.world
    model = world.model
    camera = model.frames[model.getFrameId(sight.frame)]
    robot_shapes = len(world.scene.robot.collision.geometryObjects)
    boxes = dict[int, tuple[Floats, float]]()  # by shape: centre in its frame, and radius around it
    for number, shape in enumerate(world.bodies.geometryObjects[:robot_shapes]):
        if shape.parentJoint != camera.parentJoint:
            center, half = compute_bounding_box(shape)
            boxes[number] = (center, float(np.linalg.norm(half)))
    configurations = world.coordinates.q(samples.z[rows])
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
        line = coal.Capsule(_THICKNESS, length / 2.0)
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
