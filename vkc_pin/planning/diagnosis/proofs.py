"""Proves that a task is impossible: goals out of reach, blocked floor, links that must collide."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.planning.base_paths.blocked_cells import make_solids
from vkc_pin.planning.base_paths.reachable_floor import (
    CellGrid,
    InscribedDiscs,
    Wall,
    find_blocked_cells,
    flood_fill,
)
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.pose_goals import PoseGoal
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.clearance_exemptions import PlacedShapes, find_clearance_exemptions
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.task.phases import Phase

PROVEN = "proven: "
"""Prefix of the part of a note that is certain."""

_COARSE_CELL = 0.1  # [m] cells for finding a path, which makes a proof unnecessary
_FINE_CELL = 0.02  # [m] cells for proofs
_MAX_CELLS = 400_000  # of a proof; in a larger arena they are larger
# [m] by which a base may leave the arena, or a frame miss its goal: more than validation accepts
_TOLERANCE = 0.02
_MAX_NAMES = 6  # obstacles named in a message
_CLOSED_TOLERANCE = 0.05  # [rad], [m] up to which a joint counts as closed
_BASE = 1  # the joint of the model that is the base
_CERTAIN_OVERLAP = 1e-3  # [m] more than validation accepts
_SAMPLES = 200  # joint values between start and goal

# Window of cells, and a mask of those that are blocked.
_Window = tuple[tuple[slice, slice], Bools]


class _BaseGoal(NamedTuple):
    """Where a point of the base must be at the end of a phase: a disc; NaN: anywhere."""

    center: Floats
    radius: float

    def allows(self, cells: CellGrid, grown: float) -> Bools:
        """Return which cell centres are within the radius plus `grown` [m], shape (X, Y)."""
        x, y = cells.centers()
        distances = np.hypot(np.nan_to_num(x - self.center[0]), np.nan_to_num(y - self.center[1]))
        return np.asarray(distances <= self.radius + grown)


class _PhaseFloor(NamedTuple):
    """A phase with the goals of the base and the walls that keep it away, numbered as `names`."""

    phase: Phase
    goals: Sequence[_BaseGoal]
    walls: Sequence[Wall]
    names: Sequence[str]


def find_proofs(problem: KinematicProblem) -> list[str]:
    """Explain why a task is certainly impossible; the result is empty if nothing is proven.

    Attached objects are no obstacles, nor are objects that the motion itself leaves at a place of
    its choice.
    """
    if problem.chain.robot.base == "fixed":
        return []
    goals = list[list[_BaseGoal]]()
    for number, phase in enumerate(problem.task.phases):
        found, beyond = _find_base_goals(problem, number)
        if beyond:
            return [f"{phase.name}: out of reach, {PROVEN}{text}" for text in beyond]
        goals.append(found)
    for point in _find_tracked_points(problem):
        explanation = _explain_missing_path_of_point(problem, point, goals)
        if explanation:
            return [explanation]
    return []


def _explain_missing_path_of_point(
    problem: KinematicProblem, point: Floats, goals: Sequence[Sequence[_BaseGoal]]
) -> str:
    """Explain why a point of the base certainly has no path from goal to goal; empty if it may.

    Args:
        problem: The problem.
        point: The point in the base's frame, shape (2,) [m].
        goals: Goals of the base's origin in each phase.
    """
    offset = float(np.hypot(*point))
    x, y, yaw = problem.start[:3].tolist()
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    start = np.array([x, y]) + turn @ point
    parts = []
    for number, phase in enumerate(problem.task.phases):
        # At an unknown heading, the point may be on any side of the origin.
        own = [_BaseGoal(goal.center, goal.radius + offset) for goal in goals[number]]
        walls, names = _collect_walls(problem, number, point)
        parts.append(_PhaseFloor(phase, own, walls, names))
    if not any(part.goals for part in parts):
        return ""
    low, high = np.array([problem.limits(name) for name in problem.chain.names[:2]]).T
    begin = low - _TOLERANCE - offset
    end = high + _TOLERANCE + offset
    if _has_path(start, parts, CellGrid.over(begin, end, _COARSE_CELL)):
        return ""
    step = max(_FINE_CELL, float(np.sqrt(np.prod(end - begin) / _MAX_CELLS)))
    return _explain_missing_path(problem, start, parts, CellGrid.over(begin, end, step))


def _find_tracked_points(problem: KinematicProblem) -> list[Floats]:
    """Return points of the base to track, (2,) [m] each: its origin, and where it is highest."""
    shapes = []
    for shape in problem.chain.robot.collision.geometryObjects:
        if shape.parentJoint == _BASE:
            shapes.append((shape.geometry, shape.placement))
    solids = make_solids(shapes)
    if not solids:
        return []
    highest = max(solids, key=lambda solid: solid.top)
    corners = highest.points[:, :2]
    return [np.zeros(2), (corners.min(axis=0) + corners.max(axis=0)) / 2.0]


def _find_base_goals(problem: KinematicProblem, number: int) -> tuple[list[_BaseGoal], list[str]]:
    """Return necessary base positions at a phase's end, and reasons why goals are unreachable."""
    phase = problem.task.phases[number]
    end = int(problem.ends[number])
    goals = []
    beyond = []
    names = problem.chain.names[:2]
    if phase.configuration.keys() >= {*names}:
        place = np.array([phase.configuration[name] for name in names])
        radius = float(np.hypot(*np.ptp(place, axis=1))) / 2
        goals.append(_BaseGoal(place.mean(axis=1), radius + _TOLERANCE))
    for goal in problem.pose_goals:
        if end not in goal.row.waypoints or goal.row.kind == "level" or goal.row.shift is not None:
            continue
        shoulder, length = _compute_arm_reach(problem, goal.row.joint, goal.local.translation)
        position = goal.target.translation
        height = abs(position[2] - shoulder[2])
        if height > length:
            beyond.append(_describe_height(goal, shoulder, length))
        elif np.isfinite(length):
            # At any heading, the shoulder is on a circle about the base's origin.
            radius = float(np.hypot(*shoulder[:2]) + np.sqrt(length**2 - height**2))
            goals.append(_BaseGoal(position[:2].copy(), radius))
    return goals, beyond


def _describe_height(goal: PoseGoal, shoulder: Floats, length: float) -> str:
    """Return how far a goal is too high or low for an arm of some length [m]."""
    z = goal.target.translation[2]
    beyond = abs(z - shoulder[2]) - length
    text = f"{goal.about} at z = {z:.2f} m is {beyond:.3g} m too high or low, "
    if goal.row.joint > _BASE:
        text += f"wherever the base is: it turns about a joint at z = {shoulder[2]:.2f} m, "
        text += f"and the whole arm with it is {length:.2f} m long"
    else:
        text += f"since the base keeps it at z = {shoulder[2]:.2f} m"
    return text


def _compute_arm_reach(
    problem: KinematicProblem, joint: int, local: Floats
) -> tuple[Floats, float]:
    """Return the position of a frame's first joint in the base, (3,), and the reach from it [m]."""
    chain = problem.chain
    model = chain.model
    along = [k for k in model.supports[joint] if k > _BASE]
    if not along:
        return np.asarray(local), _TOLERANCE
    length = float(np.linalg.norm(local)) + _TOLERANCE
    length += sum(float(np.linalg.norm(model.jointPlacements[k].translation)) for k in along[1:])
    for column, owner, factor, offset, slides in chain.coordinates.moves:
        if owner in along and slides:
            bounds = np.array([chain.lower[column], chain.upper[column]])
            length += float(np.abs(factor * bounds + offset).max()) + _TOLERANCE
    return np.asarray(model.jointPlacements[along[0]].translation), length


def _collect_walls(
    problem: KinematicProblem, number: int, point: Floats
) -> tuple[list[Wall], list[str]]:
    """Return the walls that keep a point of the base away in a phase, and their names."""
    part = problem.contacts.phases[number]
    robot = part.shapes[: len(problem.chain.robot.collision.geometryObjects)]
    base = [i for i, shape in enumerate(robot) if shape.parentJoint == _BASE]
    exempt = set[int]()
    for shapes in part.released.values():
        exempt.update(shapes)
    for pair in part.reduced_margins:
        first, second = part.pairs[pair].tolist()
        if first in base:
            exempt.add(second)
    # A wall is checked against every shape of the base.
    pairs_of_base = part.pairs[np.isin(part.pairs[:, 0], base)]
    counts = np.bincount(pairs_of_base[:, 1], minlength=len(part.shapes))
    fixed = []
    for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True)):
        is_fixed = shape.parentJoint == 0 and label != FLOOR and i not in exempt
        if is_fixed and counts[i] == len(base):
            fixed.append(i)
    shift = pin.SE3(np.eye(3), -np.array([*point, 0.0]))
    own = [(part.shapes[i].geometry, shift * part.shapes[i].placement) for i in base]
    key = ("discs", *(solid.key for solid in make_solids(own)))
    discs = problem.cache.get(key, lambda: InscribedDiscs(own))
    walls = discs.make_walls([(part.shapes[i].geometry, part.shapes[i].placement) for i in fixed])
    return walls, [part.labels[i] for i in fixed]


def _has_path(start: Floats, parts: Sequence[_PhaseFloor], cells: CellGrid) -> bool:
    """Return whether the disc certainly has a path from goal to goal, over entirely free cells."""
    half = cells.step * float(np.sqrt(0.5))
    here = np.zeros(cells.shape, bool)
    here[cells.at(start)] = True
    known: dict[tuple[bytes, float], _Window] = {}  # most obstacles recur in the next phase
    for part in parts:
        free = np.ones(cells.shape, bool)
        for wall in part.walls:
            key = (wall.outline.tobytes(), wall.radius)
            if key not in known:
                known[key] = find_blocked_cells(cells, wall, half)
            window, blocked = known[key]
            free[window] &= ~blocked
        here = flood_fill(free, here & free, corners=False)
        for goal in part.goals:
            here &= goal.allows(cells, 0.0)
    return bool(here.any())


def _explain_missing_path(
    problem: KinematicProblem, start: Floats, parts: Sequence[_PhaseFloor], cells: CellGrid
) -> str:
    """Explain the first phase whose goals the base certainly cannot reach, if any."""
    half = cells.step * float(np.sqrt(0.5))
    here = np.zeros(cells.shape, bool)
    here[cells.at(start)] = True
    for part in parts:
        blocked: dict[int, list[_Window]] = {}
        for wall in part.walls:
            window, own = find_blocked_cells(cells, wall, -half)
            if own.any():
                blocked.setdefault(wall.number, []).append((window, own))
        goal = np.ones(cells.shape, bool)
        for base_goal in part.goals:
            goal &= base_goal.allows(cells, half)
        count = np.zeros(cells.shape, np.int16)
        _add_windows(count, itertools.chain.from_iterable(blocked.values()), 1)
        reached = flood_fill(count == 0, here, corners=True)
        if (reached & goal).any():
            here = reached & goal
            continue
        if not goal.any():
            return (
                f"{part.phase.name}: no place for the base, {PROVEN}"
                "the goal is in reach from outside the arena alone"
            )
        if (goal & (count == 0)).any():
            cause = f"no path for the base, {PROVEN}"
            cause += "at any heading, with the arm anywhere, it is cut off by "
            numbers = _find_separating_obstacles(here, goal, reached, blocked, count)
        else:
            cause = f"no place for the base, {PROVEN}"
            cause += "wherever it would have to be, at any heading, it hits "
            numbers = _find_covering_obstacles(goal, blocked, count)
        names = [part.names[number] for number in numbers]
        return f"{part.phase.name}: {cause}{_list_names(problem, part.phase, names)}"
    return ""


def _add_windows(count: NDArray[np.int16], windows: Iterable[_Window], sign: int) -> None:
    for window, own in windows:
        count[window] += sign * own


def _find_separating_obstacles(
    here: Bools,
    goal: Bools,
    reached: Bools,
    blocked: dict[int, list[_Window]],
    count: NDArray[np.int16],
) -> list[int]:
    """Return a minimal set of obstacles that separate the base from its goals."""
    from scipy import ndimage

    border = ndimage.binary_dilation(reached, structure=np.ones((3, 3), bool)) & ~reached

    def separates(free: Bools) -> bool:
        return not (flood_fill(free, here, corners=True) & goal).any()

    return _minimize_obstacles(separates, border, blocked, count)


def _find_covering_obstacles(
    goal: Bools, blocked: dict[int, list[_Window]], count: NDArray[np.int16]
) -> list[int]:
    """Return a minimal set of obstacles that leave no place for the base at its goals."""
    return _minimize_obstacles(lambda free: not (free & goal).any(), goal, blocked, count)


def _minimize_obstacles(
    suffices: Callable[[Bools], bool],
    near: Bools,
    blocked: dict[int, list[_Window]],
    count: NDArray[np.int16],
) -> list[int]:
    """Return a minimal set of obstacles whose free cells satisfy a condition.

    Args:
        suffices: The condition on free cells, shape (X, Y); all obstacles together satisfy it.
        near: Cells whose obstacles are preferred, shape (X, Y).
        blocked: Obstacle → the cells that it blocks.
        count: Number of obstacles that block each cell, shape (X, Y).
    """
    kept = set(blocked)
    preferred = set[int]()
    for number, windows in blocked.items():
        if any((own & near[window]).any() for window, own in windows):
            preferred.add(number)
    others = kept - preferred
    # All others at once, then one obstacle after the other.
    groups = [others]
    groups += [{number} for number in (*sorted(preferred), *sorted(others))]
    for group in groups:
        removed = group & kept
        if not removed:
            continue
        less = count.copy()
        for number in removed:
            _add_windows(less, blocked[number], -1)
        if suffices(less == 0):
            count = less
            kept -= removed
    return sorted(kept)


def _list_names(problem: KinematicProblem, phase: Phase, names: Sequence[str]) -> str:
    """List names in a sentence, with the joint positions of articulated objects among them."""
    distinct = list(dict.fromkeys(names))
    text = ", ".join(distinct[:_MAX_NAMES])
    if len(distinct) > _MAX_NAMES:
        text += f" and {len(distinct) - _MAX_NAMES} more"
    for name in dict.fromkeys(label.partition(".")[0] for label in distinct):
        placed = problem.scene.objects.get(name)
        if placed is None or placed.object.free or not len(placed.state):
            continue
        state = {}
        for joint, value in zip(placed.object.coordinates.names, placed.state, strict=True):
            state[joint] = phase.initial_values.get(f"{name}.{joint}", float(value))
        values = "closed"
        if max(map(abs, state.values())) >= _CLOSED_TOLERANCE:
            values = ", ".join(f"at {joint} = {value:.2f}" for joint, value in state.items())
        text += f"; {name} is {values} meanwhile"
    return text


def find_swept_collisions(problem: KinematicProblem) -> list[str]:
    """Explain which object joint certainly cannot reach its goal; empty if nothing is proven.

    A link that depends on a single joint passes all positions between start and goal on any motion.
    """
    for phase in problem.task.phases:
        for coordinate in phase.values:
            text = _find_collision(problem, phase, coordinate)
            if text:
                return [f"{phase.name}: no path for {coordinate}, {PROVEN}{text}"]
    return []


def _find_collision(problem: KinematicProblem, phase: Phase, coordinate: str) -> str:
    """Return which link a joint moves into what in a phase; empty if no collision is certain."""
    name, _, joint = coordinate.partition(".")
    placed = problem.scene.objects[name]
    if placed.object.free:
        return ""
    begin = phase.initial_values[coordinate]
    end = float(np.clip(phase.values[coordinate], *problem.limits(coordinate)))
    values = np.linspace(begin, end, _SAMPLES)
    sweep = _Sweep(problem, placed, joint, values)
    deepest = -_CERTAIN_OVERLAP
    text = ""
    for label in sweep.links:
        for other in sweep.find_obstacles(label):
            distances = sweep.compute_distances(label, other)
            worst = int(np.argmin(distances))
            if distances[worst] < deepest:
                deepest = float(distances[worst])
                first = values[np.argmax(distances < -_CERTAIN_OVERLAP)]
                text = (
                    f"between {begin:.3g} and {end:.3g}, at {values[worst]:.3g}, {label} – {other} "
                    f"overlap by {-1e3 * deepest:.1f} mm, and first at {first:.3g}"
                )
    return text


class _Sweep:
    """Motion of one joint of an object, among all that stays where it is meanwhile.

    Args:
        problem: The problem.
        placed: The object.
        joint: Its joint.
        values: Positions of the joint, shape (`_SAMPLES`,).

    Attributes:
        links: Labels of the links that this joint alone moves.
    """

    def __init__(
        self, problem: KinematicProblem, placed: PlacedObject, joint: str, values: Floats
    ) -> None:
        scene = problem.scene
        task = problem.task
        # Objects that no hand moves are where the scene has them; of others only the fixed links
        # are.
        moved = {hold.object for hold in task.holds}
        moved |= {supported.object for supported in task.supported}
        objects = {}
        for owner, item in scene.objects.items():
            if owner not in moved or not item.object.free:
                objects[owner] = item
        self._shapes = PlacedShapes(scene, objects)
        self._exemptions = find_clearance_exemptions(scene, problem.options.dist_safe)
        self._index = placed.object.coordinates.index(joint)
        self._values = values
        self.links = []
        self._others = set(scene.obstacle_labels) - {FLOOR}
        for owner, item in objects.items():
            for link in item.object.links:
                label = f"{owner}.{link}"
                joints = self._shapes.find_joints(label)
                if owner == placed.name and joints == [joint]:
                    self.links.append(label)
                if owner != placed.name and (owner not in moved or not joints):
                    self._others.add(label)
        states = dict[str, Floats]()
        for owner, item in objects.items():
            for own_joint, value in zip(item.object.coordinates.names, item.state, strict=True):
                states[f"{owner}.{own_joint}"] = np.full(_SAMPLES, value)
        states[f"{placed.name}.{joint}"] = values
        self._coordinates = list(states)
        self._states = np.column_stack(list(states.values()))

    def find_obstacles(self, label: str) -> list[str]:
        """Return the links that a link passes by closely, in the order of names."""
        near = self._shapes.find_links_near_sweep(label, self._index, self._values)
        return sorted(self._others & near)

    def compute_distances(self, label: str, other: str) -> Floats:
        """Return the distance between two links at each position, shape (`_SAMPLES`,) [m].

        Where an exemption allows an overlap, that much is added to it.
        """
        shapes = self._shapes
        own = shapes.find_shapes([label])
        hit = shapes.find_shapes([other])
        distances = shapes.compute_distances(label, self._index, self._values, hit, 0.0)
        for exemption in self._exemptions:
            if not exemption.is_between(label, other):
                continue
            is_active = exemption.is_active(self._coordinates, self._states)
            pairs = set(exemption.find_shape_pairs(shapes.labels, shapes.keys))
            allowed = max(0.0, -exemption.margin)
            for k, j in itertools.product(range(len(own)), range(len(hit))):
                pair = (min(own[k], hit[j]), max(own[k], hit[j]))
                if pair in pairs:
                    distances[is_active, k, j] += allowed
        return np.asarray(distances.min(axis=(1, 2)))
