"""What is impossible for certain, whatever else might be tried: goals out of reach, and floor that the base is cut off from."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.planning.base_paths.blocked_cells import solids_of
from vkc_pin.planning.base_paths.reachable_floor import Cells, Discs, Wall, flooded, taken
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.task.phases import Phase

__all__ = ["PROVEN", "proofs"]

PROVEN = "proven: "
"""What comes before that part of a note which is certain."""

_COARSE = (
    0.1  # [m] cells in which a way is looked for: where there is one, there is nothing to prove
)
_FINE, _MOST = 0.02, 400_000  # [m] and number of cells otherwise
# [m] that a base may be out of the arena, or a frame away from its goal: more than validation lets
# pass
_LEEWAY = 0.02
_NAMED = 6  # obstacles
_SHUT = 0.05  # [rad] or [m] from where a joint is shut
_BASE = 1  # the joint of the model that is the base


_Window = tuple[tuple[slice, slice], Bools]
"""Some cells, and which of them are taken."""


@dataclass(frozen=True, eq=False)
class _Goal:
    """Where a point of the base must be at the end of a phase: within `radius` [m] of `at`, shape (2,) [m]; nan: anywhere."""

    at: Floats
    radius: float

    def allows(self, cells: Cells, grown: float) -> Bools:
        """Return which cells have their centre no further away than the radius and so much [m], shape (X, Y)."""
        x, y = (
            np.nan_to_num(centers - at)
            for centers, at in zip(cells.centers(), self.at, strict=True)
        )
        return np.asarray(np.hypot(x, y) <= self.radius + grown)


@dataclass(frozen=True, eq=False)
class _Part:
    """A phase: where the base must be at its end, and what keeps it away meanwhile, by number of `names`."""

    phase: Phase
    goals: Sequence[_Goal]
    walls: Sequence[Wall]
    names: Sequence[str]


def proofs(problem: TrajectoryProblem) -> list[str]:
    """Return why a task is impossible for certain; no line at all proves nothing.

    What a phase holds is no obstacle in it, nor is what the motion itself leaves at a place that it
    chooses.
    """
    if problem.chain.robot.base == "fixed":
        return []
    goals = []
    for number, phase in enumerate(problem.task.phases):
        found, beyond = _goals(problem, number)
        if beyond:
            return [f"{phase.name}: out of reach, {PROVEN}{text}" for text in beyond]
        goals.append(found)
    low, high = (
        np.array(side)
        for side in zip(*(problem.limits(name) for name in problem.chain.names[:2]), strict=True)
    )
    x, y, yaw = problem.start[:3].tolist()
    for point in _points(problem):
        away = float(np.hypot(*point))
        start = (
            np.array([x, y])
            + np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ point
        )
        parts = []
        for number, phase in enumerate(problem.task.phases):
            own = [_Goal(goal.at, goal.radius + away) for goal in goals[number]]
            parts.append(_Part(phase, own, *_standing(problem, number, point)))
        begin, end = low - _LEEWAY - away, high + _LEEWAY + away
        step = max(_FINE, float(np.sqrt(np.prod(end - begin) / _MOST)))
        if not any(part.goals for part in parts) or _passes(
            start, parts, Cells.over(begin, end, _COARSE)
        ):
            continue
        missed = _missed(problem, start, parts, Cells.over(begin, end, step))
        if missed:
            return missed
    return []


def _points(problem: TrajectoryProblem) -> list[Floats]:
    """Return points fixed in the base, shape (2,) [m], whose ways are looked for: its origin, and where it is highest."""
    robot = problem.chain.robot.collision.geometryObjects
    solids = solids_of(
        [(shape.geometry, shape.placement) for shape in robot if shape.parentJoint == _BASE]
    )
    if not solids:
        return []
    corners = max(solids, key=lambda solid: solid.top).points[:, :2]
    return [np.zeros(2), (corners.min(axis=0) + corners.max(axis=0)) / 2.0]


def _goals(problem: TrajectoryProblem, number: int) -> tuple[list[_Goal], list[str]]:
    """Return where the base must be at the end of a phase, at least, and what is out of reach from anywhere."""
    phase, end = problem.task.phases[number], int(problem.ends[number])
    goals, beyond = [], []
    if phase.base is not None:
        x, y = (np.nan if value is None else float(value) for value in phase.base[:2])
        goals.append(_Goal(np.array([x, y]), _LEEWAY))
    for goal in problem.pose_goals:
        if end in goal.row.waypoints and goal.row.kind != "level" and goal.row.shift is None:
            shoulder, length = _arm(problem, goal.row.joint, goal.row.local.translation)
            at = goal.target.translation
            height = abs(at[2] - shoulder[2])
            if height > length:
                beyond.append(
                    f"{goal.about} at z = {at[2]:.2f} m is {height - length:.2f} m too high or low, wherever the base is: "
                    f"it turns about a joint at z = {shoulder[2]:.2f} m, and the whole arm with it is {length:.2f} m long"
                )
            elif np.isfinite(length):
                goals.append(
                    _Goal(
                        at[:2].copy(),
                        float(np.hypot(*shoulder[:2]) + np.sqrt(length**2 - height**2)),
                    )
                )
    return goals, beyond


def _arm(problem: TrajectoryProblem, joint: int, local: Floats) -> tuple[Floats, float]:
    """Return the place in the base of the first joint on the way to a frame, shape (3,), and how far from that it can be [m]."""
    chain = problem.chain
    model, along = chain.model, [k for k in chain.model.supports[joint] if k > _BASE]
    if not along:
        return np.asarray(local), _LEEWAY
    length = float(np.linalg.norm(local)) + _LEEWAY
    length += sum(float(np.linalg.norm(model.jointPlacements[k].translation)) for k in along[1:])
    for column, owner, factor, offset, slides in chain.coordinates.moves:
        if owner in along and slides:
            length += (
                float(
                    max(
                        abs(factor * bound + offset)
                        for bound in (chain.lower[column], chain.upper[column])
                    )
                )
                + _LEEWAY
            )
    return np.asarray(model.jointPlacements[along[0]].translation), length


def _standing(
    problem: TrajectoryProblem, number: int, point: Floats
) -> tuple[list[Wall], list[str]]:
    """Return what surely keeps a point of the base away in a phase, and the names of what stands there."""
    part = problem.contacts.phases[number]
    robot = part.shapes[: len(problem.chain.robot.collision.geometryObjects)]
    base = [i for i, shape in enumerate(robot) if shape.parentJoint == _BASE]
    left = {i for own in part.released.values() for i in own}
    eased = {
        int(part.pairs[pair, 1]) for pair in part.reduced_margins if part.pairs[pair, 0] in base
    }
    hits = np.bincount(part.pairs[np.isin(part.pairs[:, 0], base), 1], minlength=len(part.shapes))
    solid = [
        i
        for i, (shape, label) in enumerate(zip(part.shapes, part.labels, strict=True))
        if shape.parentJoint == 0
        and label != FLOOR
        and hits[i] == len(base)
        and i not in left | eased
    ]
    below, shapes = (
        [(part.shapes[i].geometry, part.shapes[i].placement) for i in which]
        for which in (base, solid)
    )
    below = [
        (shape, pin.SE3(np.eye(3), -np.array([*point, 0.0])) * where) for shape, where in below
    ]
    key = ("discs", *(solid.key for solid in solids_of(below)))
    discs = problem.cache.get(key, lambda: Discs(below))
    return discs.walls(shapes), [part.labels[i] for i in solid]


def _passes(start: Floats, parts: Sequence[_Part], cells: Cells) -> bool:
    """Return whether the disc surely finds a way from goal to goal: it keeps to cells all of which are free."""
    half = cells.step * float(np.sqrt(0.5))
    here = np.zeros(cells.shape, bool)
    here[cells.at(start)] = True
    known: dict[tuple[bytes, float], _Window] = {}  # most stands where it is from phase to phase
    for part in parts:
        free = np.ones(cells.shape, bool)
        for wall in part.walls:
            key = (wall.outline.tobytes(), wall.radius)
            if key not in known:
                known[key] = taken(cells, wall, half)
            window, own = known[key]
            free[window] &= ~own
        here = flooded(free, here & free, corners=False)
        for goal in part.goals:
            here &= goal.allows(cells, 0.0)
        if not here.any():
            return False
    return True


def _missed(
    problem: TrajectoryProblem, start: Floats, parts: Sequence[_Part], cells: Cells
) -> list[str]:
    """Return a line about the first phase whose goals the base surely cannot get to, if any."""
    half = cells.step * float(np.sqrt(0.5))
    here = np.zeros(cells.shape, bool)
    here[cells.at(start)] = True
    for part in parts:
        taking: dict[int, list[_Window]] = {}
        for wall in part.walls:
            window, own = taken(cells, wall, -half)
            if own.any():
                taking.setdefault(wall.number, []).append((window, own))
        goal = np.ones(cells.shape, bool)
        for one in part.goals:
            goal &= one.allows(cells, half)
        cut = _Cut(here, goal, taking)
        here = cut.reached & goal
        if not here.any():
            if not goal.any():
                return [
                    f"{part.phase.name}: no place for the base, {PROVEN}the goal is in reach from outside the arena alone"
                ]
            names = [part.names[number] for number in cut.obstacles()]
            return [f"{part.phase.name}: {cut.what}{_listed(problem, part.phase, names)}"]
    return []


class _Cut:
    """What is between where the base is and where it is to go.

    Attributes:
        reached: Cells that it may get to.
        what: The beginning of a sentence about it.
    """

    def __init__(self, here: Bools, goal: Bools, taking: dict[int, list[_Window]]) -> None:
        self.here, self.goal, self.taking = here, goal, taking
        self.count = np.zeros(here.shape, np.int16)
        for window, own in itertools.chain.from_iterable(taking.values()):
            self.count[window] += own
        self.reached = flooded(self.count == 0, here, corners=True)
        stands = (goal & (self.count == 0)).any()
        self.what = (
            f"no way for the base, {PROVEN}at any heading, with the arm anywhere, it is cut off by "
            if stands
            else f"no place for the base, {PROVEN}wherever it would have to be, at any heading, it hits "
        )

    def obstacles(self) -> list[int]:
        """Return few obstacles that cut it off: each of them is needed for that."""
        from scipy import ndimage

        beside = (
            ndimage.binary_dilation(self.reached, structure=np.ones((3, 3), bool)) & ~self.reached
        )
        seen = {
            k
            for k, windows in self.taking.items()
            if any((own & beside[window]).any() for window, own in windows)
        }
        count, kept = self.count.copy(), set(self.taking)
        for some in (
            kept - seen,
            *({number} for number in sorted(seen)),
            *({number} for number in sorted(kept - seen)),
        ):
            some = some & kept
            less = count.copy()
            for window, own in itertools.chain.from_iterable(
                self.taking[number] for number in some
            ):
                less[window] -= own
            if some and not (flooded(less == 0, self.here, corners=True) & self.goal).any():
                count, kept = less, kept - some
        return sorted(kept)


def _listed(problem: TrajectoryProblem, phase: Phase, names: Sequence[str]) -> str:
    """Return names for people, and what stands shut among them."""
    found = list(dict.fromkeys(names))
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    text = ", ".join(found[:_NAMED]) + more
    for name in dict.fromkeys(label.partition(".")[0] for label in found):
        placed = problem.scene.objects.get(name)
        if placed is None or placed.object.free or not len(placed.state):
            continue
        joints = placed.object.coordinates.names
        state = [
            phase.initial_values.get(f"{name}.{joint}", float(value))
            for joint, value in zip(joints, placed.state, strict=True)
        ]
        ajar = ", ".join(
            f"at {joint} = {value:.2f}" for joint, value in zip(joints, state, strict=True)
        )
        text += f"; {name} stands {'shut' if max(map(abs, state)) < _SHUT else ajar} meanwhile"
    return text
