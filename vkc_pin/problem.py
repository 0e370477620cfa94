"""TrajectoryProblem: one task in one scene as a nonlinear program (eqs. 1 to 7), over one or many phases."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vkc_pin.chain import VirtualKinematicChain, consolidate
from vkc_pin.contact import ContactModel, Contacts
from vkc_pin.goal import compile_task
from vkc_pin.options import Options
from vkc_pin.pose import PoseRow, target_vector
from vkc_pin.pose_goals import pose_goals
from vkc_pin.scene import Scene
from vkc_pin.steps import Step
from vkc_pin.task import Phase, Task
from vkc_pin.term_goals import TermNumbers, stretches, term_goals
from vkc_pin.term_rows import TermRow
from vkc_pin.terms import Term, check_active, traced
from vkc_pin.transcription import transcribe
from vkc_pin.waypoint import Structure

__all__ = ["TrajectoryProblem", "build"]

_CHOICE_WEIGHT = 1e-3  # of coordinates that are chosen when grasping and do not move: only keeps the problem regular
_PATIENCE = 1.5  # how much more time a motion may take before limits on its rates become rows of the program
_SPARE = 1.15  # how much longer a motion may take than the profile 3s² − 2s³ along its seed


class TrajectoryProblem:
    """A task in a scene, ready to be solved.

    Attributes:
        scene, task, options: What it was made of.
        chain: The virtual kinematic chain, n coordinates.
        contacts: What can collide with what.
        transcription: The symbolic program, shared between problems of one structure.
        start: z_0, shape (n,).
        lower, upper: Bounds of z_1..z_N, shape (N, n): joint limits (eq. 4), what stands still, joint goals.
        targets: Placements of the pose rows (eqs. 2 and 3), one per `transcription.structure.poses`.
        pose_names: Their names.
        terms: The user's own constraints and costs that count here, one per `transcription.structure.terms`.
        own: Their numbers.
        dt: Time of every step [s], shape (N,): `Options.dt`, or longer where the way is too long for it.
        velocity, acceleration: Bounds of `rates` (eq. 5), shapes (N, n) and (N + 1 + rests, n): limits times dt and dt².
    """

    def __init__(self, scene: Scene, task: Task, options: Options, terms: Sequence[Term] = ()) -> None:
        self.scene, self.task, self.options = scene, task, options
        self.chain: VirtualKinematicChain = consolidate(scene, task.holds)
        self.contacts = ContactModel(scene, self.chain, task, options)
        self.ends = np.cumsum([phase.segments for phase in task.phases])
        poses, self.targets, self.pose_names = pose_goals(scene, self.chain, task, options)
        rows, self.terms = term_goals(scene, self.chain, task, terms)
        self.transcription = transcribe(self._structure(poses, rows))
        self.start = self._start()
        self.lower, self.upper = self._bounds()
        self.own = TermNumbers(self.terms, self.transcription, self.start)
        still = np.tile(self.start, (self.segments, 1))
        self.own.check(still, np.full(self.segments, options.dt))
        self.take_time_for(still)

    @property
    def segments(self) -> int:
        """N, the number of waypoints after the start."""
        return int(self.ends[-1])

    def _structure(self, poses: Sequence[PoseRow], terms: tuple[TermRow, ...]) -> Structure:
        o, robot = self.options, self.chain.robot.coordinates.size
        weights = np.full(self.chain.size, o.velocity_weight_object)
        weights[:robot], weights[:2] = o.velocity_weight_arm, o.velocity_weight_base
        weights[2] = o.velocity_weight_heading
        # From the straight way to the grasp on: there the hand must already be where it will close.
        starts = np.concatenate([[0], self.ends[:-1]])
        begin = {int(end): int(start) for start, end in zip(starts, self.ends, strict=True)}
        clamped = tuple(
            (column, max(grasp - o.approach_waypoints, begin[grasp] + 1), last) for column, grasp, last in self.choices
        )
        weights[[column for column, _, _ in clamped]] = _CHOICE_WEIGHT
        acceleration = weights * o.acceleration_weight / o.dt**2
        velocity = np.tile(weights, (self.segments, 1))
        for phase, first, last in zip(self.task.phases, starts, self.ends, strict=True):
            if self.closed(phase):
                velocity[first:last, :2] *= o.velocity_weight_holding
        # The robot stands still while its gripper closes or opens.
        phases = zip(self.ends[:-1], self.task.phases[:-1], self.task.phases[1:], strict=True)
        rests = [int(end) for end, phase, after in phases if phase.grasps or after.leaves]
        differential = self.chain.robot.base == "differential"
        return Structure(
            self.chain.model,
            self.segments,
            tuple(poses),
            o.contact_slots,
            velocity,
            acceleration,
            tuple(rests),
            differential,
            clamped,
            terms,
        )

    @cached_property
    def choices(self) -> tuple[tuple[int, int, int], ...]:
        """Column, waypoint of the grasp and last waypoint of the hold, for what is chosen when a hand clamps."""
        found = []
        for hold, names in self.chain.virtual.items():
            attachment = self.scene.objects[hold.object].object.attachments[hold.attachment]
            for number, phase in enumerate(self.task.phases):
                if not attachment.firm or hold not in phase.grasps:
                    continue
                last = number
                while last + 1 < len(self.task.phases) and hold in self.task.phases[last + 1].held:
                    last += 1
                found += [(self.chain.index(name), int(self.ends[number]), int(self.ends[last])) for name in names]
        return tuple(found)

    def _start(self) -> NDArray[np.float64]:
        start = np.zeros(self.chain.size)
        start[: len(self.scene.start)] = self.scene.start
        for name, value in self.task.state.items():
            start[self.chain.index(name)] = value
        for hold in self.scene.holds:
            names = self.scene.objects[hold.object].object.attachment(hold.attachment).coordinates
            for name, value in zip(names, self.scene.held_at.get(hold.object, ()), strict=False):
                start[self.chain.index(f"{hold.object}.{name}")] = value
        return start

    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lower, upper = np.tile(self.chain.lower, (self.segments, 1)), np.tile(self.chain.upper, (self.segments, 1))
        for column, name in enumerate(self.chain.names[:3]):
            lower[:, column], upper[:, column] = self.limits(name)
        begin = 0
        for phase, end in zip(self.task.phases, self.ends, strict=True):
            inside = slice(begin, end)  # row t belongs to waypoint t + 1
            for name, value in phase.before.items():
                column = self.chain.index(name)
                low, high = phase.ranges.get(name, (value, value))
                lower[inside, column], upper[inside, column] = low, high
            for name, value in phase.values.items():
                column = self.chain.index(name)
                nearest = np.clip(value, self.chain.lower[column], self.chain.upper[column])
                lower[end - 1, column] = upper[end - 1, column] = nearest
            if phase.base is not None:
                for column, goal in enumerate(phase.base):
                    if goal is not None:
                        turn = (goal - self.start[2] + np.pi) % (2 * np.pi) - np.pi  # to the nearest of the equal headings
                        lower[end - 1, column] = upper[end - 1, column] = self.start[2] + turn if column == 2 else goal
            begin = end
        for hold in self.scene.holds:  # until it is let go of, what is clamped stays where it is
            if self.scene.objects[hold.object].object.attachments[hold.attachment].firm:
                held = [hold in phase.held for phase in self.task.phases]
                until = int(self.ends[(held.index(False) if False in held else len(held)) - 1]) if held[0] else 0
                for column in map(self.chain.index, self.chain.virtual[hold]):
                    lower[:until, column] = upper[:until, column] = self.start[column]
        return lower, upper

    def _set_steps(self, dt: NDArray[np.float64]) -> None:
        """Take over the time of every step, one value within each run between two rests."""
        of_rows = np.concatenate([np.full(last - first + 1, dt[first]) for first, last in self._runs()])
        self.dt = dt
        self.velocity = self.chain.velocity * dt[:, None]
        self.acceleration = self.chain.acceleration * of_rows[:, None] ** 2

    def take_time_for(self, z: NDArray[np.float64]) -> None:
        """Give every step `Options.dt`, or more where z_1..z_N, shape (N, n), is too long a way for it.

        The measure is the profile 3s² − 2s³ over the way that each coordinate goes between two rests: its speed is at most 1.5
        times the mean, its acceleration 6 times the way over the square of the duration. Terms may ask for more time.
        """
        steps, dt = np.abs(np.diff(self.waypoints(z), axis=0)), np.full(self.segments, self.options.dt)
        for first, last in self._runs():
            way = steps[first:last].sum(axis=0)
            needed = max(np.max(1.5 * way / self.chain.velocity), np.sqrt(np.max(6.0 * way / self.chain.acceleration)))
            dt[first:last] = np.maximum(dt[first:last], _SPARE * needed / (last - first))
        if self.transcription.structure.timed:
            dt = self.own.slower(z, dt, self._runs())
        self._set_steps(dt)
        self._least = dt

    def stretch(self, z: NDArray[np.float64]) -> None:
        """Give runs between rests up to `_PATIENCE` times more time where z_1..z_N, shape (N, n), exceeds a rate."""
        first, second = self.rates(z)
        fast, strong = np.max(np.abs(first) / self.velocity, axis=1), np.max(np.abs(second) / self.acceleration, axis=1)
        dt = self.dt.copy()
        for number, (begin, end) in enumerate(self._runs()):
            excess = max(float(fast[begin:end].max()), float(np.sqrt(strong[begin + number : end + number + 1].max())))
            dt[begin:end] = np.clip(dt[begin:end] * excess * 1.001, dt[begin:end], _PATIENCE * self._least[begin:end])
        self._set_steps(dt)

    def _runs(self) -> list[tuple[int, int]]:
        """Return the stretches between two rests, as first and last waypoint."""
        return list(itertools.pairwise([0, *self.transcription.structure.rests, self.segments]))

    def closed(self, phase: Phase) -> bool:
        """Return whether something that stands fixed in the world is held in a phase: then the chain is closed."""
        return any(not self.scene.objects[hold.object].object.free for hold in phase.held)

    def limits(self, name: str) -> tuple[float, float]:
        """Return the position limits of a coordinate; the base's end at the arena's edge, a fixed one's where it stands."""
        column = self.chain.index(name)
        if column < 3 and self.chain.robot.base == "fixed":
            return float(self.start[column]), float(self.start[column])
        lower, upper = float(self.chain.lower[column]), float(self.chain.upper[column])
        if column < 2:
            lower, upper = max(lower, self.scene.arena[2 * column]), min(upper, self.scene.arena[2 * column + 1])
        return lower, upper

    def unit(self, name: str) -> str:
        """Return "m" or "rad", the unit of a coordinate."""
        return self.chain.coordinates.units[self.chain.index(name)]

    def waypoints(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `z`, shape (N, n), with the start before it, shape (N + 1, n)."""
        return np.vstack([self.start, z])

    def clip(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `z` with every coordinate within its bounds."""
        return np.clip(z, self.lower, self.upper)

    def evaluate_contacts(self, z: NDArray[np.float64], *, reach: float, nearest: int | None = None) -> Contacts:
        """Return the pairs closer than `reach` [m] at z_1..z_N, shape (N, n); at most `nearest` a waypoint."""
        self.contacts.settle(z)
        return self.contacts.evaluate(z, np.arange(1, self.segments + 1), reach=reach, nearest=nearest)

    def rates(self, z: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the steps δz, shape (N, n), and their differences δδz, shape (N + 1 + rests, n); see `Transcription`."""
        t = self.transcription
        first = t.first @ z + np.outer(t.start_first, self.start)
        return first, t.second @ z + np.outer(t.start_second, self.start)

    def objective(self, z: NDArray[np.float64]) -> float:
        """Return f of eq. 1, and the user's own costs, at z_1..z_N, shape (N, n)."""
        structure = self.transcription.structure
        first, second = self.rates(z)
        efforts = np.sum(first**2 * structure.weights_velocity) + np.sum(second**2 @ structure.weights_acceleration)
        return float(efforts) + self.own.cost(z, self.dt)

    def pose_error(self, z: NDArray[np.float64]) -> float:
        """Return the largest residual of closure, goals and rolling, [m] or [rad], at z_1..z_N, shape (N, n)."""
        errors = [0.0]
        for pose, solver, target in zip(
            self.transcription.structure.poses, self.transcription.pose_solvers, self.targets, strict=True
        ):
            if pose.waypoints:
                residual, _ = solver.evaluate(z[np.array(pose.waypoints) - 1], target)
                errors.append(float(np.abs(residual).max()))
        return max(*errors, self.slip(z))

    def row_error(self, z: NDArray[np.float64]) -> float:
        """Return `pose_error`, or how much the user's own constraints are violated if that is more; see `TermNumbers.error`."""
        return max(self.pose_error(z), self.own.error(z, self.dt))

    def slip(self, z: NDArray[np.float64]) -> float:
        """Return how far a differential base slips sideways in the worst step of z_1..z_N, shape (N, n) [m]; 0 for others."""
        if not self.transcription.structure.differential:
            return 0.0
        path = self.waypoints(z)[:, :3]
        step = np.diff(path, axis=0)
        heading = path[:-1, 2] + step[:, 2] / 2
        return float(np.abs(np.cos(heading) * step[:, 1] - np.sin(heading) * step[:, 0]).max())

    def drift(self, z: NDArray[np.float64]) -> float:
        """Return how far grasps drift half-way between waypoints at most, relative to what `Options` allow."""
        path, worst = self.waypoints(z), 0.0
        between = (path[1:] + path[:-1]) / 2
        allowed = np.array([self.options.closure_position, self.options.closure_angle])
        for pose, solver, target in zip(
            self.transcription.structure.poses, self.transcription.pose_solvers, self.targets, strict=True
        ):
            held = np.array([t - 1 for t in pose.waypoints if t - 1 in pose.waypoints], int)
            if len(held):
                residual, _ = solver.evaluate(between[held], target)
                amounts = np.linalg.norm(residual.reshape(len(held), 2, 3), axis=2)
                worst = max(worst, float((amounts / allowed).max()))
        return worst

    def rate_violation(self, z: NDArray[np.float64]) -> float:
        """Return the largest excess over a velocity or acceleration bound, relative to that bound."""
        first, second = self.rates(z)
        return float(max(np.max(np.abs(first) / self.velocity), np.max(np.abs(second) / self.acceleration)) - 1.0)

    def target_matrix(self) -> NDArray[np.float64]:
        """Return the pose targets as parameters, shape (poses, 12)."""
        return np.array([target_vector(t) for t in self.targets]).reshape(-1, 12)

    def __repr__(self) -> str:
        t = self.transcription
        return (
            f"<TrajectoryProblem {' → '.join(p.name for p in self.task.phases)}: {self.segments} steps in {self.dt.sum():g} s, "
            f"{t.size} variables, {t.rows} rows, {sum(len(p.pairs) for p in self.contacts.phases)} collision pairs>"
        )


def build(
    scene: Scene, steps: Sequence[Step], *, options: Options | None = None, terms: Sequence[Term] = ()
) -> TrajectoryProblem:
    """Return the nonlinear program of `steps` in `scene`, to look at before solving.

    Args:
        scene: Robot, objects and obstacles.
        steps: What should change in the world.
        options: How to plan.
        terms: Own constraints and costs.

    Raises:
        InputError: The steps or terms name something that is not there, or ask for what cannot be done.
    """
    options = options or Options()
    task, terms = compile_task(scene, steps, options), traced(scene, terms)
    check_active(terms, stretches(task))
    return TrajectoryProblem(scene, task, options, terms)
