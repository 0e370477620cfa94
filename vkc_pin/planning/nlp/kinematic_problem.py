"""Describes where the chain of one task in one scene may be, and where it has to be."""

from __future__ import annotations

import copy
from typing import Self

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.planning.chain.contacts import ContactModel, Contacts
from vkc_pin.planning.chain.inverse_kinematics import PoseSolver
from vkc_pin.planning.nlp.pose_goals import (
    find_chosen_freedoms,
    find_end_of_hold,
    find_phase_spans,
    make_pose_goals,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Phase, Task
from vkc_pin.world.trajectory.wheels import make_rolling_limits

# Relative cost of coordinates that are chosen at the grasp and constant afterwards; it only
# regularises the problem.
_CHOSEN_FREEDOM_WEIGHT = 1e-4
_TOLERANCES = Tolerances()


class KinematicProblem:
    """The chain of a task in a scene, its limits, contacts and pose goals.

    Searches for initial guesses need no more. It is immutable.

    Attributes:
        scene, task, options: Scene, task and options that it was built from.
        chain: Virtual kinematic chain with n coordinates.
        rolling: Motion constraints of its base.
        contacts: Collision model of the task.
        ends: Last waypoint of each phase.
        metric: Weights of squared displacements, shape (n,).
        start: z_0, shape (n,).
        lower, upper: Bounds of z_1..z_N, shape (N, n): joint limits (eq. 4), fixed coordinates,
            joint goals.
        pose_goals: Pose goals (eqs. 2 and 3).
        targets: Their target placements.
        pose_solvers: Inverse kinematics of each.
        choices: Freedoms chosen when a hand clamps: column, grasp waypoint and last waypoint held.
        cache: Cache of the symbolic program and of what searches build.
    """

    def __init__(
        self, scene: Scene, task: Task, options: Options, *, cache: Cache | None = None
    ) -> None:
        self.scene = scene
        self.task = task
        self.options = options
        self.cache = cache or Cache()
        self.chain: VirtualKinematicChain = consolidate(
            scene, task.holds, supported=task.supported, cache=self.cache
        )
        self.rolling = make_rolling_limits(self.chain.robot)
        self.contacts = ContactModel(scene, self.chain, task, options)
        self.ends = np.cumsum([phase.segments for phase in task.phases])
        self.pose_goals = make_pose_goals(scene, self.chain, task, options)
        self.choices = find_chosen_freedoms(scene, self.chain, task)
        self.targets = tuple(goal.target for goal in self.pose_goals)
        self.pose_solvers = tuple(
            PoseSolver(self.chain.tree, goal.row, goal.local, self.cache)
            for goal in self.pose_goals
        )
        self.metric = self._make_metric()
        self.start = self._make_start()
        self.lower, self.upper = self._make_bounds()
        self.start.setflags(write=False)
        self.lower.setflags(write=False)
        self.upper.setflags(write=False)

    def with_bounds(self, lower: Floats, upper: Floats) -> Self:
        """Return the same problem with other bounds of z_1..z_N, shape (N, n)."""
        other = copy.copy(self)
        other.lower = lower.copy()
        other.upper = upper.copy()
        other.lower.setflags(write=False)
        other.upper.setflags(write=False)
        return other

    @property
    def segments(self) -> int:
        """N, the number of waypoints after the start."""
        return int(self.ends[-1])

    @property
    def still(self) -> Floats:
        """z_1..z_N of the stationary motion, shape (N, n)."""
        return np.tile(self.start, (self.segments, 1))

    def _make_metric(self) -> Floats:
        """Return the weights: one for all lengths, those of turns by group of joints."""
        o = self.options
        turn_weights = np.full(self.chain.size, o.velocity_weight_object)
        turn_weights[2] = o.velocity_weight_heading
        turn_weights[3 : self.chain.robot.coordinates.size] = o.velocity_weight_arm
        # The displacements of coupled joints add up.
        turns = self.chain.coordinates.turns
        lengths = self.chain.coordinates.lengths
        metric = turn_weights * turns**2 + o.velocity_weight_base * lengths**2
        metric[[column for column, _, _ in self.choices]] *= _CHOSEN_FREEDOM_WEIGHT
        return np.asarray(metric)

    def _make_start(self) -> Floats:
        """Return z_0: the robot, joints of objects, and freedoms of grasps at the start."""
        start = np.zeros(self.chain.size)
        start[: len(self.scene.start)] = self.scene.start
        for name, value in self.task.state.items():
            start[self.chain.index(name)] = value
        for hold in self.continued_holds:
            attachment = self.scene.objects[hold.object].object.attachment(hold.attachment)
            for name, value in zip(attachment.coordinates, hold.at, strict=True):
                start[self.chain.index(f"{hold.object}.{name}")] = value
        return start

    @property
    def continued_holds(self) -> list[Hold]:
        """Holds at the start that the task does not release at once."""
        return [hold for hold in self.scene.holds if hold in self.task.holds]

    def _make_bounds(self) -> tuple[Floats, Floats]:
        """Return the joint limits (eq. 4) per waypoint, narrowed by phases and clamped grasps."""
        bounds = np.empty((self.segments, self.chain.size, 2))
        bounds[:] = np.column_stack([self.chain.lower, self.chain.upper])
        for column, name in enumerate(self.chain.names[:3]):
            bounds[:, column] = self.limits(name)
        robot = slice(self.chain.robot.coordinates.size)
        for phase, first, end in find_phase_spans(self.task):
            inside = slice(first, end)  # row t belongs to waypoint t + 1
            if phase.kind == "stand" and not self.is_closed(phase):
                bounds[inside, robot] = self.start[robot, None]  # a released object does not move
            for name, value in phase.initial_values.items():
                bounds[inside, self.chain.index(name)] = phase.ranges.get(name, (value, value))
            for name, interval in self.coordinate_goals(phase).items():
                bounds[end - 1, self.chain.index(name)] = np.clip(interval, *self.limits(name))
        # Clamped freedoms are constant until the object is released.
        for hold in self.continued_holds:
            if self.scene.objects[hold.object].object.attachments[hold.attachment].firm:
                until = find_end_of_hold(hold, find_phase_spans(self.task), 0)
                for name in self.chain.virtual[hold]:
                    column = self.chain.index(name)
                    bounds[:until, column] = self.start[column]
        lower, upper = bounds.transpose(2, 0, 1).copy()
        return lower, upper

    def is_closed(self, phase: Phase) -> bool:
        """Return whether the chain is closed, by a grasp of an object fixed in the world."""
        return any(not self.scene.objects[hold.object].object.free for hold in phase.held)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the position limits of a coordinate.

        The base is limited by the arena; a fixed base stays at the start.
        """
        column = self.chain.index(name)
        if column < 3 and self.chain.robot.base == "fixed":
            return float(self.start[column]), float(self.start[column])
        lower = float(self.chain.lower[column])
        upper = float(self.chain.upper[column])
        if column < 2:
            arena_lower, arena_upper = self.scene.arena[2 * column : 2 * column + 2]
            lower = max(lower, arena_lower)
            upper = min(upper, arena_upper)
        return lower, upper

    def coordinate_goals(self, phase: Phase) -> dict[str, tuple[float, float]]:
        """Return coordinate → (lower, upper) at the end of a phase, as requested, [m] and [rad].

        Of equivalent angles without limits, such as headings, it is the one nearest to the start.
        """
        goals = {name: (value, value) for name, value in phase.values.items()}
        for name, (lower, upper) in phase.configuration.items():
            column = self.chain.index(name)
            full_turns = 0.0  # [rad], a multiple of 2π
            if self.chain.robot.is_periodic(column):
                from_start = (lower + upper) / 2 - self.start[column]
                full_turns = wrap_angle(from_start) - from_start
            goals[name] = (lower + full_turns, upper + full_turns)
        return goals

    def unit(self, name: str) -> str:
        """Return the unit of a coordinate, "m" or "rad"."""
        return self.chain.coordinates.units[self.chain.index(name)]

    def waypoints(self, z: Floats) -> Floats:
        """Return z_0..z_N, shape (N + 1, n), given z_1..z_N, shape (N, n)."""
        return np.vstack([self.start, z])

    def clip(self, z: Floats) -> Floats:
        """Return `z` clipped to the bounds."""
        return np.clip(z, self.lower, self.upper)

    def evaluate_contacts(self, z: Floats, *, reach: float, nearest: int | None = None) -> Contacts:
        """Return the pairs closer than `reach` [m] at z_1..z_N, shape (N, n).

        Args:
            z: z_1..z_N.
            reach: Pairs further apart are omitted [m].
            nearest: Maximum number of pairs per waypoint. Defaults to all.
        """
        contacts = self.contacts.with_released_objects(z)
        waypoints = np.arange(1, self.segments + 1)
        return contacts.evaluate(z, waypoints, reach=reach, nearest=nearest)

    def pose_error(self, z: Floats) -> float:
        """Return the largest residual of closure (eq. 2), goals (eq. 3) and rolling [m], [rad]."""
        errors = [0.0]
        for goal, solver in zip(self.pose_goals, self.pose_solvers, strict=True):
            if goal.row.waypoints:
                residual, _ = solver.evaluate(z[np.array(goal.row.waypoints) - 1], goal.target)
                errors.append(float(np.abs(residual).max()))
        return max(*errors, self.rolling.compute_error(self.waypoints(z)))

    def drift(self, z: Floats) -> float:
        """Return the largest closure error between waypoints, relative to the tolerances.

        It is evaluated half-way between consecutive waypoints.
        """
        path = self.waypoints(z)
        midpoints = (path[1:] + path[:-1]) / 2
        allowed = np.array([_TOLERANCES.closure_position, _TOLERANCES.closure_angle])
        worst = 0.0
        for goal, solver in zip(self.pose_goals, self.pose_solvers, strict=True):
            at = goal.row.waypoints
            closed_segments = [t - 1 for t in at if t - 1 in at]  # closed at both ends
            if closed_segments and goal.kind == "closure":
                residual, _ = solver.evaluate(midpoints[closed_segments], goal.target)
                errors = residual.reshape(len(closed_segments), 2, 3)  # position and rotation
                amounts = np.linalg.norm(errors, axis=2)
                worst = max(worst, float((amounts / allowed).max()))
        return worst
