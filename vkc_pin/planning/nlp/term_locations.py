"""Locates the frames of user-defined terms in a task, and evaluates the terms along a motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.nlp.pose_goals import find_phase_spans
from vkc_pin.planning.nlp.term_rows import FrameLocation, TermLocation, TermRow, Tree, Value
from vkc_pin.planning.nlp.transcription import Transcription
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task, summarize_phases
from vkc_pin.world.task.terms import Cost, Term

# factor by which steps are lengthened at a time, and its maximum in total
_STRETCH_FACTOR = 1.2
_MAX_STRETCH = 8.0
# Scaled violation of a term that is violated by its tolerance, comparable to pose residuals.
_TOLERANCE_SCALE = 1e-3


def locate_terms(
    scene: Scene, chain: VirtualKinematicChain, task: Task, terms: Sequence[Term]
) -> tuple[tuple[TermRow, ...], tuple[Term, ...]]:
    """Return the program rows of traced terms that can change something, and these terms."""
    locator = _FrameLocator(scene, chain, task)
    rows = []
    used_terms = []
    for term in terms:
        formula = term.formula
        values = tuple(locator.resolve_coordinate(name) for name in formula.coordinates)
        weight = term.weight if isinstance(term, Cost) else None
        row = TermRow(formula, weight, values, ())
        locations = []
        for location in _locate_term(locator, term, task):
            waypoints, _ = row.kind(location)
            if any(waypoint > 0 for waypoint in waypoints):  # otherwise it is constant
                locations.append(location)
        if locations:
            rows.append(TermRow(formula, weight, values, tuple(locations)))
            used_terms.append(term)
    return tuple(rows), tuple(used_terms)


def _locate_term(locator: _FrameLocator, term: Term, task: Task) -> list[TermLocation]:
    """Return the locations of a term at the waypoints of its phases after their first."""
    locations = []
    for number, (name, held) in enumerate(summarize_phases(task)):
        if not term.is_active(name, held):
            continue
        _, first, last = locator.spans[number]
        for waypoint in range(first + 1, last + 1):
            now = locator.locate_frames(term.formula.frames, number, waypoint)
            # The first waypoint of a phase is the last of the one before.
            number_before = number if waypoint - 1 > first else max(number - 1, 0)
            before = locator.locate_frames(term.formula.frames, number_before, waypoint - 1)
            locations.append(TermLocation(waypoint, now, before))
    return locations


class _FrameLocator:
    """Locates frames and coordinates at the waypoints of a task."""

    def __init__(self, scene: Scene, chain: VirtualKinematicChain, task: Task) -> None:
        self.scene = scene
        self.chain = chain
        self.spans = find_phase_spans(task)

    def resolve_coordinate(self, name: str) -> Value:
        """Return a coordinate of the scene as a column of the chain or a constant."""
        if name in self.chain.names:
            return Value(self.chain.index(name))
        owner, _, joint = name.partition(".")
        placed = self.scene.objects[owner]
        return Value(None, float(placed.state[placed.object.coordinates.index(joint)]))

    def locate_frames(
        self, frames: Sequence[str], number: int, waypoint: int
    ) -> tuple[FrameLocation, ...]:
        """Return the locations of frames at a waypoint of phase `number`."""
        return tuple(self.locate_frame(frame, number, waypoint) for frame in frames)

    def locate_frame(self, frame: str, number: int, waypoint: int) -> FrameLocation:
        """Return the location of a frame at a waypoint of phase `number`."""
        owner, dot, link = frame.partition(".")
        phase = self.spans[number][0]
        if not dot or owner not in self.scene.objects:
            return self._locate_on_chain(waypoint, self.chain.frame(frame, opening=phase.opening))
        placed = self.scene.objects[owner]
        if not placed.object.free:  # independent of holds: if it is grasped, the chain is closed
            return self._locate_in_tree(placed, link, waypoint)
        for hold in phase.held:
            if hold.object == owner:
                return self._locate_on_chain(waypoint, self.chain.frame(link, hold))
        if owner in phase.released_by:  # it is where the hand released it
            hold, last_phase = phase.released_by[owner]
            _, _, release = self.spans[last_phase]
            return self._locate_on_chain(release, self.chain.frame(link, hold))
        resting = phase.resting.get(owner, placed.placement)
        placement = resting * placed.object.link_placement(link, placed.state)
        return FrameLocation(_flatten_placement(placement))

    def _locate_in_tree(self, placed: PlacedObject, link: str, waypoint: int) -> FrameLocation:
        model = placed.object.model
        frame = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
        values = []
        for name in placed.object.coordinates.names:
            values.append(self.resolve_coordinate(f"{placed.name}.{name}"))
        tree = Tree(model.saveToString(), _flatten_placement(placed.placement), tuple(values))
        moves = frame.parentJoint > 0 and any(value.column is not None for value in values)
        local = _flatten_placement(frame.placement)
        return FrameLocation(local, frame.parentJoint, waypoint if moves else -1, tree)

    def _locate_on_chain(self, waypoint: int, at: tuple[int, pin.SE3]) -> FrameLocation:
        joint, local = at
        return FrameLocation(_flatten_placement(local), joint, waypoint if joint else -1)


def _flatten_placement(placement: pin.SE3) -> tuple[float, ...]:
    (row,) = flatten_placements([placement]).tolist()
    return tuple(row)


class TermEvaluator:
    """Evaluates the terms of a program along a motion.

    Attributes:
        rows: Program rows of the constraints, shape (R,).
        lower, upper: Their bounds, shape (R,).
        scale: Factor from violation to scaled violation, shape (R,).
    """

    def __init__(
        self, terms: Sequence[Term], transcription: Transcription, start: Floats, mounts: Floats
    ) -> None:
        self.terms = terms
        self.mounts = mounts
        self.transcription = transcription
        self.start = start
        # Concatenation needs at least one part each.
        rows = [np.zeros(0, int)]
        bounds = [np.zeros((0, 2))]
        scales = [np.zeros(0)]
        timed = [np.zeros(0, bool)]
        names = []
        for term, rows_by_waypoint in zip(terms, transcription.term_rows, strict=True):
            if isinstance(term, Cost):
                continue
            for own_rows in rows_by_waypoint.values():
                count = len(own_rows)
                rows.append(own_rows)
                bounds.append(np.column_stack(term.compute_bounds(count)))
                scales.append(np.full(count, _TOLERANCE_SCALE / term.tolerance))
                timed.append(np.full(count, term.formula.uses_time_step))
                names += [term.name] * count
        order = np.argsort(np.concatenate(rows))
        self.rows = np.concatenate(rows)[order]
        self.lower, self.upper = np.concatenate(bounds)[order].T
        self.scale = np.concatenate(scales)[order]
        self._timed = np.concatenate(timed)[order]
        self._names = [names[k] for k in order]

    def compute_violation(self, z: Floats, dt: Floats) -> float:
        """Return the largest scaled violation of a constraint at z_1..z_N; 1e-3: tolerance."""
        return float(self._compute_excess(z, dt).max(initial=0.0))

    def compute_cost(self, z: Floats, dt: Floats) -> float:
        """Return the weighted sum of all costs."""
        if not self.terms:
            return 0.0
        _, _, cost, _ = self._evaluate(z, dt)
        return cost

    def lengthen_steps(self, z: Floats, dt: Floats, runs: Sequence[tuple[int, int]]) -> Floats:
        """Return step durations that satisfy the time-dependent constraints, as far as possible.

        All steps of a run, given by its first and last waypoint, take the same time.
        """
        t = self.transcription
        waypoint = t.row_waypoints[self.rows - t.first_relaxed_row]  # counted from 0
        for begin, end in runs:
            depends_on_time = self._timed & (waypoint >= begin) & (waypoint < end)
            if not depends_on_time.any():
                continue
            best_factor = 1.0
            least_excess = np.inf
            trial = dt.copy()
            factor = 1.0
            while factor <= _MAX_STRETCH and least_excess > _TOLERANCE_SCALE:
                trial[begin:end] = factor * dt[begin:end]
                excess = float(self._compute_excess(z, trial)[depends_on_time].max())
                if excess < least_excess * (1.0 - 1e-3):
                    best_factor = factor
                    least_excess = excess
                factor *= _STRETCH_FACTOR
            dt = np.concatenate([dt[:begin], best_factor * dt[begin:end], dt[end:]])
        return dt

    def check(self, z: Floats, dt: Floats) -> None:
        """Raise an InputError unless values and derivatives of the terms are finite at z_1..z_N."""
        if not self.terms:
            return
        values, jacobian, cost, gradient = self._evaluate(z, dt)
        rows_of_nonzeros, _ = jacobian.sparsity().get_triplet()
        undefined_nonzeros = ~np.isfinite(jacobian.nonzeros())
        is_undefined = ~np.isfinite(values)
        is_undefined[np.array(rows_of_nonzeros, int)[undefined_nonzeros]] = True
        names = {self._names[row] for row in np.flatnonzero(is_undefined)}
        if not (np.isfinite(cost) and np.isfinite(gradient).all()):
            names |= {term.name for term in self.terms if isinstance(term, Cost)}
        if names:
            raise InputError(
                "its value or derivative is not finite at the start",
                field=f"terms[{min(names)!r}].expression",
                expected="a smooth expression, e.g. cos(a) >= 0.98 instead of a <= 0.2, "
                "or squares instead of roots",
            )

    def _compute_excess(self, z: Floats, dt: Floats) -> Floats:
        if not len(self.rows):
            return np.zeros(0)
        values, _, _, _ = self._evaluate(z, dt)
        beyond_bounds = np.maximum(self.lower - values, values - self.upper)
        excess = np.maximum(beyond_bounds, 0.0) * self.scale
        return np.where(np.isnan(excess), np.inf, excess)

    def _evaluate(self, z: Floats, dt: Floats) -> tuple[Floats, Any, float, Any]:
        """Return values and Jacobian of the constraints, and sum and gradient of the costs."""
        x = self.transcription.pack(z)
        values, jacobian, cost, gradient = self.transcription.term_values(
            x, self.start, dt, self.mounts.T
        )
        return np.asarray(values).ravel(), jacobian, float(cost), np.asarray(gradient.nonzeros())
