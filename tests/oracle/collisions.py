"""Checks the distances of all pairs along a phase, every 2 mm and 5 mrad.

A sample is skipped only if the pair cannot be in contact there. Bounding spheres of shapes and
bounding boxes of fixed shapes prove that for blocks of samples; the last computed distance, with a
bound on the relative motion since then, proves it for single samples.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .exemptions import CLEARANCE_SLACK, Exemption
from .neighbours import Neighbours
from .plan import Violation
from .poses import Poses, compute_angle
from .stage import FLOOR, Solid, Stage, World
from .supports import compute_distance

__all__ = ["CONTACT", "check_collisions"]

CONTACT = 1e-4  # [m] of penetration: rounding
BLOCK = 32  # samples


class Pairs:
    """The moving and fixed shapes of a phase, and the displacements of moving shapes.

    `displacements` bound the motion of any point of a moving shape from sample to sample, relative
    to the world, the robot's base and its tool, shape (3, S - 1). In each of the three frames, the
    sum of two displacements bounds the relative motion of two shapes.
    """

    def __init__(self, world: World, stage: Stage) -> None:
        self.world, self.stage = world, stage
        self.moving = [
            part
            for part in stage.solids
            if part.owner == "robot" or (part.owner, part.link) in stage.moving
        ]
        moving_ids = {id(part) for part in self.moving}
        self.fixed = [part for part in stage.solids if id(part) not in moving_ids]
        self.length = len(stage.times)
        base = stage.links["robot", world.robot.tree.urdf.base]
        frames = [None, base.inverse(), stage.tool.inverse()]
        self.fixed_rotations = np.array([part.poses.rotation[0] for part in self.fixed]).reshape(
            -1, 3, 3
        )
        self.fixed_centres = np.array(
            [part.poses.transform_point(part.shape.centre)[0] for part in self.fixed]
        ).reshape(-1, 3)
        self.fixed_half_sides = np.array([part.shape.half for part in self.fixed]).reshape(-1, 3)
        self.centres, self.displacements = [], []
        for part in self.moving:
            poses = Poses(
                np.broadcast_to(part.poses.rotation, (self.length, 3, 3)),
                np.broadcast_to(part.poses.translation, (self.length, 3)),
            )
            self.centres.append(poses.transform_point(part.shape.centre))
            self.displacements.append(
                np.array(
                    [
                        self._compute_steps(poses if frame is None else frame @ poses, part)
                        for frame in frames
                    ]
                )
            )

    @staticmethod
    def _compute_steps(poses: Poses, part: Solid) -> np.ndarray:
        centre = poses.transform_point(part.shape.centre)
        angles = compute_angle(poses.rotation[1:], poses.rotation[:-1])
        return np.linalg.norm(np.diff(centre, axis=0), axis=1) + angles * part.shape.radius

    def is_checked(self, one: Solid, other: Solid) -> bool:
        """Return whether a moving shape must not collide with another shape."""
        robot = self.world.robot
        if one.owner == other.owner:
            return one.owner == "robot" and robot.is_checked_pair(one.link, other.link)
        if other.owner != FLOOR:
            return True
        if one.owner == "robot":
            return one.link not in robot.base_links
        return self.world.objects[one.owner].free

    def compute_arcs(self, i: int) -> np.ndarray:
        """Return path lengths of a shape, absolute and relative to earlier ones, (1 + i, S)."""
        steps = [
            self.displacements[i][0],
            *((self.displacements[i] + self.displacements[j]).min(axis=0) for j in range(i)),
        ]
        return np.concatenate([np.zeros((1 + i, 1)), np.cumsum(steps, axis=1)], axis=1)

    def bound_fixed_distances(self, i: int, rows: np.ndarray) -> np.ndarray:
        """Return lower bounds of the distances to all fixed shapes, shape (rows, fixed shapes)."""
        local = np.einsum(
            "kba,rkb->rka",
            self.fixed_rotations,
            self.centres[i][rows][:, None] - self.fixed_centres,
        )
        excess = np.maximum(np.abs(local) - self.fixed_half_sides, 0.0)
        return np.sqrt(np.einsum("rka,rka->rk", excess, excess)) - self.moving[i].shape.radius

    def bound_moving_distances(self, i: int, j: int, rows: np.ndarray) -> np.ndarray:
        """Return lower bounds of the distance between two moving shapes, shape (rows,)."""
        distances = np.linalg.norm(self.centres[i][rows] - self.centres[j][rows], axis=1)
        return np.asarray(distances - self.moving[i].shape.radius - self.moving[j].shape.radius)


def check_collisions(
    world: World, stage: Stage, exemptions: list[Exemption], neighbours: Neighbours
) -> Iterator[Violation]:
    """Yield pairs that overlap ("overlap") or are too close at waypoints ("clearance")."""
    pairs = Pairs(world, stage)
    begins = np.arange(0, pairs.length, BLOCK)
    ends = np.append(begins[1:], pairs.length) - 1
    middles, waypoints = (begins + ends) // 2, stage.rows[1:]
    clearance, self_clearance = (
        float(world.plan.options[key]) - CLEARANCE_SLACK for key in ("dist_safe", "self_distance")
    )
    for i, one in enumerate(pairs.moving):
        arcs = pairs.compute_arcs(i)
        reach = np.maximum(arcs[:, ends] - arcs[:, middles], arcs[:, middles] - arcs[:, begins])
        active = pairs.bound_fixed_distances(i, middles) < reach[0][:, None]
        close = pairs.bound_fixed_distances(i, waypoints) < clearance
        candidates = np.flatnonzero(active.any(axis=0) | close.any(axis=0))
        todo = [(pairs.fixed[k], arcs[0], active[:, k], close[:, k]) for k in candidates]
        for j, other in enumerate(pairs.moving[:i]):
            bounds = (
                pairs.bound_moving_distances(i, j, middles),
                pairs.bound_moving_distances(i, j, waypoints),
            )
            todo.append(
                (
                    other,
                    arcs[1 + j],
                    bounds[0] < reach[1 + j],
                    bounds[1] < max(clearance, self_clearance),
                )
            )
        for other, arc, blocks, near in todo:
            if not pairs.is_checked(one, other):
                continue
            names = f"{one.label} - {other.label}"
            close, depths = neighbours.find_exempt_samples(stage, one, other)
            margin = neighbours.get_margin(one, other)
            required = min(
                self_clearance if one.owner == other.owner == "robot" else clearance,
                margin - CLEARANCE_SLACK,
            )
            for k in waypoints[near]:
                distance = compute_distance(
                    one.shape.solid, one.poses, other.shape.solid, other.poses, k
                )
                time = float(stage.times[k])
                exempt = any(
                    exemption.applies(one.label, other.label, time, distance)
                    for exemption in exemptions
                )
                if distance < required and not close[k] and not exempt:
                    yield Violation(
                        "clearance",
                        names,
                        time,
                        required - distance,
                        f"{1e3 * distance:.2f} mm apart at a waypoint",
                    )
            slack = CONTACT + np.maximum(depths, max(0.0, -margin))
            for exemption in exemptions:
                if exemption.depth and exemption.includes(one.label, other.label):
                    slack[(exemption.begin <= stage.times) & (stage.times <= exemption.end)] += (
                        exemption.depth
                    )
            depth, row = _find_deepest(one, other, arc, blocks, slack)
            if depth > 0.0:
                yield Violation(
                    "overlap",
                    names,
                    float(stage.times[row]),
                    depth,
                    f"overlap by {1e3 * depth:.2f} mm",
                )


def _find_deepest(
    one: Solid, other: Solid, arc: np.ndarray, active: np.ndarray, slack: np.ndarray
) -> tuple[float, int]:
    """Return the largest excess of penetration over its limit [m], and its sample.

    The excess is negative if the shapes provably satisfy the limit.

    Args:
        one: First shape.
        other: Second shape.
        arc: Length of their relative path from the first sample on, shape (S,) [m].
        active: Whether the shapes could overlap in a block of samples, for every block.
        slack: Largest penetration allowed, shape (S,) [m].
    """
    max_excess, row, k = -np.inf, 0, 0
    while k < len(arc):
        if not active[k // BLOCK]:
            later = np.flatnonzero(active[k // BLOCK :])
            if not len(later):
                break
            k = int(k // BLOCK + later[0]) * BLOCK
        distance = compute_distance(one.shape.solid, one.poses, other.shape.solid, other.poses, k)
        if -distance - slack[k] > max_excess:
            max_excess, row = -distance - slack[k], k
        k = max(k + 1, int(np.searchsorted(arc, arc[k] + abs(distance))))
    return max_excess, row
