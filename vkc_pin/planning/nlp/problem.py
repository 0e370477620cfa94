"""Formulates one task in one scene as a nonlinear program (eqs. 1 to 7) over one or more phases."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.chain.pose import ROW_BOUNDS
from vkc_pin.planning.nlp.kinematic_problem import KinematicProblem
from vkc_pin.planning.nlp.objective import MotionCost
from vkc_pin.planning.nlp.pose_goals import (
    find_approach_waypoint,
    find_phase_spans,
    find_pushed_coordinates,
)
from vkc_pin.planning.nlp.term_locations import TermEvaluator, locate_terms
from vkc_pin.planning.nlp.term_rows import TermRow
from vkc_pin.planning.nlp.timing import (
    Timing,
    compute_end_steps,
    compute_step_times,
    split_at_stops,
)
from vkc_pin.planning.nlp.transcription import transcribe
from vkc_pin.planning.nlp.waypoint import Structure
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task
from vkc_pin.world.task.terms import Term

# [m/s], [rad/s] with which a start velocity may open the closure of a grasped object, as where it
# is not exactly where the motion was planned. At 1 m/s², such a hand is brought back within 0.5 mm.
_MAX_CLOSURE_SPEED = 0.03


class TrajectoryProblem(KinematicProblem):
    """A task in a scene, ready to be solved: the chain's motion, its cost and its constraints.

    It is immutable. The duration of steps belongs to a motion, see `timing_for`.

    Attributes:
        transcription: Symbolic program, shared between problems of one structure. Each of
            `pose_goals` belongs to one of `transcription.structure.poses`.
        motion_cost: Cost of the motion.
        end_velocities: Velocities at the start and the end of the motion, shape (2, n).
        terms: User-defined constraints and costs that can change something in this task, one for
            each of `transcription.structure.terms`.
        term_evaluator: Evaluates the terms along a motion.
    """

    def __init__(
        self,
        scene: Scene,
        task: Task,
        options: Options,
        terms: Sequence[Term] = (),
        *,
        cache: Cache | None = None,
    ) -> None:
        super().__init__(scene, task, options, cache=cache)
        rows, self.terms = locate_terms(scene, self.chain, task, terms)
        self.transcription = transcribe(self._make_structure(rows), self.cache)
        self.motion_cost = self._make_motion_cost()
        self.end_velocities = self._make_end_velocities()
        self.end_velocities.setflags(write=False)
        self.term_evaluator = TermEvaluator(
            self.terms, self.transcription, self.start, self.chain.tree.mounts
        )
        self.term_evaluator.check(self.still, np.full(self.segments, options.dt))

    def _make_structure(self, terms: tuple[TermRow, ...]) -> Structure:
        """Return the structure of the program: pose goals, stops, clamped coordinates, etc."""
        spans = find_phase_spans(self.task)
        # Clamped freedoms are constant from the start of the straight approach, because the hand
        # already has to be where it will close.
        first_waypoints = {last: first for _, first, last in spans}
        clamped = []
        for column, grasp, last in self.choices:
            approach = find_approach_waypoint(first_waypoints[grasp], grasp, self.options)
            clamped.append((column, approach, last))
        # The robot is at rest while its gripper closes or opens.
        stops = []
        for (phase, _, end), (next_phase, _, _) in itertools.pairwise(spans):
            if phase.grasps or next_phase.released:
                stops.append(end)
        return Structure(
            tree=self.chain.tree,
            segments=self.segments,
            poses=tuple(goal.row for goal in self.pose_goals),
            slots=self.options.contact_slots,
            stops=tuple(stops),
            rolling=self.rolling,
            clamped=tuple(clamped),
            pushed=find_pushed_coordinates(self.chain, self.task),
            terms=terms,
        )

    def _make_motion_cost(self) -> MotionCost:
        """Return the cost of steps and of their changes."""
        o = self.options
        return MotionCost(
            self.metric,
            o.acceleration_weight / o.dt**2,
            self.ends,
            self.transcription.structure.stops,
            length=o.objective == "path_length",
        )

    def _make_end_velocities(self) -> Floats:
        """Return the velocities at the start, as the scene states it, and at the end, as the task.

        A grasped object that is fixed in the world moves with the hand: with the Jacobians J_r and
        J_o of the closures' residuals, J_o·v_o = −J_r·v_r.
        """
        velocities = np.zeros((2, self.chain.size))
        for name, value in self.task.phases[-1].velocities.items():
            velocities[1, self.chain.index(name)] = value
        robot_velocity = self.scene.start_velocity
        if not robot_velocity.any():
            return velocities
        first_phase = self.task.phases[0]
        stands_still = first_phase.kind == "stand" and not self.is_closed(first_phase)
        if first_phase.released or stands_still:
            raise InputError(
                "the robot cannot move where its hand opens",
                field="start.velocity",
                expected="a start at rest, or a task that does not begin with a release",
            )
        size = len(robot_velocity)
        velocities[0, :size] = robot_velocity
        jacobians = [np.zeros((0, self.chain.size))]
        held = {hold.object for hold in self.continued_holds}
        for goal, solver in zip(self.pose_goals, self.pose_solvers, strict=True):
            if goal.kind == "closure" and goal.object in held:
                _, jacobian = solver.evaluate(self.start[None], goal.target)
                jacobians.append(jacobian[0])
        jacobian = np.concatenate(jacobians)
        hand_velocity = jacobian[:, :size] @ robot_velocity
        others, *_ = np.linalg.lstsq(jacobian[:, size:], -hand_velocity, rcond=1e-9)
        remainder = hand_velocity + jacobian[:, size:] @ others
        if np.abs(remainder).max(initial=0.0) > _MAX_CLOSURE_SPEED:
            raise InputError(
                "the grasped object cannot follow the hand",
                field="start.velocity",
                expected="a velocity along the joints of the grasped object",
                got=f"{np.abs(remainder).max():.3g} m/s or rad/s off them",
            )
        velocities[0, size:] = others
        return velocities

    def timing_for(self, z: Floats) -> Timing:
        """Return the step durations for the initial guess z_1..z_N, shape (N, n).

        See `compute_step_times`. User-defined terms may require longer steps.
        """
        structure = self.transcription.structure
        path = self.waypoints(z)
        limits = (self.chain.velocity, self.chain.acceleration)
        runs = split_at_stops(structure.stops, self.segments)
        least = self.rolling.compute_min_times(path)
        dt = compute_step_times(
            path, self.options.dt, runs, limits, least, end_velocities=self.end_velocities
        )
        if structure.is_timed:
            dt = self.term_evaluator.lengthen_steps(z, dt, runs)
        return Timing(dt, dt, runs, limits, self.end_velocities)

    def rates(self, z: Floats, dt: Floats) -> tuple[Floats, Floats]:
        """Return the steps δz, shape (N, n), and their changes δδz, shape (N + 1 + stops, n).

        The first change is from the start velocity times the first of the step durations dt, shape
        (N,) [s], the last one to the velocity at the end; see `Differences`.
        """
        d = self.transcription.differences
        end_steps = compute_end_steps(self.end_velocities, dt)
        steps = d.first @ z + np.outer(d.start_first, self.start)
        changes = d.second @ z + np.outer(d.start_second, self.start) + d.end_second @ end_steps
        return steps, changes

    def pace(self, z: Floats, dt: Floats) -> tuple[Floats, Floats, Floats]:
        """Return `rates` and the minimum step durations for the wheels, shape (N,) [s]."""
        return *self.rates(z, dt), self.rolling.compute_min_times(self.waypoints(z))

    def objective(self, z: Floats, dt: Floats) -> float:
        """Return the cost of z_1..z_N, shape (N, n), with step durations dt, shape (N,) [s]."""
        return self.motion_cost.value(*self.rates(z, dt)) + self.term_evaluator.compute_cost(z, dt)

    def compute_cost(self, z: Floats) -> float:
        """Return the cost of an initial guess z_1..z_N, shape (N, n), at its own timing."""
        return self.objective(z, self.timing_for(z).dt)

    def row_error(self, z: Floats, dt: Floats) -> float:
        """Return the larger of `pose_error` and the violation of user-defined constraints."""
        return max(self.pose_error(z), self.term_evaluator.compute_violation(z, dt))

    def excess(self, z: Floats, timing: Timing, *, rates: bool = False) -> Floats:
        """Return the signed bound violations of the rolling, clamping and user-defined rows.

        Wheel speed limits count only with `rates`.
        """
        t = self.transcription
        if t.rows == t.first_relaxed_row:
            return np.zeros(0)
        gears = self.rolling.compute_gears(self.waypoints(z))
        values = t.relaxed_row_values(
            t.pack(z), self.start, timing.dt, gears, self.chain.tree.mounts.T
        )
        values = np.asarray(values).ravel()
        lower, upper = self.row_bounds(timing if rates else None)
        relaxed = slice(t.first_relaxed_row, t.rows)
        return np.asarray(values - np.clip(values, lower[relaxed], upper[relaxed]))

    @cached_property
    def row_kinds(self) -> Mapping[str, Floats]:
        """For each kind of these rows, the factor of their excess; 0 for rows of other kinds."""
        t = self.transcription
        rolling = np.zeros(t.rows)
        rolling[t.base_rows] = 1.0
        terms = np.zeros(t.rows)
        terms[self.term_evaluator.rows] = self.term_evaluator.scale
        clamped = np.where((rolling == 0.0) & (terms == 0.0), 1.0, 0.0)
        kinds = {"rolling": rolling, "clamped": clamped, "terms": terms}
        return {kind: factors[t.first_relaxed_row :] for kind, factors in kinds.items()}

    def row_bounds(self, timing: Timing | None) -> tuple[Floats, Floats]:
        """Return the bounds of the rows, followed by those of the rates if a timing is given."""
        t = self.transcription
        terms = self.term_evaluator
        lower = np.zeros(t.rows)
        upper = np.zeros(t.rows)
        upper[t.slot_rows] = np.inf
        upper[t.pushed_rows] = np.inf
        for pose, rows_by_waypoint in zip(t.structure.poses, t.pose_rows, strict=True):
            for rows in rows_by_waypoint.values():
                lower[rows], upper[rows] = ROW_BOUNDS[pose.kind]
        lower[terms.rows] = terms.lower
        upper[terms.rows] = terms.upper
        if not self.rolling.is_omnidirectional:
            dt = None if timing is None else timing.dt
            lower[t.base_rows], upper[t.base_rows] = t.steps.bounds(dt)
        if timing is not None:
            rates = np.concatenate([timing.velocity.ravel(), timing.acceleration.ravel()])
            lower = np.concatenate([lower, -rates])
            upper = np.concatenate([upper, rates])
        return lower, upper

    def parameters_at(self, z: Floats, dt: Floats) -> dict[str, Floats]:
        """Return the parameters of the program that only depend on the iterate and its timing.

        Args:
            z: z_1..z_N, shape (N, n).
            dt: Step durations, shape (N,) [s].
        """
        step_weights, change_weights = self.motion_cost.weights(*self.rates(z, dt))
        return {
            "start": self.start,
            "end_steps": compute_end_steps(self.end_velocities, dt),
            "dt": dt,
            "targets": flatten_placements([goal.target for goal in self.pose_goals]),
            "frames": flatten_placements([goal.local for goal in self.pose_goals]),
            "mounts": self.chain.tree.mounts,
            "step_weights": step_weights,
            "change_weights": change_weights,
            "gears": self.rolling.compute_gears(self.waypoints(z)),
        }

    def __repr__(self) -> str:
        t = self.transcription
        phases = " → ".join(phase.name for phase in self.task.phases)
        duration = self.timing_for(self.still).dt.sum()
        pairs = sum(len(part.pairs) for part in self.contacts.phases)
        return (
            f"<TrajectoryProblem {phases}: "
            f"{self.segments} steps in {duration:g} s, {t.size} variables, {t.rows} rows, "
            f"{pairs} collision pairs>"
        )
