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
        heights = dict[str, float]()
        lowest = self._distances.compute_lowest_points()
        for k in np.flatnonzero(self._is_moved == moved).tolist():
            link = self._names[k]
            heights[link] = min(float(lowest[k]), heights.get(link, np.inf))
        return sorted(heights.items(), key=lambda item: item[1])

    def is_free(self, *, floor: float = 0.0) -> bool:
        """Return whether the links keep the default margins of plans, at a height of the floor."""
        lowest = self._distances.compute_lowest_points()[self._is_moved].min(initial=np.inf)
        if lowest < floor + self._options.dist_safe:
            return False
        lower_bounds = self._distances.compute_lower_bounds(self._pairs)
        for k in np.flatnonzero(lower_bounds < self._margins).tolist():
            if self._distances.compute_distance([self.pairs[k]]) < self._margins[k]:
                return False
        return True

    def least(self, limit: float = np.inf) -> float:
        """Return the smallest distance between links and to the floor [m], at most `limit`."""
        lowest = self._distances.compute_lowest_points()[self._is_moved].min(initial=np.inf)
        nearest = float(min(limit, lowest))
        lower_bounds = self._distances.compute_lower_bounds(self._pairs)
        for k in np.argsort(lower_bounds).tolist():
            if lower_bounds[k] > nearest:
                break
            nearest = min(nearest, self._distances.compute_distance([self.pairs[k]], nearest))
        return nearest

    def links(self, below: float) -> list[tuple[str, str, float]]:
        """Return pairs of links closer than `below` [m] with their distance, the closest first."""
        distances = dict[tuple[str, str], float]()
        lower_bounds = self._distances.compute_lower_bounds(self._pairs)
        for k in np.flatnonzero(lower_bounds < below).tolist():
            distance = self._distances.compute_distance([self.pairs[k]])
            if distance < below:
                one, other = self.pairs[k]
                links = (self._names[one], self._names[other])
                distances[links] = min(distance, distances.get(links, np.inf))
        found = [(one, other, distance) for (one, other), distance in distances.items()]
        return sorted(found, key=lambda item: item[2])

    def by_links(self) -> LinkDistances:
        """Return the distances of its pairs of links at the current positions."""
        groups = dict[tuple[str, str], list[tuple[int, int]]]()
        for one, other in self.pairs:
            groups.setdefault((self._names[one], self._names[other]), []).append((one, other))
        return LinkDistances(self._distances, groups)


def find_arm_positions(robot: Robot, state: Mapping[str, float]) -> Floats:
    """Return the arm's positions in a state, within limits, shape (n − 3,).

    Angles are shifted by 2π, or else clamped.
    """
    positions = list[float]()
    for joint in robot.coordinates.names[3:]:
        positions.append(find_nearest_position(robot.model, joint, state[joint]))
    return np.array(positions)


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
    arm, clearance = _search_home(clearances, seed)
    if best is not None and best.clearance >= clearance:
        return best
    clearances.place(arm)
    return Home(arm, clearances.least(), "found by search")


def _search_home(clearances: Clearances, seed: int) -> tuple[Floats, float]:
    """Return the arm's positions of least cost among random ones, and their clearance [m].

    The cost of positions z with clearance c, at most c₀, and a hand at the horizontal distance r
    [m] from the base is

        100 (c₀ - c) + mean(((z - middle) / span)²) + 0.3 r
    """
    robot = clearances.robot
    low, high = get_arm_bounds(robot)
    middle = 0.5 * (low + high)
    span = np.maximum(high - low, 1e-9)
    frame = robot.model.getFrameId(robot.tool_frame)
    data = robot.model.createData()

    def compute_cost(arm: Floats) -> tuple[float, float]:
        """Return the cost of a configuration, and its clearance [m]."""
        clearances.place(arm)
        clearance = clearances.least(HOME_ROOM)
        q = robot.coordinates.q(np.concatenate([np.zeros(3), arm]))
        pin.framesForwardKinematics(robot.model, data, q)
        distance = float(np.hypot(*data.oMf[frame].translation[:2]))
        offset = float((((arm - middle) / span) ** 2).mean())
        cost = 100.0 * max(0.0, HOME_ROOM - clearance) + offset + 0.3 * distance
        return cost, clearance

    rng = np.random.default_rng(seed)
    best = middle
    least_cost, clearance_at_best = compute_cost(middle)
    for trial in rng.uniform(low, high, (_SAMPLES, len(low))):
        cost, clearance = compute_cost(trial)
        if cost < least_cost:
            best = trial
            least_cost = cost
            clearance_at_best = clearance
    # A local search around the best sample, in ever smaller steps
    for width in np.geomspace(0.2, 0.01, _STEPS):
        trial = np.clip(best + width * span * rng.standard_normal(len(best)), low, high)
        cost, clearance = compute_cost(trial)
        if cost < least_cost:
            best = trial
            least_cost = cost
            clearance_at_best = clearance
    return best, clearance_at_best


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
    clearances = Clearances(robot)
    rng = np.random.default_rng(seed)
    low, high = get_arm_bounds(robot)
    pairs = clearances.by_links()
    furthest = dict.fromkeys(pairs.links, -np.inf)
    separated_counts = dict.fromkeys(pairs.links, 0)
    largest_count = (1.0 - share) * samples
    for arm in (robot.home, *rng.uniform(low, high, (samples, len(low)))):
        clearances.place(arm)
        lower_bounds = pairs.compute_lower_bounds()
        for k, links in enumerate(pairs.links):
            bound = float(lower_bounds[k])
            distance = bound if bound > margin else pairs.compute_distance(k, margin)
            furthest[links] = max(furthest[links], distance)
            separated_counts[links] += distance >= margin
        # A pair that is separated more often is dropped.
        pairs.select([separated_counts[links] <= largest_count for links in pairs.links])
        if not pairs.links:
            break
    return {links: furthest[links] for links in pairs.links}


def find_nested_pairs(robot: Robot, margin: float) -> list[tuple[str, str]]:
    """Return sorted pairs of links of a telescope that are closer than `margin` [m] at its limits.

    These are the links that one coordinate slides, and those from which they slide.
    """
    clearances = Clearances(robot)
    joints = dict[int, set[int]]()  # that slide, by the coordinate
    for move in robot.coordinates.moves:
        if move.slides:
            joints.setdefault(move.coordinate, set()).add(move.joint)
    nested = set[tuple[str, str]]()
    for coordinate, moved in joints.items():
        if len(moved) < 2:
            continue
        carriers = moved | {int(robot.model.parents[joint]) for joint in moved}
        links = set[str]()
        for k, shape in enumerate(robot.collision.geometryObjects):
            if shape.parentJoint in carriers:
                links.add(robot.link_of(k))
        for bound in (robot.lower, robot.upper):
            arm = robot.home.copy()
            arm[coordinate - 3] = bound[coordinate]
            clearances.place(arm)
            for one, other, _ in clearances.links(margin):
                if one in links and other in links:
                    nested.add((min(one, other), max(one, other)))
    return sorted(nested)


def get_arm_bounds(robot: Robot) -> tuple[Floats, Floats]:
    """Return the arm's position limits within ±π, shape (n − 3,) each."""
    return np.maximum(robot.lower[3:], -np.pi), np.minimum(robot.upper[3:], np.pi)


def find_sunken_links(robot: Robot) -> list[str]:
    """Return the links of a lift that its lowest position sinks below the base's lowest point.

    They are drawn as columns, which a real base takes in or which telescope.
    """
    model = robot.model
    data = model.createData()
    low, _ = get_arm_bounds(robot)
    lowest = np.maximum(low, -_DEEP)
    pin.forwardKinematics(model, data, robot.coordinates.q(np.concatenate([np.zeros(3), lowest])))
    # Joint 1 is the planar base.
    lifts = {1}
    for joint in range(2, model.njoints):
        # The joint's motion in its own frame is (v, ω), with v = 0 for revolute joints.
        motion = np.asarray(data.joints[joint].S, float).reshape(6, -1)[:, 0]
        is_vertical = abs((data.oMi[joint].rotation @ motion[:3])[2]) > _VERTICAL
        if is_vertical and model.parents[joint] in lifts:
            lifts.add(joint)
    tops = dict[str, float]()
    floor = 0.0
    for k, shape in enumerate(robot.collision.geometryObjects):
        if shape.parentJoint not in lifts:
            continue
        place = data.oMi[shape.parentJoint] * shape.placement
        vertices, _ = triangulate(shape.geometry)
        heights = vertices @ place.rotation[2] + place.translation[2]
        if shape.parentJoint == 1:
            floor = min(floor, float(heights.min()))
        else:
            link = robot.link_of(k)
            tops[link] = max(float(heights.max()), tops.get(link, -np.inf))
    return sorted(link for link, top in tops.items() if top < floor + _SUNKEN)


def measure_floor_heights(
    robot: Robot, *, samples: int = 200, seed: int = 0
) -> tuple[float, float]:
    """Return the height of the lowest base link [m], and the height that all arm links can reach.

    The latter is the smallest of the arm links' largest heights: a shoulder at the floor never
    leaves it.
    """
    clearances = Clearances(robot)
    clearances.place(robot.home)
    base_heights = [height for _, height in clearances.floor(moved=False)]
    rng = np.random.default_rng(seed)
    low, high = get_arm_bounds(robot)
    largest = dict[str, float]()
    for arm in rng.uniform(low, high, (samples, len(low))):
        clearances.place(arm)
        for link, height in clearances.floor():
            largest[link] = max(height, largest.get(link, -np.inf))
    return min(base_heights, default=0.0), min(largest.values(), default=np.inf)
