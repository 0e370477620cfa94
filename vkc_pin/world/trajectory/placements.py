"""Samples the placements of all joints and the paths of base and tool along a motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import divide_intervals
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# Largest step between key frames [rad], [m]; beyond π an interpolated rotation would reverse.
_TURN = 1.0
# The same while free objects are carried, which a viewer moves along chords: arcs with a radius of
# 1.5 m are up to 1.5·0.15²/8 = 4 mm away from theirs.
_CARRYING_TURN = 0.15
# Distance of a curve from straight lines between key frames [rad], [m]: at 1 m from a joint, as
# much as a pixel shows of a room.
_BEND = 0.005


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the world, sampled.

    Attributes:
        times: Shape (K,) [s].
        local: Placement of every joint in its parent joint's frame: [joint][k].
        world: Placement of every joint in the world frame, shape (K, joints, 4, 4); the universe is
            joint 0.
        tool: Path of the tool frame's origin in the world frame, shape (K, 3) [m].
        base: Path of the base's origin in the world frame, shape (K, 3) [m].
        moving: For every joint, whether its placement in its parent changes.
    """

    times: Floats
    local: list[list[pin.SE3]]
    world: Floats
    tool: Floats
    base: Floats
    moving: Bools

    def away(self, joints: Bools, row: int) -> Bools:
        """Return the times, shape (K,), at which a joint is far from its placement at `row`.

        Far means 0.15 m, where rotations count with a lever arm of 0.5 m.
        """
        difference = np.abs(self.world[:, joints] - self.world[row, joints])
        turn = difference[..., :3, :3].max(axis=(1, 2, 3))
        shift = difference[..., :3, 3].max(axis=(1, 2))
        return np.asarray((0.5 * turn > 0.15) | (shift > 0.15))


def key_times(trajectory: Trajectory, strides: Mapping[str, float] | None = None) -> Floats:
    """Return the times of key frames between which a viewer may interpolate, shape (K,) [s].

    They include all waypoints. Without a curve, interpolated joint positions and quaternions are
    exact; a curve is up to 5 mm or 5 mrad away from them.

    Args:
        trajectory: The motion.
        strides: Coordinate → its largest step between key frames [rad], [m]. Default: 1.
    """
    max_steps = np.array([(strides or {}).get(name, _TURN) for name in trajectory.names])
    waypoints = trajectory.times
    curve = trajectory.curve
    if curve is None:
        speeds = np.abs(trajectory.velocities())
        counts = _count_pieces(waypoints, speeds, 0.0 * speeds, max_steps)
        return divide_intervals(waypoints, counts)
    speeds, accelerations = curve.compute_max_rates()
    first = np.searchsorted(curve.times, waypoints[:-1])  # knots that are waypoints
    speeds_between = np.maximum.reduceat(speeds, first)
    accelerations_between = np.maximum.reduceat(accelerations, first)
    counts = _count_pieces(waypoints, speeds_between, accelerations_between, max_steps)
    counts_of_cubics = _count_pieces(curve.times, speeds, accelerations, max_steps)
    # Where velocities jump within a short cubic, it takes less to divide every cubic alone.
    divides_cubics = np.add.reduceat(counts_of_cubics, first) < counts
    is_edge = np.repeat(divides_cubics, np.diff([*first, len(speeds)]))
    counts_of_cubics[first] = np.where(divides_cubics, counts_of_cubics[first], counts)
    is_edge[first] = True
    edges = np.append(curve.times[:-1][is_edge], curve.times[-1])
    return divide_intervals(edges, counts_of_cubics[is_edge])


def _count_pieces(times: Floats, speeds: Floats, accelerations: Floats, max_steps: Floats) -> Ints:
    """Return into how many pieces to divide each interval between times, shape (K − 1,).

    Args:
        times: Shape (K,) [s].
        speeds: Largest ones in each interval, shape (K − 1, n).
        accelerations: Largest ones in each interval, shape (K − 1, n).
        max_steps: Largest step of each coordinate, shape (n,).
    """
    durations = np.diff(times)[:, None]
    steps = durations * speeds / max_steps
    # A function f is up to h²/8·max |f″| away from a line through two of its points, h apart.
    bends = durations * np.sqrt(accelerations / (8.0 * _BEND))
    counts = np.ceil(np.maximum(steps, bends).max(axis=1) - 1e-9)
    return np.maximum(counts, 1.0).astype(int)


def sample_motion(
    world: World,
    trajectory: Trajectory | None,
    times: Floats | None = None,
    *,
    step: float | None = None,
) -> Motion:
    """Sample a motion; without a motion, return the start.

    Args:
        world: The scene as one tree.
        trajectory: The motion.
        times: Shape (K,) [s]. Default: those of key frames.
        step: Largest step between key frames [rad], [m]. Default: the largest with which
            viewers follow the motion.
    """
    if trajectory is None:
        times = np.zeros(1)
        rows = world.start[None]
    else:
        if step is None:
            carries = _carries_free_objects(world.scene, trajectory)
            step = _CARRYING_TURN if carries else _TURN
        steps = world.coordinates.compute_max_steps(step, step).tolist()
        strides = dict(zip(world.coordinates.names, steps, strict=True))
        times = key_times(trajectory, strides) if times is None else np.asarray(times, float)
        rows = world.compute_positions(trajectory, times)
    model = world.model
    data = model.createData()
    tool = model.getFrameId(world.scene.robot.tool_frame)
    local: list[list[pin.SE3]] = [[] for _ in range(model.njoints)]
    placements = np.tile(np.eye(4), (len(rows), model.njoints, 1, 1))
    tools = np.zeros((len(rows), 3))
    for k, q in enumerate(world.coordinates.q(rows)):
        pin.forwardKinematics(model, data, q)
        for j in range(1, model.njoints):
            local[j].append(data.liMi[j].copy())
            placements[k, j] = data.oMi[j].homogeneous
        tools[k] = pin.updateFramePlacement(model, data, tool).translation
    changes = np.abs(rows - rows[0]).max(axis=0) > 1e-9
    return Motion(
        times=np.asarray(times),
        local=local,
        world=placements,
        tool=tools,
        base=placements[:, 1, :3, 3].copy(),
        moving=world.coordinates.find_moved_joints(changes),
    )


def _carries_free_objects(scene: Scene, trajectory: Trajectory) -> bool:
    """Return whether a free object is held, or may rest on a link that is moved."""
    is_free = any(placed.object.free for placed in scene.objects.values())
    return is_free and any(phase.holds for phase in trajectory.phases)
