"""Distances of all pairs along a phase, every 2 mm and 5 mrad.

A sample is left out only where the pair cannot have come together since one that was looked at: by
balls around shapes and boxes around what stands, over blocks of samples, and by how far the two can
have moved against each other since their distance was asked.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .neighbours import Neighbours
from .plan import Violation
from .poses import Poses, compute_angle
from .riding import compute_distance
from .stage import FLOOR, Solid, Stage, World
from .touching import SHORT, Licence

__all__ = ["CONTACT", "check_collisions"]

CONTACT = 1e-4  # [m] of overlap that is rounding
BLOCK = 32  # samples


class Pairs:
    """The moving and fixed shapes of a phase, and the path length of each.

    `gone` has for every moving shape how far any point of it has moved from sample to sample, seen
    from the world, the robot's base and its tool, shape (3, S - 1): two shapes move against each
    other by no more than the sum of both in any of the three.
    """

    def __init__(self, world: World, stage: Stage) -> None:
        self.world, self.stage = world, stage
        self.moving = [
            part
            for part in stage.solids
            if part.owner == "robot" or (part.owner, part.link) in stage.moving
        ]
        taken = {id(part) for part in self.moving}
        self.standing = [part for part in stage.solids if id(part) not in taken]
        self.length = len(stage.times)
        base = stage.links["robot", world.robot.tree.urdf.base]
        frames = [None, base.inverse(), stage.tool.inverse()]
        self.turns = np.array([part.at.turn[0] for part in self.standing]).reshape(-1, 3, 3)
        self.middles = np.array(
            [part.at.points(part.shape.centre)[0] for part in self.standing]
        ).reshape(-1, 3)
        self.halves = np.array([part.shape.half for part in self.standing]).reshape(-1, 3)
        self.centres, self.gone = [], []
        for part in self.moving:
            whole = Poses(
                np.broadcast_to(part.at.turn, (self.length, 3, 3)),
                np.broadcast_to(part.at.at, (self.length, 3)),
            )
            self.centres.append(whole.points(part.shape.centre))
            self.gone.append(
                np.array(
                    [
                        self._steps(whole if frame is None else frame @ whole, part)
                        for frame in frames
                    ]
                )
            )

    @staticmethod
    def _steps(place: Poses, part: Solid) -> np.ndarray:
        middle = place.points(part.shape.centre)
        turned = compute_angle(place.turn[1:], place.turn[:-1])
        return np.linalg.norm(np.diff(middle, axis=0), axis=1) + turned * part.shape.radius

    def counts(self, one: Solid, other: Solid) -> bool:
        """Whether two shapes, the first of which moves, are to stay apart."""
        robot = self.world.robot
        if one.owner == other.owner:
            return one.owner == "robot" and robot.apart(one.link, other.link)
        if other.owner != FLOOR:
            return True
        if one.owner == "robot":
            return one.link not in robot.on_the_floor
        return self.world.objects[one.owner].free

    def arcs(self, i: int) -> np.ndarray:
        """Return path lengths of a shape, alone and relative to earlier ones, shape (1 + i, S)."""
        steps = [self.gone[i][0], *((self.gone[i] + self.gone[j]).min(axis=0) for j in range(i))]
        return np.concatenate([np.zeros((1 + i, 1)), np.cumsum(steps, axis=1)], axis=1)

    def standing_bounds(self, i: int, rows: np.ndarray) -> np.ndarray:
        """Return lower bounds of distances to all fixed shapes, shape (rows, fixed shapes)."""
        local = np.einsum("kba,rkb->rka", self.turns, self.centres[i][rows][:, None] - self.middles)
        outside = np.maximum(np.abs(local) - self.halves, 0.0)
        return np.sqrt(np.einsum("rka,rka->rk", outside, outside)) - self.moving[i].shape.radius

    def ball_bounds(self, i: int, j: int, rows: np.ndarray) -> np.ndarray:
        """The same of two that move, by the balls around them, shape (rows,)."""
        apart = np.linalg.norm(self.centres[i][rows] - self.centres[j][rows], axis=1)
        return np.asarray(apart - self.moving[i].shape.radius - self.moving[j].shape.radius)


def check_collisions(
    world: World, stage: Stage, allowed: list[Licence], built: Neighbours
) -> Iterator[Violation]:
    """Yield pairs that overlap ("overlap") or are too close at waypoints ("clearance")."""
    pairs = Pairs(world, stage)
    begins = np.arange(0, pairs.length, BLOCK)
    ends = np.append(begins[1:], pairs.length) - 1
    middles, waypoints = (begins + ends) // 2, stage.rows[1:]
    safe, own_safe = (
        float(world.plan.options[key]) - SHORT for key in ("dist_safe", "self_distance")
    )
    for i, one in enumerate(pairs.moving):
        arcs = pairs.arcs(i)
        reach = np.maximum(arcs[:, ends] - arcs[:, middles], arcs[:, middles] - arcs[:, begins])
        active, close = (
            pairs.standing_bounds(i, middles) < reach[0][:, None],
            pairs.standing_bounds(i, waypoints) < safe,
        )
        some = np.flatnonzero(active.any(axis=0) | close.any(axis=0))
        todo = [(pairs.standing[k], arcs[0], active[:, k], close[:, k]) for k in some]
        for j, other in enumerate(pairs.moving[:i]):
            bounds = pairs.ball_bounds(i, j, middles), pairs.ball_bounds(i, j, waypoints)
            todo.append(
                (other, arcs[1 + j], bounds[0] < reach[1 + j], bounds[1] < max(safe, own_safe))
            )
        for other, arc, blocks, near in todo:
            if not pairs.counts(one, other):
                continue
            names = f"{one.label} - {other.label}"
            close, built_in = built.during(stage, one, other)
            asked = built.margin(one, other)
            least = min(own_safe if one.owner == other.owner == "robot" else safe, asked - SHORT)
            for k in waypoints[near]:
                apart = compute_distance(one.shape.solid, one.at, other.shape.solid, other.at, k)
                time = float(stage.times[k])
                licensed = any(own.covers(one.label, other.label, time, apart) for own in allowed)
                if apart < least and not close[k] and not licensed:
                    yield Violation(
                        "clearance",
                        names,
                        time,
                        least - apart,
                        f"{1e3 * apart:.2f} mm apart at a waypoint",
                    )
            slack = CONTACT + np.maximum(built_in, max(0.0, -asked))
            for own in allowed:
                if own.depth and own.names(one.label, other.label):
                    slack[(own.begin <= stage.times) & (stage.times <= own.end)] += own.depth
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

    The excess is negative where the shapes provably keep the limit.

    Args:
        one: A shape.
        other: The other.
        arc: How far they have moved against each other, from the first sample on, shape (S,) [m].
        active: For every block of samples, whether they could overlap there.
        slack: By how much they may overlap, shape (S,) [m].
    """
    worst, row, k = -np.inf, 0, 0
    while k < len(arc):
        if not active[k // BLOCK]:
            later = np.flatnonzero(active[k // BLOCK :])
            if not len(later):
                break
            k = int(k // BLOCK + later[0]) * BLOCK
        apart = compute_distance(one.shape.solid, one.at, other.shape.solid, other.at, k)
        if -apart - slack[k] > worst:
            worst, row = -apart - slack[k], k
        k = max(k + 1, int(np.searchsorted(arc, arc[k] + abs(apart))))
    return worst, row
