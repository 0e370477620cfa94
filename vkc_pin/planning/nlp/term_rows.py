"""A user's own constraints and costs as rows of the program, exact to second order: one SX function for each kind of waypoint."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin

from vkc_pin.planning.chain.kinematics import kinematics_of
from vkc_pin.planning.kinematics.batch import size_of
from vkc_pin.planning.nlp.sparse import assemble
from vkc_pin.utils.arrays import Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.task.formula import Formula

__all__ = ["FrameAt", "TermAt", "TermProgram", "TermRow", "Tree", "Value"]


@dataclass(frozen=True)
class Value:
    """A coordinate: that of a column of the chain, or a number if there is none."""

    column: int | None
    number: float = 0.0


@dataclass(frozen=True)
class Tree:
    """An object's own kinematic tree, standing in the world.

    Attributes:
        model: Its `pinocchio.Model`, as text.
        base: Where its root stands: R by columns and p, 12 numbers.
        values: Its minimal coordinates.
    """

    model: str
    base: tuple[float, ...]
    values: tuple[Value, ...]


@dataclass(frozen=True)
class FrameAt:
    """Where a frame is.

    Attributes:
        local: Its placement in the joint's frame: R by columns and p, 12 numbers.
        joint: Joint of the chain, or of `tree`, that carries it; 0 is the world, or what the tree
            stands on.
        waypoint: Of which the coordinates count; -1 if none do.
        tree: The object's own tree that the joint is one of.
    """

    local: tuple[float, ...]
    joint: int = 0
    waypoint: int = -1
    tree: Tree | None = None


@dataclass(frozen=True)
class TermAt:
    """A term at a waypoint: where the frames are that it depends on, there and at the waypoint before."""

    waypoint: int
    now: tuple[FrameAt, ...]
    before: tuple[FrameAt, ...]


@dataclass(frozen=True)
class TermRow:
    """A constraint or cost at some waypoints.

    Attributes:
        formula: Its expression.
        weight: Of a cost; None: a constraint.
        values: The coordinates that it depends on.
        at: The waypoints at which it depends on something that can change.
    """

    formula: Formula
    weight: float | None
    values: tuple[Value, ...]
    at: tuple[TermAt, ...]

    def kind(self, at: TermAt) -> tuple[tuple[int, ...], tuple[TermAt, int]]:
        """Return the waypoints of which it depends, increasing, and what is equal where one function serves.

        That is `at` with waypoints as positions among these, and the position of the waypoint
        before, if that counts.
        """
        places = (*at.now, *(at.before if self.formula.moving else ()))
        involved = {place.waypoint for place in places if place.waypoint >= 0}
        if any(value.column is not None for value in self.values):
            involved |= {at.waypoint, at.waypoint - 1} if self.formula.moving else {at.waypoint}
        waypoints = tuple(sorted(involved))

        def position(waypoint: int) -> int:
            return waypoints.index(waypoint) if waypoint in waypoints else -1

        now = tuple(replace(place, waypoint=position(place.waypoint)) for place in at.now)
        before = (
            tuple(replace(place, waypoint=position(place.waypoint)) for place in at.before)
            if self.formula.moving
            else now
        )
        last = position(at.waypoint - 1) if self.formula.moving else position(at.waypoint)
        return waypoints, (TermAt(position(at.waypoint), now, before), last)


class TermFunctions:
    """The SX functions of one kind of row: of z of all waypoints involved, in one column, and the time of the step.

    Attributes:
        value, jacobian, hessian: The formula, nonzeros of its Jacobian, and of the Hessian of
            λ·formula, upper triangle.
        jacobian_pattern, hessian_pattern: Rows and columns of these.
    """

    def __init__(
        self, model: pin.Model, row: TermRow, at: TermAt, before: int, waypoints: int, cache: Cache
    ) -> None:
        coordinates, formula = Coordinates(model), row.formula
        z, dt, multipliers = (
            ca.SX.sym("z", coordinates.size * waypoints),
            ca.SX.sym("dt"),
            ca.SX.sym("lam", formula.rows),
        )
        points = ca.vertsplit(z, coordinates.size) if waypoints else []
        chain: dict[int, Any] = {}

        def column(place: FrameAt) -> Any:
            local = _matrix(ca.DM(place.local))
            if place.tree is not None:
                return _column(_in_tree(place, points, cache) @ local)
            if place.joint == 0:
                return ca.DM(place.local)
            if place.waypoint not in chain:
                chain[place.waypoint] = kinematics_of(model, cache).symbolic(points[place.waypoint])
            return _column(_matrix(chain[place.waypoint][:, place.joint - 1]) @ local)

        inputs = []
        for places, position in ((at.now, at.waypoint), (at.before, before)):
            inputs += [column(place) for place in places]
            inputs += [
                points[position][v.column] if v.column is not None else ca.SX(v.number)
                for v in row.values
            ]
        value = formula.function(ca.vertcat(*inputs, dt))
        jacobian, hessian = (
            ca.jacobian(value, z),
            ca.triu(ca.hessian(ca.dot(multipliers, value), z)[0]),
        )
        options = {"cse": True}
        self.value = ca.Function("term", [z, dt], [value], options)
        self.jacobian = ca.Function(
            "term_jacobian", [z, dt], [ca.vertcat(*jacobian.nonzeros())], options
        )
        self.hessian = ca.Function(
            "term_hessian", [z, dt, multipliers], [ca.vertcat(*hessian.nonzeros())], options
        )
        self.jacobian_pattern = [np.array(part, int) for part in jacobian.sparsity().get_triplet()]
        self.hessian_pattern = [np.array(part, int) for part in hessian.sparsity().get_triplet()]
        self.nbytes = size_of(self.value, self.jacobian, self.hessian)


def _in_tree(place: FrameAt, points: list[Any], cache: Cache) -> Any:
    """Return where the joint of a place in an object's tree is in the world, shape (4, 4)."""
    tree = place.tree
    assert tree is not None
    base = _matrix(ca.DM(tree.base))
    if place.joint == 0:
        return base
    model = pin.Model()
    model.loadFromString(tree.model)
    values = [
        points[place.waypoint][v.column] if v.column is not None else ca.SX(v.number)
        for v in tree.values
    ]
    placements = kinematics_of(model, cache).symbolic(ca.vertcat(*values))
    return base @ _matrix(placements[:, place.joint - 1])


def _matrix(column: Any) -> Any:
    """Return R by columns and p as a homogeneous matrix."""
    return ca.vertcat(
        ca.horzcat(ca.reshape(column[:9], 3, 3), column[9:]), ca.DM([[0.0, 0.0, 0.0, 1.0]])
    )


def _column(matrix: Any) -> Any:
    """Return a homogeneous matrix as R by columns and p."""
    return ca.densify(ca.vec(matrix[:3, :]))


class TermProgram:
    """All terms of a program.

    Attributes:
        rows: Number of constraint rows.
        at: For each term, waypoint → its rows; costs have none.
        owners: The waypoint of each row, counted from 0, shape (rows,).
        values, jacobian: Of the constraints.
        cost, gradient, cost_hessian: Of the weighted sum of all costs.
    """

    def __init__(
        self,
        model: pin.Model,
        terms: tuple[TermRow, ...],
        z: Any,
        dt: Any,
        cache: Cache,
        *,
        width: int | None = None,
    ) -> None:
        """Put the terms together.

        Args:
            model: The chain.
            terms: What to put together.
            z: z_0..z_N as columns, shape (n, N + 1).
            dt: Time of every step, shape (N, 1).
            cache: Where the functions are kept.
            width: How many variables a waypoint has, z first; None: n.
        """
        self._n = z.shape[0]
        self._width = width or self._n
        self._size = (z.shape[1] - 1) * self._width
        self._hessians: list[tuple[ca.Function, list[Any], Ints, Ints, Any]] = []
        self.rows, self.at = 0, [dict[int, Ints]() for _ in terms]
        text = model.saveToString()
        self.cost: Any = ca.MX(0)
        values, slopes, slopes_at = [], [], []
        gradients, gradients_at, curvatures, curvatures_at = [], [], [], []
        for term, rows_at in zip(terms, self.at, strict=True):
            kinds: dict[tuple[TermAt, int], list[tuple[int, tuple[int, ...]]]] = {}
            for at in term.at:
                waypoints, kind = term.kind(at)
                kinds.setdefault(kind, []).append((at.waypoint, waypoints))
            for (at, before), found in kinds.items():
                how = (term, at, before, len(found[0][1]))
                key = ("term", text, term.formula, term.values, *how[1:])
                functions = cache.get(key, functools.partial(TermFunctions, model, *how, cache))
                involved = np.array([waypoints for _, waypoints in found])
                steps = [waypoint - 1 for waypoint, _ in found]
                inputs = [
                    ca.vertcat(*(z[:, columns.tolist()] for columns in involved.T)),
                    dt[steps].T,
                ]
                height, count = term.formula.rows, len(found)
                first = self.rows + height * np.arange(count)
                value = ca.vec(functions.value.map(count)(*inputs))
                slope = ca.vec(functions.jacobian.map(count)(*inputs))
                row, column = functions.jacobian_pattern
                where = np.stack([(first[:, None] + row).ravel(), self._place(involved, column)])
                kept = where[1] >= 0  # the others are about the start
                where, slope = where[:, kept], slope[np.flatnonzero(kept).tolist()]
                if term.weight is None:
                    values.append(value)
                    slopes.append(slope)
                    slopes_at.append(where)
                    rows = first[:, None] + np.arange(height)
                    rows_at.update(zip((waypoint for waypoint, _ in found), rows, strict=True))
                    self._hessians.append(
                        (functions.hessian, inputs, involved, rows, functions.hessian_pattern)
                    )
                    self.rows += height * count
                else:
                    self.cost += term.weight * ca.sum1(value)
                    gradients.append(term.weight * slope)
                    gradients_at.append(np.stack([where[1], np.zeros_like(where[1])]))
                    weights, pattern = ca.DM.ones(1, count) * term.weight, functions.hessian_pattern
                    curvature, place = self._curvature(
                        functions.hessian, inputs, involved, pattern, weights
                    )
                    curvatures.append(curvature)
                    curvatures_at.append(place)
        self.owners = np.zeros(self.rows, int)
        for waypoint, rows in (
            (waypoint, rows) for rows_at in self.at for waypoint, rows in rows_at.items()
        ):
            self.owners[rows] = waypoint - 1
        self.values = ca.vertcat(*values) if values else ca.MX(0, 1)
        self.jacobian = (
            assemble(slopes, slopes_at, self.rows, self._size)
            if slopes
            else ca.MX(self.rows, self._size)
        )
        self.gradient = (
            assemble(gradients, gradients_at, self._size, 1) if gradients else ca.MX(self._size, 1)
        )
        empty = ca.MX(self._size, self._size)
        self.cost_hessian = (
            assemble(curvatures, curvatures_at, self._size, self._size) if curvatures else empty
        )

    def hessian(self, multipliers: Any) -> Any:
        """Return the upper triangle of the Hessian of multipliers·values."""
        parts, at = [], []
        for function, inputs, involved, rows, pattern in self._hessians:
            given = ca.reshape(multipliers[rows.ravel().tolist()], rows.shape[1], rows.shape[0])
            part, place = self._curvature(function, inputs, involved, pattern, given)
            parts.append(part)
            at.append(place)
        return (
            assemble(parts, at, self._size, self._size) if parts else ca.MX(self._size, self._size)
        )

    def _curvature(
        self,
        function: ca.Function,
        inputs: list[Any],
        involved: Ints,
        pattern: Any,
        multipliers: Any,
    ) -> Any:
        """Return nonzeros of the Hessian of all waypoints of a kind, and where they are; what is about the start is left out."""
        part = ca.vec(function.map(len(involved))(*inputs, multipliers))
        row, column = (self._place(involved, index) for index in pattern)
        kept = (row >= 0) & (column >= 0)
        return part[np.flatnonzero(kept).tolist()], np.stack([row[kept], column[kept]])

    def _place(self, involved: Ints, index: Ints) -> Ints:
        """Return which variables entries of a kind's z are, for all its waypoints one after the other; -1 for the start's."""
        waypoint, coordinate = involved[:, index // self._n], index % self._n
        return np.where(waypoint > 0, (waypoint - 1) * self._width + coordinate, -1).ravel()
