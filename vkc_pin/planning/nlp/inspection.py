"""Describes a program before it is solved: witness planes, size and sparsity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.chain.contacts import ContactModel
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.compiler import compile_task
from vkc_pin.world.task.phases import summarize_phases
from vkc_pin.world.task.steps import Step
from vkc_pin.world.task.terms import Term, check_terms_active, trace_terms

_EXTRA_REACH = 0.3  # [m]: distances larger than the plane's by more than this are not computed


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane:
    """The witness plane of a pair at a waypoint, which models their distance (eqs. 6 and 7).

    Attributes:
        problem, contacts: The program, and the collision model of the motion.
        waypoint: Waypoint, counted from 1.
        names: The two links or obstacles.
        pair: Their geometries, shape (2,).
        distance: Signed distance of the pair, from coal [m].
        margin: Required clearance [m].
        coefficients, offset: C, shape (12·joints,), and R: C·vec(M(z)) − R ≥ 0 states that the pair
            keeps its margin.
        gradient: Gradient of the plane's value used by the solver, shape (n,), [m/m] or [m/rad].
    """

    problem: TrajectoryProblem
    contacts: ContactModel
    waypoint: int
    names: tuple[str, str]
    pair: Ints
    distance: float
    margin: float
    coefficients: Floats
    offset: float
    gradient: Floats

    def values(self, z: Floats) -> Floats:
        """Return the distance predicted by the plane at z, shape (W, n): shape (W,) [m]."""
        rotations, translations = self.problem.chain.joint_placements(z)
        columns_of_rotations = rotations[:, 1:].swapaxes(2, 3)
        columns_of_translations = translations[:, 1:, None]
        placements = np.concatenate([columns_of_rotations, columns_of_translations], axis=2)
        stacked = placements.reshape(len(z), -1)  # vec(M)
        return np.asarray(self.margin + stacked @ self.coefficients - self.offset)

    def distances(self, z: Floats) -> Floats:
        """Return the distance from coal at z, shape (W, n): shape (W,) [m]; NaN if out of reach."""
        reach = max(self.distance, 0.0) + _EXTRA_REACH
        found = self.contacts.evaluate(z, np.full(len(z), self.waypoint), reach=reach)
        is_pair = (found.pair == self.pair).all(axis=1)
        distances = np.full(len(z), np.nan)
        distances[found.waypoint[is_pair]] = found.distance[is_pair]
        return distances


def planes(problem: TrajectoryProblem, z: Floats, waypoint: int) -> list[Plane]:
    """Return the witness planes at a waypoint, those with the largest shortfall first.

    Args:
        problem: The program.
        z: z_1..z_N, shape (N, n).
        waypoint: Waypoint, counted from 1.
    """
    t = problem.transcription
    phase = problem.contacts.find_phase(waypoint)
    labels = problem.contacts.phases[phase].labels
    model = problem.contacts.with_released_objects(z)
    waypoints = np.arange(1, problem.segments + 1)
    contacts = model.evaluate(z, waypoints, reach=problem.options.contact_reach, nearest=t.slots)
    coefficients, offsets = model.compute_planes(z, contacts, slots=t.slots)
    parameters = t.parameter_vector(
        planes=coefficients,
        offsets=offsets,
        penalty=problem.options.penalty,
        **problem.parameters_at(z, problem.timing_for(z).dt),
    )
    slopes = ca.Function("slopes", [t.x, t.parameters], [t.jacobian])
    jacobian = slopes(t.pack(z), parameters).sparse().tocsr()
    columns = (waypoint - 1) * t.width + np.arange(t.n)
    row_of_z = waypoint - 1
    found = list[Plane]()
    for slot, k in enumerate(np.flatnonzero(contacts.waypoint == row_of_z)):
        slopes_of_row = jacobian[int(t.slot_rows[row_of_z, slot])].toarray().ravel()
        first, second = contacts.pair[k]
        plane = Plane(
            problem=problem,
            contacts=model,
            waypoint=waypoint,
            names=(labels[first], labels[second]),
            pair=contacts.pair[k],
            distance=float(contacts.distance[k]),
            margin=float(contacts.margin[k]),
            coefficients=coefficients[row_of_z, slot],
            offset=float(offsets[row_of_z, slot]),
            gradient=slopes_of_row[columns],
        )
        found.append(plane)
    return found


def sizes(problem: TrajectoryProblem) -> dict[str, int]:
    """Return the number of variables and rows of each kind.

    The velocity and acceleration rows are part of the program only if it turns out to need them.
    """
    t = problem.transcription
    dt = np.full(problem.segments, problem.options.dt)
    velocities, accelerations = problem.rates(problem.still, dt)
    fixed = int((problem.lower == problem.upper).sum())
    counts = {
        "variables: coordinates": problem.lower.size - fixed,
        "variables: coordinates, fixed by bounds": fixed,
        "variables: slacks": t.slot_rows.size,
        "variables: relaxation": t.segments,
    }
    for goal, rows_by_waypoint in zip(problem.pose_goals, t.pose_rows, strict=True):
        kind = f"rows: {goal.name}"
        rows_of_goal = sum(len(rows) for rows in rows_by_waypoint.values())
        counts[kind] = counts.get(kind, 0) + rows_of_goal
    clamped = sum(last - first for _, first, last in t.structure.clamped)
    counts["rows: witness planes"] = t.slot_rows.size
    counts["rows: rolling"] = len(t.base_rows)
    counts["rows: clamped freedoms"] = clamped
    counts["rows: pushes"] = len(t.pushed_rows)
    counts["rows: user-defined constraints"] = len(problem.term_evaluator.rows)
    counts["only if needed: velocities"] = velocities.size
    counts["only if needed: accelerations"] = accelerations.size
    return counts


def patterns(problem: TrajectoryProblem) -> tuple[Any, Any]:
    """Return the sparsity of the rows' Jacobian and the Lagrangian's Hessian, as SciPy matrices."""
    t = problem.transcription
    upper = t.objective_curvature.sparsity() + t.hessian.sparsity()
    jacobian = ca.DM(t.jacobian.sparsity(), 1.0)
    hessian = ca.DM(upper + upper.T, 1.0)
    return jacobian.sparse(), hessian.sparse()


def build(
    scene: Scene,
    steps: Sequence[Step],
    *,
    options: Options | None = None,
    terms: Sequence[Term] = (),
    cache: Cache | None = None,
) -> TrajectoryProblem:
    """Return the nonlinear program of `steps` in `scene`, for inspection before solving.

    Args:
        scene: Robot, objects and obstacles.
        steps: Steps of the task.
        options: Planning options.
        terms: User-defined constraints and costs.
        cache: Cache of symbolic programs, for problems of the same structure in the same thread.
            Defaults to one of its own.

    Raises:
        InputError: The steps or terms refer to an unknown name, or the task is impossible.
    """
    options = Options() if options is None else check_instance(options, Options, "options")
    cache = None if cache is None else check_instance(cache, Cache, "cache")
    check_instance(scene, Scene, "scene")
    task = compile_task(scene, steps, options)
    terms = trace_terms(scene, terms)
    check_terms_active(terms, summarize_phases(task))
    return TrajectoryProblem(scene, task, options, terms, cache=cache)
