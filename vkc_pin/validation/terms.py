"""Checks the user's constraints numerically on the plain world model."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.task.terms import Constraint, Formula, Term

INTERMEDIATE_FACTOR = 10.0  # tolerance between waypoints over that at waypoints


def check_terms(samples: Samples, terms: Sequence[Term]) -> list[Violation]:
    """Return the worst violation of each constraint among `terms`, at and between waypoints.

    A constraint must hold at all waypoints of its phases except the first, which belongs to the
    previous phase or the start, and except while the robot waits for its gripper. The NLP enforces
    constraints at waypoints only. Between them expressions of frames deviate by terms of second
    order in the step, so ten times the tolerance is accepted. Velocities are differences over the
    duration of the current segment, so that they are continuous at waypoints.
    """
    found = []
    for term in (term for term in terms if isinstance(term, Constraint)):
        at, between = _find_rows(samples, term)
        rows = np.sort(np.concatenate([at, between]))
        if not len(rows):
            continue
        values = term.formula.evaluate(_compute_inputs(samples, term.formula, rows))
        lower, upper = term.compute_bounds(term.formula.rows)
        excess = np.maximum(lower - values, values - upper)
        excess[np.isnan(excess)] = np.inf
        for which, tolerance in (
            (at, term.tolerance),
            (between, INTERMEDIATE_FACTOR * term.tolerance),
        ):
            mine = np.flatnonzero(np.isin(rows, which))
            if not len(mine):
                continue
            k, entry = (
                int(i) for i in np.unravel_index(np.argmax(excess[mine]), (len(mine), len(lower)))
            )
            row, amount = int(rows[mine[k]]), float(excess[mine[k], entry])
            if amount <= tolerance:
                continue
            value = float(values[mine[k], entry])
            side = (
                f"less than {lower[entry]:.6g}"
                if value < lower[entry]
                else f"more than {upper[entry]:.6g}"
            )
            name = f"entry {entry}: " if len(lower) > 1 else ""
            where = " between waypoints" if which is between else ""
            detail = f"{name}{value:.6g} is {side} by {amount:.3g}{where}"
            found.append(samples.make_violation("term", term.name, amount, "", detail, row=row))
    return found


def _find_rows(samples: Samples, term: Constraint) -> tuple[Ints, Ints]:
    """Return the samples at which a constraint must hold: at waypoints, and between them."""
    trajectory = samples.trajectory
    asked = np.zeros(len(trajectory.times), bool)
    for phase in trajectory.phases:
        if term.is_active(phase.name, phase.held):
            inside = slice(phase.first + 1, phase.last + 1)
            left = (
                np.abs(trajectory.positions[inside] - trajectory.positions[phase.first]).max(axis=1)
                > 0.0
            )
            asked[inside] = np.logical_or.accumulate(left) | asked[phase.first]
            asked[phase.last] |= phase.first > 0 or bool(left.any())
    at = samples.waypoint_rows[asked]
    edges = itertools.pairwise(samples.waypoint_rows.tolist())
    inner = [
        np.arange(a + 1, b)
        for (a, b), both in zip(edges, asked[1:] & asked[:-1], strict=True)
        if both
    ]
    return at, np.concatenate([np.zeros(0, int), *inner])


def _compute_inputs(samples: Samples, formula: Formula, rows: Ints) -> Floats:
    """Compute the inputs of a formula at samples, shape (S, 2·half + 1)."""
    # The waypoint at which the segment of each sample ends.
    ends = np.searchsorted(samples.waypoint_rows, rows)
    dt = np.diff(samples.trajectory.times, prepend=samples.trajectory.times[0] - 1.0)[ends]
    now = before = _compute_state_inputs(samples, formula, samples.z[rows])
    if formula.uses_previous:
        times = samples.times[rows] - dt
        order = np.argsort(times, kind="stable")
        earlier = np.empty((len(rows), samples.z.shape[1]))
        earlier[order] = samples.world.compute_positions(
            samples.trajectory, np.maximum(times[order], samples.trajectory.times[0])
        )
        before = _compute_state_inputs(samples, formula, earlier)
    return np.column_stack([now, before, dt])


def _compute_state_inputs(samples: Samples, formula: Formula, z: Floats) -> Floats:
    """Compute a formula's frame placements and coordinates at configurations, shape (S, half)."""
    model, coordinates = samples.world.model, samples.world.coordinates
    data = model.createData()
    frames = [model.getFrameId(name) for name in formula.frames]
    found = np.empty((len(z), formula.state_size))
    for row, q in zip(found, coordinates.q(z) if frames else (), strict=False):
        pin.forwardKinematics(model, data, q)
        for k, frame in enumerate(frames):
            placement = pin.updateFramePlacement(model, data, frame)
            row[12 * k : 12 * k + 9] = placement.rotation.T.ravel()
            row[12 * k + 9 : 12 * k + 12] = placement.translation
    for k, name in enumerate(formula.coordinates, start=12 * len(frames)):
        found[:, k] = z[:, coordinates.index(name)]
    return found
