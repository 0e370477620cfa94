"""Checks the user's constraints numerically on the plain world model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.sights import find_occlusions
from vkc_pin.world.task.terms import Constraint, Formula, Term

# tolerance between waypoints over that at waypoints
INTERMEDIATE_FACTOR = 10.0


def check_terms(samples: Samples, terms: Sequence[Term]) -> list[Violation]:
    """Return the worst violation of each constraint among `terms`, at and between waypoints.

    A constraint must hold at all waypoints of its phases except the first, which belongs to the
    previous phase or the start, and except while the robot waits for its gripper. The NLP enforces
    constraints at waypoints only. Between them expressions of frames deviate by terms of second
    order in the step, so ten times the tolerance is accepted. Velocities are differences over the
    duration of the current segment, so that they are continuous at waypoints.
    """
    found: list[Violation] = []
    for term in terms:
        if isinstance(term, Constraint):
            found += _check_constraint(samples, term)
    return found


def _check_constraint(samples: Samples, term: Constraint) -> Iterator[Violation]:
    """Yield the worst violation of a constraint at waypoints, and the worst between them."""
    at, between = _find_rows(samples, term)
    rows = np.sort(np.concatenate([at, between]))
    if not len(rows):
        return
    if term.sight is not None:
        for row, link in find_occlusions(samples.world, samples.z, term.sight, rows):
            detail = f"{link} is in front of it"
            yield samples.make_violation("term", term.name, 1.0, "", detail, row=row)
            break
    values = term.formula.evaluate(_compute_inputs(samples, term.formula, rows))
    lower, upper = term.compute_bounds(term.formula.rows)
    excess = np.maximum(lower - values, values - upper)
    excess[np.isnan(excess)] = np.inf
    parts = [
        (at, term.tolerance, ""),
        (between, INTERMEDIATE_FACTOR * term.tolerance, " between waypoints"),
    ]
    for which, tolerance, where in parts:
        mine = np.flatnonzero(np.isin(rows, which))
        if not len(mine):
            continue
        worst = int(np.argmax(excess[mine]))
        k, entry = divmod(worst, len(lower))
        amount = float(excess[mine[k], entry])
        if amount <= tolerance:
            continue
        value = float(values[mine[k], entry])
        if value < lower[entry]:
            side = f"less than {lower[entry]:.6g}"
        else:
            side = f"more than {upper[entry]:.6g}"
        name = f"entry {entry}: " if len(lower) > 1 else ""
        detail = f"{name}{value:.6g} is {side} by {amount:.3g}{where}"
        row = int(rows[mine[k]])
        yield samples.make_violation("term", term.name, amount, "", detail, row=row)


def _find_rows(samples: Samples, term: Constraint) -> tuple[Ints, Ints]:
    """Return the samples at which a constraint must hold: at waypoints, and between them."""
    trajectory = samples.trajectory
    positions = trajectory.positions
    is_asked = np.zeros(len(trajectory.times), bool)  # at each waypoint
    for phase in trajectory.phases:
        if not term.is_active(phase.name, phase.held):
            continue
        inside = slice(phase.first + 1, phase.last + 1)
        moved = np.abs(positions[inside] - positions[phase.first]).max(axis=1)
        has_left = np.logical_or.accumulate(moved > 0.0)
        is_asked[inside] = has_left | is_asked[phase.first]
        is_asked[phase.last] |= phase.first > 0 or bool(has_left.any())
    at = samples.waypoint_rows[is_asked]
    between = [np.zeros(0, int)]
    for waypoint in np.flatnonzero(is_asked[1:] & is_asked[:-1]):
        begin, end = samples.waypoint_rows[waypoint : waypoint + 2]
        between.append(np.arange(begin + 1, end))
    return at, np.concatenate(between)


def _compute_inputs(samples: Samples, formula: Formula, rows: Ints) -> Floats:
    """Compute the inputs of a formula at samples, shape (S, 2·half + 1)."""
    trajectory = samples.trajectory
    begin = trajectory.times[0]
    # The waypoint at which the segment of each sample ends.
    ends = np.searchsorted(samples.waypoint_rows, rows)
    # Duration of each segment [s]; 1 s for the first waypoint, which ends none.
    dt = np.diff(trajectory.times, prepend=begin - 1.0)[ends]
    now = _compute_state_inputs(samples, formula, samples.z[rows])
    before = now
    if formula.uses_previous:
        times = samples.times[rows] - dt
        order = np.argsort(times, kind="stable")
        ordered = np.maximum(times[order], begin)
        earlier = np.empty((len(rows), samples.z.shape[1]))
        earlier[order] = samples.world.compute_positions(trajectory, ordered)
        before = _compute_state_inputs(samples, formula, earlier)
    return np.column_stack([now, before, dt])


def _compute_state_inputs(samples: Samples, formula: Formula, z: Floats) -> Floats:
    """Compute a formula's frame placements and coordinates at configurations, shape (S, half)."""
    model = samples.world.model
    coordinates = samples.world.coordinates
    data = model.createData()
    frames = [model.getFrameId(name) for name in formula.frames]
    inputs = np.empty((len(z), formula.state_size))
    if frames:
        for row, q in zip(inputs, coordinates.q(z), strict=True):
            pin.forwardKinematics(model, data, q)
            for k, frame in enumerate(frames):
                placement = pin.updateFramePlacement(model, data, frame)
                row[12 * k : 12 * k + 9] = placement.rotation.T.ravel()
                row[12 * k + 9 : 12 * k + 12] = placement.translation
    for k, name in enumerate(formula.coordinates, start=12 * len(frames)):
        inputs[:, k] = z[:, coordinates.index(name)]
    return inputs
