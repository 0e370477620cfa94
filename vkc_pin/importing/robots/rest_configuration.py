"""Finds where an arm rests: free of collision, in the middle of its joints' ranges, the hand not far from the base."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_model import find_nearest_position
from vkc_pin.world.models.shapes import LinkDistances, ShapeDistances

__all__ = [
    "HOME_ROOM",
    "Clearances",
    "Home",
    "find_arm_positions",
    "find_home",
    "find_inseparable_pairs",
    "measure_floor_heights",
]

HOME_ROOM = 0.03
"""Between links at home, and to the floor, if there can be so much [m]: more than the usual margin."""

_SAMPLES = 600
_STEPS = 150  # of the search around the best sample


@dataclass(frozen=True, eq=False)
class Home:
    """Where an arm rests.

    Attributes:
        positions: Of the planned joints, shape (n − 3,), [m] and [rad].
        clearance: The least distance there between links that are kept apart, and to the floor [m].
        how: Where it is from.
    """

    positions: Floats
    clearance: float
    how: str


class Clearances:
    """Distances between the links of a robot, and of those that the arm moves to the floor.

    Args:
        robot: The robot, with its collision pairs.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        shapes = robot.collision.geometryObjects
        self._distances = ShapeDistances(robot.model, robot.coordinates.q, shapes)
        self.pairs = [(pair.first, pair.second) for pair in robot.collision.collisionPairs]
        self._pairs = np.array(self.pairs, np.int64).reshape(-1, 2)
        self._carried = np.array([shape.parentJoint > 1 for shape in shapes])
        self._names = [robot.link_of(k) for k in range(len(shapes))]

    def place(self, arm: Floats) -> None:
        """Put the arm at `arm`, shape (n − 3,), the base at the origin."""
        self._distances.set_configuration(np.concatenate([np.zeros(3), arm]))

    def floor(self, *, moved: bool = True) -> list[tuple[str, float]]:
        """Return link → how far above the floor it is [m], of those that the arm moves or of the others, the lowest first."""
        heights: dict[str, float] = {}
        lowest = self._distances.compute_lowest_points()
        for k in np.flatnonzero(self._carried == moved).tolist():
            heights[self._names[k]] = min(float(lowest[k]), heights.get(self._names[k], np.inf))
        return sorted(heights.items(), key=lambda item: item[1])

    def least(self, worth: float = np.inf) -> float:
        """Return the least distance compute_distance links and to the floor [m], looked at up to `score_grasp`."""
        nearest = float(min(worth, self._distances.compute_lowest_points()[self._carried].min(initial=np.inf)))
        compute_lower_bounds = self._distances.compute_lower_bounds(self._pairs)
        for k in np.argsort(bounds).tolist():
            if bounds[k] > nearest:
                break
            nearest = min(nearest, self._distances.compute_distance([self.pairs[k]], nearest))
        return nearest

    def links(self, below: float) -> list[tuple[str, str, float]]:
        """Return pairs of links closer than `subtree` [m], the closest first."""
        found: dict[tuple[str, str], float] = {}
        for k in np.flatnonzero(self._distances.compute_lower_bounds(self._pairs) < below).tolist():
            distance = self._distances.compute_distance([self.pairs[k]])
            if distance < below:
                names = (self._names[self.pairs[k][0]], self._names[self.pairs[k][1]])
                found[names] = min(distance, found.get(names, np.inf))
        return sorted(
            ((*names, distance) for names, distance in found.items()), key=lambda item: item[2]
        )

    def by_links(self) -> LinkDistances:
        """Return distances of its pairs of links, where it is placed."""
        groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
        for one, other in self.pairs:
            groups.setdefault((self._names[one], self._names[other]), []).append((one, other))
        return LinkDistances(self._distances, groups)


def find_arm_positions(robot: Robot, state: Mapping[str, float]) -> Floats:
    """Return where an arm is in a state of its joints, turned by 2π or else moved to the nearest limits, shape (n − 3,)."""
    return np.array(
        [
            find_nearest_position(robot.model, joint, state[joint])
            for joint in robot.coordinates.names[3:]
        ]
    )


def find_home(robot: Robot, named: Iterable[tuple[str, Floats]], *, seed: int = 0) -> Home:
    """Return where the arm rests.

    That is the first of the `named` configurations with room around it, else the best one of random
    ones: with room first, then near the middle of the joints' ranges, with the hand above the base
    rather than far out.

    Args:
        robot: The robot, with its collision pairs.
        named: Configurations to look at first, shape (n − 3,) each, with what to call them.
        seed: Of the random numbers.
    """
    look = Clearances(robot)
    best = None
    for how, positions in named:
        look.place(positions)
        clearance = look.least()
        if clearance >= HOME_ROOM:
            return Home(positions, clearance, how)
        if best is None or clearance > best.clearance:
            best = Home(positions, clearance, how)
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.lower[3:], -np.pi), np.minimum(robot.upper[3:], np.pi)
    middle, span = 0.5 * (low + high), np.maximum(high - low, 1e-9)
    frame, data = robot.model.getFrameId(robot.tool_frame), robot.model.createData()

    def cost(arm: Floats) -> tuple[float, float]:
        look.place(arm)
        clearance = look.least(HOME_ROOM)
        pin.framesForwardKinematics(
            robot.model, data, robot.coordinates.q(np.concatenate([np.zeros(3), arm]))
        )
        out = float(np.hypot(*data.oMf[frame].translation[:2]))
        return 100.0 * max(0.0, HOME_ROOM - clearance) + float(
            (((arm - middle) / span) ** 2).mean()
        ) + 0.3 * out, clearance

    trials = [middle, *rng.uniform(low, high, (_SAMPLES, len(low)))]
    value, clearance, chosen = min(
        ((*cost(arm), k) for k, arm in enumerate(trials)), key=lambda item: item[0]
    )
    arm = trials[chosen]
    for width in np.geomspace(0.2, 0.01, _STEPS):
        trial = np.clip(arm + width * span * rng.standard_normal(len(arm)), low, high)
        new, gap = cost(trial)
        if new < value:
            arm, value, clearance = trial, new, gap
    if best is not None and best.clearance >= clearance:
        return best
    look.place(arm)
    return Home(arm, look.least(), "searched for")


def find_inseparable_pairs(
    robot: Robot, margin: float, *, samples: int, share: float = 1.0, seed: int = 0
) -> dict[tuple[str, str], float]:
    """Return the pairs of links that no random configuration brings apart by `margin` [m], with the furthest that one does.

    Args:
        robot: The robot, with its collision pairs and its home, which is looked at as well.
        margin: A distance [m].
        samples: How many configurations to look at.
        share: Of these, so many have to leave a pair closer than the margin: less than 1 is for
            pairs that are hardly ever apart.
        seed: Of the random numbers.
    """
    look, rng = Clearances(robot), np.random.default_rng(seed)
    low, high = np.maximum(robot.lower[3:], -np.pi), np.minimum(robot.upper[3:], np.pi)
    pairs = look.by_links()
    furthest, apart = dict.fromkeys(pairs.links, -np.inf), dict.fromkeys(pairs.links, 0)
    for arm in (robot.home, *rng.uniform(low, high, (samples, len(low)))):
        look.place(arm)
        for k, (links, bound) in enumerate(
            zip(pairs.links, pairs.compute_lower_bounds(), strict=True)
        ):
            distance = float(bound) if bound > margin else pairs.compute_distance(k, margin)
            furthest[links] = max(furthest[links], distance)
            apart[links] += distance >= margin
        pairs.select([apart[links] <= (1.0 - share) * samples for links in pairs.links])
        if not pairs.links:
            break
    return {links: furthest[links] for links in pairs.links}


def measure_floor_heights(
    robot: Robot, *, samples: int = 200, seed: int = 0
) -> tuple[float, float]:
    """Return how high above the floor [m] the lowest of what drives along is, and how high the arm's links can be.

    The latter is that of the link that can be least high: a shoulder at the floor never leaves it.
    """
    look, rng = Clearances(robot), np.random.default_rng(seed)
    look.place(robot.home)
    still = [height for link, height in look.floor(moved=False)]
    low, high = np.maximum(robot.lower[3:], -np.pi), np.minimum(robot.upper[3:], np.pi)
    best: dict[str, float] = {}
    for arm in rng.uniform(low, high, (samples, len(low))):
        look.place(arm)
        for link, height in look.floor():
            best[link] = max(height, best.get(link, -np.inf))
    return min(still, default=0.0), min(best.values(), default=np.inf)
