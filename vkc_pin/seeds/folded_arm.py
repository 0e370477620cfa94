"""The arm folded over the base with what it carries, for passages that are too narrow for the robot as it is."""

from __future__ import annotations

import numpy as np

from vkc_pin.arrays import Floats
from vkc_pin.driving.body import hull_points
from vkc_pin.interrupt import NEVER, Interrupt
from vkc_pin.program.problem import TrajectoryProblem
from vkc_pin.seeds.knots import depth

__all__ = ["folded_arm"]

_POSTURES, _SEARCH_ROUNDS = 256, 8  # postures in a round of the random search
_PARENTS = 8  # free postures from which the next round begins
_CHECKED = 32  # postures whose clearance is found at once
_SPREAD, _SHRINK = 0.5, 0.7  # [m] and [rad] standard deviation of the first round; its ratio from round to round
_OVERHANG, _HEIGHT = 0.3, 0.2  # [m/m] cost of a metre before or behind the base, and up, a metre of width costing 1
_FROM_HOME = 0.01  # [m/rad] cost of the joint that is furthest from home
_LOW, _LOW_COST = 0.1, 10.0  # [m] over the floor, at least; [m/m] cost of less


def folded_arm(problem: TrajectoryProblem, phase: int, resting: Floats, interrupt: Interrupt = NEVER) -> Floats:
    """Return the arm, shape (m - 3,) [m] and [rad], with which the robot is narrow: the best that a random search finds.

    What counts is how far the arm, and what is carried, reach to either side of the base's x axis; next, how far they reach
    beyond the base before and behind, how high, and how far the joints are from home. The robot is free of collisions with itself
    and with what it carries. The search is the same every time.

    Args:
        problem: Whose robot it is.
        phase: In which it carries what it carries.
        resting: Where robot and load rest, shape (n,): what is not the arm stays so; where the base is does not matter.
        interrupt: Ends the search, with what there is.
    """
    chain, rng = problem.chain, np.random.default_rng(0)
    arm, home = slice(3, chain.robot.coordinates.size), chain.robot.home
    turns = np.array([problem.unit(name) == "rad" for name in chain.names[arm]])
    lower = np.where(turns, np.maximum(chain.lower[arm], home - np.pi), chain.lower[arm])
    upper = np.where(turns, np.minimum(chain.upper[arm], home + np.pi), chain.upper[arm])
    body = _Body(problem, phase)
    z = np.tile(resting, (_POSTURES, 1))
    z[0, arm] = home
    z[1:, arm] = rng.uniform(lower, upper, (_POSTURES - 1, len(home)))
    best, spread = z[:1], _SPREAD
    for _ in range(_SEARCH_ROUNDS):
        if interrupt.pressed:
            break
        z = z[np.argsort(body.price(z) + _FROM_HOME * np.abs(z[:, arm] - home).max(axis=1), kind="stable")]
        best = body.free(z, _PARENTS)
        if not len(best):
            return home.copy()
        z = best[np.arange(_POSTURES) % len(best)]
        off = spread * rng.uniform(0.0, 1.0, (_POSTURES, 1)) * rng.normal(size=(_POSTURES, len(home)))
        off[: len(best)] = 0.0
        z[:, arm] = np.clip(z[:, arm] + off, lower, upper)
        spread *= _SHRINK
    return best[0, arm].copy()


class _Body:
    """What the base carries in a phase of a problem, and the base's own outline."""

    def __init__(self, problem: TrajectoryProblem, phase: int) -> None:
        self.problem, self.chain = problem, problem.chain
        self.waypoint = problem.contacts.inside(phase)
        shapes = problem.contacts.phases[phase].shapes
        moving = [*range(len(self.chain.robot.collision.geometryObjects))]
        moving += [i for hold in problem.task.phases[phase].held for i in self.chain.held_geometries[hold]]
        points: dict[int, list[Floats]] = {1: [np.zeros((1, 3))]}
        for i in moving:
            corners, radius = hull_points(shapes[i].geometry, shapes[i].placement, outer=True)
            corners = np.concatenate([corners - radius, corners + radius]) if radius else corners
            points.setdefault(shapes[i].parentJoint, []).append(corners)
        base = np.concatenate(points.pop(1))
        self.front, self.back = base[:, 0].max(), base[:, 0].min()
        self.points = {joint: np.concatenate(corners).T for joint, corners in points.items()}

    def price(self, z: Floats) -> Floats:
        """Return how far what is carried reaches, weighted as in `folded_arm`, shape (B,) [m]."""
        rotations, translations = self.chain.joint_placements(z)
        turned = rotations[0, 1].T @ rotations
        moved = (translations - translations[0, 1]) @ rotations[0, 1]
        at = np.concatenate(
            [turned[:, joint] @ points + moved[:, joint, :, None] for joint, points in self.points.items()], axis=2
        )
        (back, right, bottom), (front, left, top) = at.min(axis=2).T, at.max(axis=2).T
        beyond = np.maximum(front - self.front, 0.0) + np.maximum(self.back - back, 0.0)
        return np.asarray(
            np.maximum(left, -right) + _OVERHANG * beyond + _HEIGHT * top + _LOW_COST * np.maximum(_LOW - bottom, 0.0)
        )

    def free(self, z: Floats, count: int) -> Floats:
        """Return the first `count` configurations at which the robot keeps its clearances from itself and what it carries."""
        found = z[:0]
        for begin in range(0, len(z), _CHECKED):
            part = z[begin : begin + _CHECKED]
            found = np.concatenate([found, part[depth(self.problem, part, self.waypoint, standing=False) <= 0.0]])
            if len(found) >= count:
                break
        return found[:count]
