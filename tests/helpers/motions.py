"""Makes random motions, and computes distances of their pairs by brute force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from helpers.carrying import MotionBuilder, describe_table, make_room
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.collisions import PairTable
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory


def make_random_door_motion(scene: Scene, seed: int, *, size: float) -> Trajectory:
    """Return a random motion of four waypoints near the door, with joint steps up to `size`."""
    rng = np.random.default_rng(seed)
    door = scene.objects["door"].object
    first = np.concatenate([scene.start, [0.6, 0.3]])
    first[:3] = rng.uniform([0.6, -0.8, -np.pi], [2.0, 0.8, np.pi])
    first[3:9] += rng.uniform(-1.0, 1.0, 6)
    rows = [first]
    for _ in range(3):
        rows.append(
            rows[-1]
            + size * rng.uniform(-1.0, 1.0, len(first)) * rng.choice([0.0, 0.1, 1.0], len(first))
        )
    positions = np.array(rows)
    positions[:, 9:] = np.clip(positions[:, 9:], door.lower, door.upper)
    names = (*scene.robot.coordinates.names, "door.hinge", "door.knob")
    return Trajectory(
        names, np.arange(4.0), positions, (PhaseSpan("all", 0, 3, (Hold("door", "handle"),)),), 9
    )


def compute_all_distances(table: PairTable, z: np.ndarray) -> np.ndarray:
    """Return the distances of all pairs, shape (S, P), by Pinocchio and coal without culling."""
    geometry = table.world.collision.copy()
    for first, second in table.pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(first, second))
    model = table.world.model
    data = table.world.model.createData()
    shapes = pin.GeometryData(geometry)
    out = np.empty((len(z), len(table.pairs)))
    for row, q in enumerate(table.world.coordinates.q(z)):
        pin.updateGeometryPlacements(model, data, geometry, shapes, q)
        pin.computeDistances(geometry, shapes)
        out[row] = [result.min_distance for result in shapes.distanceResults]
    return out


def get_pair_names(table: PairTable, k: int) -> tuple[str, str]:
    first, second = table.pairs[k]
    return table.world.collision_labels[first], table.world.collision_labels[second]


def make_random_stick_motion(
    seed: int, *, size: float, scene: Scene | None = None
) -> tuple[Scene, Trajectory]:
    """Return a random motion of two phases with a stick and a ball on its tip, five waypoints."""
    rng = np.random.default_rng(seed)
    scene = make_room(describe_table(), objects=("stick", "ball")) if scene is None else scene
    scene = scene.with_held({"stick": "grip", "ball": "pull"}, by={"ball": "stick.tip"})
    script = MotionBuilder(scene)
    for phase in range(2):
        if phase:
            script.let_go("ball")
        there = np.array(script.rows[-1])
        there += size * rng.uniform(-1.0, 1.0, len(there)) * rng.choice([0.0, 0.1, 1.0], len(there))
        script.go(there, steps=2)
    return scene, script.motion()


def make_object_motion(
    scene: Scene,
    owner: str,
    *phases: PhaseSpan,
    dt: float = 1.0,
    **values: Sequence[float] | Floats,
) -> Trajectory:
    """Return a motion of an object's coordinates, with the robot at rest."""
    count = len(next(iter(values.values())))
    robot = scene.robot.coordinates.names
    rows = np.column_stack([np.tile(scene.start, (count, 1)), *values.values()])
    names = (*robot, *(f"{owner}.{name}" for name in values))
    phases = phases or (PhaseSpan("move", 0, count - 1),)
    return Trajectory(names, dt * np.arange(count), rows, phases, len(robot))
