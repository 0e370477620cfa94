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
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.clearance_exemptions import PlacedShapes, find_clearance_exemptions
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.task.phases import Phase

PROVEN = "proven: "
"""Prefix of the part of a note that is certain."""

_COARSE_CELL = 0.1  # [m] cells for finding a path, which makes a proof unnecessary
_FINE_CELL, _MAX_CELLS = 0.02, 400_000  # [m] and number of cells for proofs
# [m] by which a base may leave the arena, or a frame miss its goal: more than validation accepts
_TOLERANCE = 0.02
_MAX_NAMES = 6  # obstacles named in a message
_CLOSED_TOLERANCE = 0.05  # [rad], [m] up to which a joint counts as closed
_BASE = 1  # the joint of the model that is the base

# window of cells, and a mask of those that are blocked
_Window = tuple[tuple[slice, slice], Bools]
_CERTAIN_OVERLAP = 1e-3  # [m] more than validation accepts
_SAMPLES = 200  # joint values between start and goal


class _BaseGoal(NamedTuple):
    """Where a point of the base must be at the end of a phase: a disc; NaN: anywhere."""

    center: Floats
    radius: float

    def allows(self, cells: CellGrid, grown: float) -> Bools:
        """Return which cell centres are within the radius plus `grown` [m], shape (X, Y)."""
        x, y = (
            np.nan_to_num(centers - at)
            for centers, at in zip(cells.centers(), self.center, strict=True)
        )
        return np.asarray(np.hypot(x, y) <= self.radius + grown)


class _PhaseFloor(NamedTuple):
    """A phase with the goals of the base and the walls that keep it away, numbered as `names`."""

    phase: Phase
    goals: Sequence[_BaseGoal]
    walls: Sequence[Wall]
    names: Sequence[str]


def find_proofs(problem: TrajectoryProblem) -> list[str]:
    """Explain why a task is certainly impossible; the result is empty if nothing is proven.

    Attached objects are no obstacles, nor are objects that the motion itself leaves at a place of
    its choice.
    """
    if problem.chain.robot.base == "fixed":
        return []
    goals = []
    for number, phase in enumerate(problem.task.phases):
        found, beyond = _find_base_goals(problem, number)
        if beyond:
            return [f"{phase.name}: out of reach, {PROVEN}{text}" for text in beyond]
        goals.append(found)
    low, high = np.array([problem.limits(name) for name in problem.chain.names[:2]]).T
    x, y, yaw = problem.start[:3].tolist()
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for point in _find_tracked_points(problem):
        offset, start = float(np.hypot(*point)), np.array([x, y]) + turn @ point
        parts = []
        for number, phase in enumerate(problem.task.phases):
            own = [_BaseGoal(goal.center, goal.radius + offset) for goal in goals[number]]
            parts.append(_PhaseFloor(phase, own, *_collect_walls(problem, number, point)))
        begin, end = low - _TOLERANCE - offset, high + _TOLERANCE + offset
        step = max(_FINE_CELL, float(np.sqrt(np.prod(end - begin) / _MAX_CELLS)))
        coarse, fine = (CellGrid.over(begin, end, size) for size in (_COARSE_CELL, step))
        if any(part.goals for part in parts) and not _has_path(start, parts, coarse):
            explanation = _explain_missing_path(problem, start, parts, fine)
            if explanation:
                return [explanation]
    return []


def _find_tracked_points(problem: TrajectoryProblem) -> list[Floats]:
    """Return points of the base to track, (2,) [m] each: its origin, and where it is highest."""
    robot = problem.chain.robot.collision.geometryObjects
    solids = make_solids(
        [(shape.geometry, shape.placement) for shape in robot if shape.parentJoint == _BASE]
    )
    if not solids:
        return []
    corners = max(solids, key=lambda solid: solid.top).points[:, :2]
    return [np.zeros(2), (corners.min(axis=0) + corners.max(axis=0)) / 2.0]


def _find_base_goals(problem: TrajectoryProblem, number: int) -> tuple[list[_BaseGoal], list[str]]:
    """Return necessary base positions at a phase's end, and reasons why goals are unreachable."""
    phase, end = problem.task.phases[number], int(problem.ends[number])
    goals, beyond = [], []
    names = problem.chain.names[:2]
    if phase.configuration.keys() >= {*names}:
        place = np.array([phase.configuration[name] for name in names])
        radius = float(np.hypot(*np.ptp(place, axis=1))) / 2
        goals.append(_BaseGoal(place.mean(axis=1), radius + _TOLERANCE))
    for goal in problem.pose_goals:
        if end not in goal.row.waypoints or goal.row.kind == "level" or goal.row.shift is not None:
            continue
        frame = goal.row.joint, goal.local.translation
        shoulder, length = _compute_arm_reach(problem, *frame)
        at = goal.target.translation
        height = abs(at[2] - shoulder[2])
        if height > length:
            text = f"{goal.about} at z = {at[2]:.2f} m is {height - length:.3g} m too high or low, "
            if goal.row.joint > _BASE:
                text += f"wherever the base is: it turns about a joint at z = {shoulder[2]:.2f} m, "
                text += f"and the whole arm with it is {length:.2f} m long"
            else:
                text += f"since the base keeps it at z = {shoulder[2]:.2f} m"
            beyond.append(text)
        elif np.isfinite(length):
            radius = float(np.hypot(*shoulder[:2]) + np.sqrt(length**2 - height**2))
            goals.append(_BaseGoal(at[:2].copy(), radius))
    return goals, beyond


def _compute_arm_reach(
    problem: TrajectoryProblem, joint: int, local: Floats
) -> tuple[Floats, float]:
    """Return the position of a frame's first joint in the base, (3,), and the reach from it [m]."""
    chain = problem.chain
    model, along = chain.model, [k for k in chain.model.supports[joint] if k > _BASE]
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
    problem: TrajectoryProblem, number: int, point: Floats
) -> tuple[list[Wall], list[str]]:
    """Return the walls that keep a point of the base away in a phase, and their names."""
    part = problem.contacts.phases[number]
    robot = part.shapes[: len(problem.chain.robot.collision.geometryObjects)]
    base = [i for i, shape in enumerate(robot) if shape.parentJoint == _BASE]
    exempt = {i for own in part.released.values() for i in own} | {
        int(part.pairs[pair, 1]) for pair in part.reduced_margins if part.pairs[pair, 0] in base
    }
    hits = np.bincount(part.pairs[np.isin(part.pairs[:, 0], base), 1], minlength=len(part.shapes))
    fixed = [
        i
        for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True))
        if shape.parentJoint == 0 and label != FLOOR and hits[i] == len(base) and i not in exempt
    ]
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
            window, own = known[key]
            free[window] &= ~own
        here = flood_fill(free, here & free, corners=False)
        for goal in part.goals:
            here &= goal.allows(cells, 0.0)
    return bool(here.any())


def _explain_missing_path(
    problem: TrajectoryProblem, start: Floats, parts: Sequence[_PhaseFloor], cells: CellGrid
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
        for one in part.goals:
            goal &= one.allows(cells, half)
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
    seen = {
        number
        for number, windows in blocked.items()
        if any((own & near[window]).any() for window, own in windows)
    }
    order = [*sorted(seen), *sorted(kept - seen)]
    for some in (kept - seen, *({number} for number in order)):
        some = some & kept
        less = count.copy()
        _add_windows(less, itertools.chain.from_iterable(blocked[number] for number in some), -1)
        if some and suffices(less == 0):
            count, kept = less, kept - some
    return sorted(kept)


def _list_names(problem: TrajectoryProblem, phase: Phase, names: Sequence[str]) -> str:
    """List names in a sentence, with the joint positions of articulated objects among them."""
    found = list(dict.fromkeys(names))
    more = f" and {len(found) - _MAX_NAMES} more" if len(found) > _MAX_NAMES else ""
    text = ", ".join(found[:_MAX_NAMES]) + more
    for name in dict.fromkeys(label.partition(".")[0] for label in found):
        placed = problem.scene.objects.get(name)
        if placed is None or placed.object.free or not len(placed.state):
            continue
        state = {
            joint: phase.initial_values.get(f"{name}.{joint}", float(value))
            for joint, value in zip(placed.object.coordinates.names, placed.state, strict=True)
        }
        is_closed = max(map(abs, state.values())) < _CLOSED_TOLERANCE
        values = ", ".join(f"at {joint} = {value:.2f}" for joint, value in state.items())
        text += f"; {name} is {'closed' if is_closed else values} meanwhile"
    return text


def find_swept_collisions(problem: TrajectoryProblem) -> list[str]:
    """Explain which object joint certainly cannot reach its goal; empty if nothing is proven.

    A link that depends on a single joint passes all positions between start and goal on any motion.
    """
    for phase in problem.task.phases:
        for coordinate in phase.values:
            text = _find_collision(problem, phase, coordinate)
            if text:
                return [f"{phase.name}: no path for {coordinate}, {PROVEN}{text}"]
    return []


def _find_collision(problem: TrajectoryProblem, phase: Phase, coordinate: str) -> str:
    """Return which link a joint moves into what in a phase; empty if no collision is certain."""
    scene, (name, _, joint) = problem.scene, coordinate.partition(".")
    placed = scene.objects[name]
    if placed.object.free:
        return ""
    begin = phase.initial_values[coordinate]
    end = float(np.clip(phase.values[coordinate], *problem.limits(coordinate)))
    values = np.linspace(begin, end, _SAMPLES)
    # Objects that no hand moves are where the scene has them; of others only the fixed links are.
    task = problem.task
    moved = {hold.object for hold in task.holds} | {one.object for one in task.supported}
    objects = {
        owner: one
        for owner, one in scene.objects.items()
        if owner not in moved or not one.object.free
    }
    shapes = PlacedShapes(scene, objects)
    exemptions = find_clearance_exemptions(scene, problem.options.dist_safe)
    links = {
        f"{owner}.{link}": shapes.find_joints(f"{owner}.{link}")
        for owner, one in objects.items()
        for link in one.object.links
    }
    swept = [f"{name}.{link}" for link in placed.object.links if links[f"{name}.{link}"] == [joint]]
    others = set(scene.obstacle_labels) - {FLOOR}
    for label, joints in links.items():
        owner = label.partition(".")[0]
        if owner != name and (owner not in moved or not joints):
            others.add(label)
    states = {
        f"{owner}.{own_joint}": np.full(_SAMPLES, value)
        for owner, one in objects.items()
        for own_joint, value in zip(one.object.coordinates.names, one.state, strict=True)
    }
    states[coordinate] = values
    names, rows = list(states), np.column_stack(list(states.values()))
    deepest, text = -_CERTAIN_OVERLAP, ""
    index = placed.object.coordinates.index(joint)
    for label in swept:
        for other in sorted(others & shapes.find_links_near_sweep(label, index, values)):
            own, hit = shapes.find_shapes([label]), shapes.find_shapes([other])
            distances = shapes.compute_distances(label, index, values, hit, 0.0)
            for one in exemptions:
                if not one.is_between(label, other):
                    continue
                is_active = one.is_active(names, rows)
                pairs = set(one.find_shape_pairs(shapes.labels, shapes.keys))
                for k, j in itertools.product(range(len(own)), range(len(hit))):
                    if (min(own[k], hit[j]), max(own[k], hit[j])) in pairs:
                        distances[is_active, k, j] += max(0.0, -one.margin)
            distance = distances.min(axis=(1, 2))
            worst = int(np.argmin(distance))
            if distance[worst] < deepest:
                deepest = float(distance[worst])
                first = values[np.argmax(distance < -_CERTAIN_OVERLAP)]
                text = (
                    f"between {begin:.3g} and {end:.3g}, at {values[worst]:.3g}, {label} – {other} "
                    f"overlap by {-1e3 * deepest:.1f} mm, and first at {first:.3g}"
                )
    return text
