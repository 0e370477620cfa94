"""Samples the placements of all joints and the paths of base and tool along a motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Motion", "key_times", "sample_motion"]

# Largest step between key frames [rad], [m]; beyond π an interpolated rotation would reverse.
_TURN = 1.0


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
        turned, shifted = difference[..., :3, :3], difference[..., :3, 3]
        return np.asarray(
            (0.5 * turned.max(axis=(1, 2, 3)) > 0.15) | (shifted.max(axis=(1, 2)) > 0.15)
        )


def key_times(trajectory: Trajectory, strides: Mapping[str, float] | None = None) -> Floats:
    """Return waypoint times and intermediate times at most 1 rad or m apart, shape (K,) [s].

    Between these times a viewer's interpolation of joint positions and quaternions is exact.
    """
    most = [(strides or {}).get(name, _TURN) for name in trajectory.names]
    steps = np.abs(np.diff(trajectory.positions, axis=0) / most).max(axis=1)
    counts = np.maximum(1, np.ceil(steps)).astype(int)
    edges = zip(trajectory.times[:-1], trajectory.times[1:], counts, strict=True)
    return np.concatenate(
        [*(np.linspace(a, b, n, endpoint=False) for a, b, n in edges), trajectory.times[-1:]]
    )


def sample_motion(
    world: World, trajectory: Trajectory | None, times: Floats | None = None
) -> Motion:
    """Sample a motion at `times`, (K,) [s], or at key times; without a motion, the start."""
    if trajectory is None:
        times, rows = np.zeros(1), world.start[None]
    else:
        steps = world.coordinates.compute_max_steps(_TURN, _TURN).tolist()
        strides = dict(zip(world.coordinates.names, steps, strict=True))
        times = key_times(trajectory, strides) if times is None else np.asarray(times, float)
        rows = world.compute_positions(trajectory, times)
    model, data = world.model, world.model.createData()
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
    moving = world.coordinates.find_moved_joints(np.abs(rows - rows[0]).max(axis=0) > 1e-9)
    return Motion(
        np.asarray(times), local, placements, tools, placements[:, 1, :3, 3].copy(), moving
    )
