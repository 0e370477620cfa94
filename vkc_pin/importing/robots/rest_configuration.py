"""Finds a collision-free home configuration of an arm, near mid-range and close to the base."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_model import find_nearest_position
from vkc_pin.world.models.shapes import LinkDistances, ShapeDistances, triangulate

HOME_ROOM = 0.03
"""Desired clearance between links and to the floor at home [m], above the default margin."""

_SAMPLES = 600
_VERTICAL = 1.0 - 1e-6  # smallest vertical part of the axis of a lift
_SUNKEN = 0.005  # [m] height above the floor that a sunken column may have
_DEEP = 10.0  # [m] below which no lift goes
_STEPS = 150  # steps of the local search around the best sample


@dataclass(frozen=True, eq=False)
class Home:
    """Home configuration of an arm.

    Attributes:
        positions: Positions of the planned joints, shape (n − 3,), [m] and [rad].
        clearance: Smallest distance between links and to the floor [m].
        how: Origin of the configuration.
    """

    positions: Floats
    clearance: float
    how: str


class Clearances:
    """Distances between the links of a robot, and of the arm's links to the floor."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        shapes = robot.collision.geometryObjects
        self._distances = ShapeDistances(robot.model, robot.coordinates.q, shapes)
        self.pairs = [(pair.first, pair.second) for pair in robot.collision.collisionPairs]
        self._pairs = np.array(self.pairs, np.int64).reshape(-1, 2)
        self._options = Options()
        margins = robot.own_margins(self._options.self_distance)
        self._margins = np.array([margins[pair] for pair in self.pairs])
        self._is_moved = np.array([shape.parentJoint > 1 for shape in shapes], bool)
        self._names = [robot.link_of(k) for k in range(len(shapes))]

    def place(self, arm: Floats) -> None:
        """Set the arm's positions, shape (n − 3,), with the base at the origin."""
        self._distances.set_configuration(np.concatenate([np.zeros(3), arm]))

    def floor(self, *, moved: bool = True) -> list[tuple[str, float]]:
        """Return links with their height above the floor [m], the lowest first.

        Args:
            moved: Whether to return links that the arm moves, or the others.
        """
        heights: dict[str, float] = {}
        lowest = self._distances.compute_lowest_points()
        for k in np.flatnonzero(self._is_moved == moved).tolist():
            heights[self._names[k]] = min(float(lowest[k]), heights.get(self._names[k], np.inf))
        return sorted(heights.items(), key=lambda item: item[1])

    def is_free(self, *, floor: float = 0.0) -> bool:
        """Return whether the links keep the default margins of plans, at a height of the floor."""
        lowest = self._distances.compute_lowest_points()[self._is_moved].min(initial=np.inf)
        if lowest < floor + self._options.dist_safe:
            return False
        close = np.flatnonzero(self._distances.compute_lower_bounds(self._pairs) < self._margins)
        return all(
            self._distances.compute_distance([self.pairs[k]]) >= self._margins[k]
            for k in close.tolist()
        )

    def least(self, limit: float = np.inf) -> float:
        """Return the smallest distance between links and to the floor [m], at most `limit`."""
        nearest = float(
            min(limit, self._distances.compute_lowest_points()[self._is_moved].min(initial=np.inf))
        )
        bounds = self._distances.compute_lower_bounds(self._pairs)
        for k in np.argsort(bounds).tolist():
            if bounds[k] > nearest:
                break
            nearest = min(nearest, self._distances.compute_distance([self.pairs[k]], nearest))
        return nearest

    def links(self, below: float) -> list[tuple[str, str, float]]:
        """Return pairs of links closer than `below` [m] with their distance, the closest first."""
        distances: dict[tuple[str, str], float] = {}
        for k in np.flatnonzero(self._distances.compute_lower_bounds(self._pairs) < below).tolist():
            distance = self._distances.compute_distance([self.pairs[k]])
            if distance < below:
                names = (self._names[self.pairs[k][0]], self._names[self.pairs[k][1]])
                distances[names] = min(distance, distances.get(names, np.inf))
        return sorted(
            ((*names, distance) for names, distance in distances.items()), key=lambda item: item[2]
        )

    def by_links(self) -> LinkDistances:
        """Return the distances of its pairs of links at the current positions."""
        groups: dict[tuple[str, str], list[tuple[int, int]]] = {}
        for one, other in self.pairs:
            groups.setdefault((self._names[one], self._names[other]), []).append((one, other))
        return LinkDistances(self._distances, groups)


def find_arm_positions(robot: Robot, state: Mapping[str, float]) -> Floats:
    """Return the arm's positions in a state, within limits, shape (n − 3,).

    Angles are shifted by 2π, or else clamped.
    """
    return np.array(
        [
            find_nearest_position(robot.model, joint, state[joint])
            for joint in robot.coordinates.names[3:]
        ]
    )


def find_home(robot: Robot, named: Iterable[tuple[str, Floats]], *, seed: int = 0) -> Home:
    """Find a home configuration of the arm.

    It is the first of the `named` configurations with sufficient clearance, else the best random
    one: with clearance first, then near the centre of the joints' ranges, and with the hand above
    the base rather than far from it.
    """
    clearances = Clearances(robot)
    best = None
    for how, positions in named:
        clearances.place(positions)
        clearance = clearances.least()
        if clearance >= HOME_ROOM:
            return Home(positions, clearance, how)
        if best is None or clearance > best.clearance:
            best = Home(positions, clearance, how)
    rng, (low, high) = np.random.default_rng(seed), get_arm_bounds(robot)
    middle, span = 0.5 * (low + high), np.maximum(high - low, 1e-9)
    frame, data = robot.model.getFrameId(robot.tool_frame), robot.model.createData()

    def compute_cost(arm: Floats) -> tuple[float, float]:
        """Return the cost of a configuration, and its clearance [m]."""
        clearances.place(arm)
        clearance = clearances.least(HOME_ROOM)
        pin.framesForwardKinematics(
            robot.model, data, robot.coordinates.q(np.concatenate([np.zeros(3), arm]))
        )
        out = float(np.hypot(*data.oMf[frame].translation[:2]))
        offset = float((((arm - middle) / span) ** 2).mean())
        return 100.0 * max(0.0, HOME_ROOM - clearance) + offset + 0.3 * out, clearance

    trials = [middle, *rng.uniform(low, high, (_SAMPLES, len(low)))]
    value, clearance, chosen = min(
        ((*compute_cost(arm), k) for k, arm in enumerate(trials)), key=lambda item: item[0]
    )
    arm = trials[chosen]
    for width in np.geomspace(0.2, 0.01, _STEPS):
        trial = np.clip(arm + width * span * rng.standard_normal(len(arm)), low, high)
        new, gap = compute_cost(trial)
        if new < value:
            arm, value, clearance = trial, new, gap
    if best is not None and best.clearance >= clearance:
        return best
    clearances.place(arm)
    return Home(arm, clearances.least(), "found by search")


def find_inseparable_pairs(
    robot: Robot, margin: float, *, samples: int, share: float = 1.0, seed: int = 0
) -> dict[tuple[str, str], float]:
    """Return pairs of links that no random configuration separates by `margin` [m].

    Args:
        robot: The robot, with its collision pairs and its home, which is checked as well.
        margin: A distance [m].
        samples: Number of random configurations.
        share: Fraction of these in which a pair must be closer than the margin; values below 1 also
            find pairs that are rarely separated.
        seed: Random seed.

    Returns:
        The pairs with their largest distance [m].
    """
    clearances, rng = Clearances(robot), np.random.default_rng(seed)
    low, high = get_arm_bounds(robot)
    pairs = clearances.by_links()
    furthest, separated = dict.fromkeys(pairs.links, -np.inf), dict.fromkeys(pairs.links, 0)
    for arm in (robot.home, *rng.uniform(low, high, (samples, len(low)))):
        clearances.place(arm)
        for k, (links, bound) in enumerate(
            zip(pairs.links, pairs.compute_lower_bounds(), strict=True)
        ):
            distance = float(bound) if bound > margin else pairs.compute_distance(k, margin)
            furthest[links] = max(furthest[links], distance)
            separated[links] += distance >= margin
        pairs.select([separated[links] <= (1.0 - share) * samples for links in pairs.links])
        if not pairs.links:
            break
    return {links: furthest[links] for links in pairs.links}


def find_nested_pairs(robot: Robot, margin: float) -> list[tuple[str, str]]:
    """Return sorted pairs of links of a telescope that are closer than `margin` [m] at its limits.

    These are the links that one coordinate slides, and those from which they slide.
    """
    clearances, bounds = Clearances(robot), (robot.lower, robot.upper)
    joints = dict[int, set[int]]()
    for move in robot.coordinates.moves:
        if move.slides:
            joints.setdefault(move.coordinate, set()).add(move.joint)
    nested = set[tuple[str, str]]()
    for coordinate, moved in joints.items():
        if len(moved) > 1:
            parts = moved | {int(robot.model.parents[joint]) for joint in moved}
            links = {
                robot.link_of(k)
                for k, shape in enumerate(robot.collision.geometryObjects)
                if shape.parentJoint in parts
            }
            for bound in bounds:
                arm = robot.home.copy()
                arm[coordinate - 3] = bound[coordinate]
                clearances.place(arm)
                nested |= {
                    (min(pair), max(pair))
                    for *pair, _ in clearances.links(margin)
                    if links.issuperset(pair)
                }
    return sorted(nested)


def get_arm_bounds(robot: Robot) -> tuple[Floats, Floats]:
    """Return the arm's position limits within ±π, shape (n − 3,) each."""
    return np.maximum(robot.lower[3:], -np.pi), np.minimum(robot.upper[3:], np.pi)


def find_sunken_links(robot: Robot) -> list[str]:
    """Return the links of a lift that its lowest position sinks below the base's lowest point.

    They are drawn as columns, which a real base takes in or which telescope.
    """
    model, data = robot.model, robot.model.createData()
    lowest = np.maximum(get_arm_bounds(robot)[0], -_DEEP)
    pin.forwardKinematics(model, data, robot.coordinates.q(np.concatenate([np.zeros(3), lowest])))
    lifts = {1}
    for joint in range(2, model.njoints):
        motion = np.asarray(data.joints[joint].S, float).reshape(6, -1)[:, 0]
        is_vertical = abs((data.oMi[joint].rotation @ motion[:3])[2]) > _VERTICAL
        if is_vertical and model.parents[joint] in lifts:
            lifts.add(joint)
    tops, floor = dict[str, float](), 0.0
    for k, shape in enumerate(robot.collision.geometryObjects):
        if shape.parentJoint in lifts:
            place = data.oMi[shape.parentJoint] * shape.placement
            heights = triangulate(shape.geometry)[0] @ place.rotation[2] + place.translation[2]
            if shape.parentJoint == 1:
                floor = min(floor, float(heights.min()))
            else:
                name = robot.link_of(k)
                tops[name] = max(float(heights.max()), tops.get(name, -np.inf))
    return sorted(link for link, top in tops.items() if top < floor + _SUNKEN)


def measure_floor_heights(
    robot: Robot, *, samples: int = 200, seed: int = 0
) -> tuple[float, float]:
    """Return the height of the lowest base link [m], and the height that all arm links can reach.

    The latter is the smallest of the arm links' largest heights: a shoulder at the floor never
    leaves it.
    """
    clearances, rng = Clearances(robot), np.random.default_rng(seed)
    clearances.place(robot.home)
    base_heights = [height for link, height in clearances.floor(moved=False)]
    low, high = get_arm_bounds(robot)
    best: dict[str, float] = {}
    for arm in rng.uniform(low, high, (samples, len(low))):
        clearances.place(arm)
        for link, height in clearances.floor():
            best[link] = max(height, best.get(link, -np.inf))
    return min(base_heights, default=0.0), min(best.values(), default=np.inf)
