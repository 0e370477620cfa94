"""Builds the rows of user-defined constraints and costs, exact to second order.

There is one SX function for each kind of waypoint.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.kinematic_tree import KinematicTree, get_kinematics
from vkc_pin.planning.kinematics.batch import estimate_size
from vkc_pin.planning.nlp.sparse import assemble, get_pattern
from vkc_pin.utils.arrays import Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.task.terms import Formula


@dataclass(frozen=True)
class Value:
    """A coordinate: a column of the chain, or a constant if `column` is None."""

    column: int | None
    number: float = 0.0


@dataclass(frozen=True)
class Tree:
    """The kinematic tree of an object in the world."""

    model: str  # `pinocchio.Model` as text
    base: tuple[float, ...]  # placement of its root: R column by column and p, 12 numbers
    values: tuple[Value, ...]  # minimal coordinates


@dataclass(frozen=True)
class FrameLocation:
    """The location of a frame.

    Attributes:
        local: Its placement in the joint's frame: R column by column and p, 12 numbers.
        joint: Joint of the chain, or of `tree`, that carries it; 0 is the world, or the root of the
            tree.
        waypoint: Waypoint whose coordinates matter; -1 if the frame is fixed.
        tree: Kinematic tree of the object that the joint belongs to.
    """

    local: tuple[float, ...]
    joint: int = 0
    waypoint: int = -1
    tree: Tree | None = None


@dataclass(frozen=True)
class TermLocation:
    """A term at a waypoint: locations of its frames there and at the waypoint before."""

    waypoint: int
    now: tuple[FrameLocation, ...]
    before: tuple[FrameLocation, ...]


@dataclass(frozen=True)
class TermRow:
    """A constraint (without weight) or cost at the waypoints at which it depends on a variable."""

    formula: Formula
    weight: float | None
    values: tuple[Value, ...]
    locations: tuple[TermLocation, ...]

    def kind(self, at: TermLocation) -> tuple[tuple[int, ...], tuple[TermLocation, int]]:
        """Return the waypoints that the term depends on at `at`, and the key of its function.

        The waypoints increase. The key is `at` with waypoints replaced by positions among these,
        and the position of the previous waypoint if the formula depends on it; terms with equal
        keys share a function.
        """
        uses_previous = self.formula.uses_previous
        frames = at.now
        if uses_previous:
            frames += at.before
        involved = {frame.waypoint for frame in frames if frame.waypoint >= 0}
        if any(value.column is not None for value in self.values):
            involved.add(at.waypoint)
            if uses_previous:
                involved.add(at.waypoint - 1)
        waypoints = tuple(sorted(involved))

        def position(waypoint: int) -> int:
            return waypoints.index(waypoint) if waypoint in waypoints else -1

        def relocate(frames: tuple[FrameLocation, ...]) -> tuple[FrameLocation, ...]:
            return tuple(replace(frame, waypoint=position(frame.waypoint)) for frame in frames)

        now = relocate(at.now)
        before = relocate(at.before) if uses_previous else now
        last = position(at.waypoint - 1 if uses_previous else at.waypoint)
        return waypoints, (TermLocation(position(at.waypoint), now, before), last)


class TermFunctions:
    """SX functions of one kind of row.

    Their arguments are z of all waypoints involved, the step duration and the mounts.

    Attributes:
        value, jacobian, hessian: The formula, the nonzeros of its Jacobian, and those of the
            Hessian of λ·formula, upper triangle.
        jacobian_pattern, hessian_pattern: Their rows and columns.
    """

    def __init__(
        self,
        tree: KinematicTree,
        row: TermRow,
        at: TermLocation,
        before: int,
        waypoints: int,
        cache: Cache,
    ) -> None:
        n = tree.coordinates.size
        formula = row.formula
        z = ca.SX.sym("z", n * waypoints)
        dt = ca.SX.sym("dt")
        mounts = ca.SX.sym("P", 12, tree.mount_count)
        multipliers = ca.SX.sym("lam", formula.rows)
        points = ca.vertsplit(z, n) if waypoints else []
        placements_by_waypoint: dict[int, Any] = {}

        def build_placement(frame: FrameLocation) -> Any:
            """Return the placement of a frame in the world, 12 numbers."""
            local = _to_matrix(ca.DM(frame.local))
            if frame.tree is not None:
                joint = _place_in_tree(frame, frame.tree, points, cache)
                return _to_column(joint @ local)
            if frame.joint == 0:
                return ca.DM(frame.local)
            if frame.waypoint not in placements_by_waypoint:
                kinematics = get_kinematics(tree, cache)
                placements = kinematics.build_placements(points[frame.waypoint], mounts)
                placements_by_waypoint[frame.waypoint] = placements
            joint = _to_matrix(placements_by_waypoint[frame.waypoint][:, frame.joint - 1])
            return _to_column(joint @ local)

        inputs = []
        for frames, position in ((at.now, at.waypoint), (at.before, before)):
            inputs += [build_placement(frame) for frame in frames]
            inputs += [_get_value(value, points, position) for value in row.values]
        value = formula.function(ca.vertcat(*inputs, dt))
        jacobian = ca.jacobian(value, z)
        hessian = ca.triu(ca.hessian(ca.dot(multipliers, value), z)[0])
        slopes = ca.vertcat(*jacobian.nonzeros())
        curvatures = ca.vertcat(*hessian.nonzeros())
        options = {"cse": True}
        given = [z, dt, ca.vec(mounts)]
        self.value = ca.Function("term", given, [value], options)
        self.jacobian = ca.Function("term_jacobian", given, [slopes], options)
        self.hessian = ca.Function("term_hessian", [*given, multipliers], [curvatures], options)
        self.jacobian_pattern = get_pattern(jacobian)
        self.hessian_pattern = get_pattern(hessian)
        self.nbytes = estimate_size(self.value, self.jacobian, self.hessian)


def _get_value(value: Value, points: list[Any], waypoint: int) -> Any:
    if value.column is None:
        return ca.SX(value.number)
    return points[waypoint][value.column]


def _place_in_tree(frame: FrameLocation, tree: Tree, points: list[Any], cache: Cache) -> Any:
    """Return the world placement of the joint of a frame in an object's tree, shape (4, 4)."""
    base = _to_matrix(ca.DM(tree.base))
    if frame.joint == 0:
        return base
    model = pin.Model()
    model.loadFromString(tree.model)
    values = [_get_value(value, points, frame.waypoint) for value in tree.values]
    own = KinematicTree(model, model)
    placements = get_kinematics(own, cache).build_placements(ca.vertcat(*values), None)
    return base @ _to_matrix(placements[:, frame.joint - 1])


def _to_matrix(column: Any) -> Any:
    """Return R (column by column) and p as a homogeneous matrix."""
    top = ca.horzcat(ca.reshape(column[:9], 3, 3), column[9:])
    return ca.vertcat(top, ca.DM([[0.0, 0.0, 0.0, 1.0]]))


def _to_column(matrix: Any) -> Any:
    """Return a homogeneous matrix as R (column by column) and p."""
    return ca.densify(ca.vec(matrix[:3, :]))


class TermProgram:
    """All terms of a program.

    Attributes:
        rows: Number of constraint rows.
        rows_by_waypoint: For each term, waypoint → its rows; empty for costs.
        row_waypoints: Waypoint of each row, counted from 0, shape (rows,).
        values, jacobian: Values of the constraints and their Jacobian.
        cost, gradient, cost_hessian: Weighted sum of all costs and its derivatives.
    """

    def __init__(
        self,
        tree: KinematicTree,
        terms: tuple[TermRow, ...],
        z: Any,
        dt: Any,
        mounts: Any,
        cache: Cache,
        width: int,
    ) -> None:
        """Assemble the terms.

        Args:
            tree: Joints of the virtual kinematic chain.
            terms: The terms.
            z: z_0..z_N as columns, shape (n, N + 1).
            dt: Step durations, shape (N, 1).
            mounts: Placements of the mounted joints, see `KinematicTree.mounts`.
            cache: Cache of the functions.
            width: Number of variables per waypoint, z first.
        """
        self._n = z.shape[0]
        self._width = width
        self._size = (z.shape[1] - 1) * width
        self._hessians: list[tuple[ca.Function, list[Any], Ints, Ints, Any]] = []
        self.rows = 0
        self.rows_by_waypoint = [dict[int, Ints]() for _ in terms]
        self.cost: Any = ca.MX(0)
        values = [ca.MX(0, 1)]
        # nonzeros and positions of each kind of waypoint
        jacobians = list[tuple[Any, Ints]]()
        gradients = list[tuple[Any, Ints]]()
        curvatures = list[tuple[Any, Ints]]()
        row_waypoints = [np.zeros(0, int)]
        for term, rows_by_waypoint in zip(terms, self.rows_by_waypoint, strict=True):
            for (at, before), locations in _group_by_kind(term).items():
                waypoint_count = len(locations[0][1])
                key = ("term", tree.key, term.formula, term.values, at, before, waypoint_count)
                functions = cache.get(
                    key,
                    functools.partial(TermFunctions, tree, term, at, before, waypoint_count, cache),
                )
                involved = np.array([waypoints for _, waypoints in locations])
                steps = np.array([waypoint - 1 for waypoint, _ in locations])
                points = ca.vertcat(*[z[:, columns.tolist()] for columns in involved.T])
                height = term.formula.rows
                count = len(locations)
                flat_mounts = ca.repmat(ca.vec(mounts), 1, count)
                inputs = [points, dt[steps.tolist()].T, flat_mounts]
                rows = self.rows + height * np.arange(count)[:, None] + np.arange(height)
                value = ca.vec(functions.value.map(count)(*inputs))
                row, column = functions.jacobian_pattern
                slopes, positions = _select_variables(
                    ca.vec(functions.jacobian.map(count)(*inputs)),
                    rows[:, row].ravel(),
                    self._find_variables(involved, column),
                )
                hessian = (functions.hessian, inputs, involved)
                if term.weight is None:
                    values.append(value)
                    jacobians.append((slopes, positions))
                    rows_by_waypoint.update(zip(steps + 1, rows, strict=True))
                    row_waypoints.append(np.repeat(steps, height))
                    self._hessians.append((*hessian, rows, functions.hessian_pattern))
                    self.rows += height * count
                else:
                    self.cost += term.weight * ca.sum1(value)
                    # The gradient is a column: the Jacobian's columns become its rows.
                    positions = np.stack([positions[1], np.zeros_like(positions[1])])
                    gradients.append((term.weight * slopes, positions))
                    weights = ca.DM.ones(1, count) * term.weight
                    curvatures.append(
                        self._weight_hessians(*hessian, functions.hessian_pattern, weights)
                    )
        self.row_waypoints = np.concatenate(row_waypoints)
        self.values = ca.vertcat(*values)
        self.jacobian = _assemble(jacobians, self.rows, self._size)
        self.gradient = _assemble(gradients, self._size, 1)
        self.cost_hessian = _assemble(curvatures, self._size, self._size)

    def hessian(self, multipliers: Any) -> Any:
        """Return the upper triangle of the Hessian of multipliers·values."""
        parts = []
        for function, inputs, involved, rows, pattern in self._hessians:
            count, height = rows.shape
            own = ca.reshape(multipliers[rows.ravel().tolist()], height, count)
            parts.append(self._weight_hessians(function, inputs, involved, pattern, own))
        return _assemble(parts, self._size, self._size)

    def _weight_hessians(
        self,
        function: ca.Function,
        inputs: list[Any],
        involved: Ints,
        pattern: Any,
        multipliers: Any,
    ) -> tuple[Any, Ints]:
        """Return nonzeros and positions of the Hessians of all waypoints of a kind."""
        nonzeros = ca.vec(function.map(len(involved))(*inputs, multipliers))
        row, column = pattern
        return _select_variables(
            nonzeros, self._find_variables(involved, row), self._find_variables(involved, column)
        )

    def _find_variables(self, involved: Ints, index: Ints) -> Ints:
        """Return the variables of entries `index` of z for all waypoints of a kind; -1: start."""
        waypoint = involved[:, index // self._n]
        coordinate = index % self._n
        return np.where(waypoint > 0, (waypoint - 1) * self._width + coordinate, -1).ravel()


def _group_by_kind(
    term: TermRow,
) -> dict[tuple[TermLocation, int], list[tuple[int, tuple[int, ...]]]]:
    """Return kind of location → waypoint, and waypoints it depends on, of each location."""
    kinds: dict[tuple[TermLocation, int], list[tuple[int, tuple[int, ...]]]] = {}
    for at in term.locations:
        waypoints, kind = term.kind(at)
        kinds.setdefault(kind, []).append((at.waypoint, waypoints))
    return kinds


def _select_variables(nonzeros: Any, row: Ints, column: Ints) -> tuple[Any, Ints]:
    """Return nonzeros and their positions, without those of the start."""
    at = np.flatnonzero((row >= 0) & (column >= 0))
    return nonzeros[at.tolist()], np.stack([row[at], column[at]])


def _assemble(parts: list[tuple[Any, Ints]], rows: int, columns: int) -> Any:
    if not parts:
        return ca.MX(rows, columns)
    return assemble([part for part, _ in parts], [at for _, at in parts], rows, columns)
