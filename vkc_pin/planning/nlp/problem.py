"""TrajectoryProblem: one task in one scene as a nonlinear program (eqs. 1 to 7), over one or many phases."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain, consolidate
from vkc_pin.planning.chain.contacts import ContactModel, Contacts
from vkc_pin.planning.chain.pose import ROW_BOUNDS, target_vector
from vkc_pin.planning.nlp.objective import Effort
from vkc_pin.planning.nlp.pose_goals import approach_at, chosen_freedoms, pose_goals, pushed_steps
from vkc_pin.planning.nlp.term_locations import TermNumbers, term_goals
from vkc_pin.planning.nlp.term_rows import TermRow
from vkc_pin.planning.nlp.timing import Timing, runs_between, time_for
from vkc_pin.planning.nlp.transcription import transcribe
from vkc_pin.planning.nlp.waypoint import Structure
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Phase, Task
from vkc_pin.world.task.terms import Term
from vkc_pin.world.trajectory.wheels import rolling_of

__all__ = ["TrajectoryProblem"]

# ratio, of coordinates that are chosen when grasping and do not move: only keeps the problem
# regular
_CHOICE_WEIGHT = 1e-4


class TrajectoryProblem:
    """A task in a scene, ready to be solved. Nothing about it changes: how long steps take is a motion's own, see `timing_for`.

    Attributes:
        scene, task, options: What it was made of.
        chain: The virtual kinematic chain, n coordinates.
        rolling: How its base may move.
        contacts: What can collide with what.
        transcription: The symbolic program, shared between problems of one structure.
        effort: What the way costs.
        start: z_0, shape (n,).
        lower, upper: Bounds of z_1..z_N, shape (N, n): joint limits (eq. 4), what stands still,
            joint goals.
        pose_goals: Which frames must be where (eqs. 2 and 3), one per
            `transcription.structure.poses`.
        targets: Their placements.
        choices: What is chosen when a hand clamps: column, waypoint of the grasp and last waypoint
            of the hold.
        terms: The user's own constraints and costs that count here, one per
            `transcription.structure.terms`.
        term_numbers: Their values along a motion.
        cache: Where the symbolic program came from, and searches keep what they build.
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
        self.scene, self.task, self.options, self.cache = scene, task, options, cache or Cache()
        self.chain: VirtualKinematicChain = consolidate(
            scene, task.holds, rides=task.rides, cache=self.cache
        )
        self.rolling = rolling_of(self.chain.robot)
        self.contacts = ContactModel(scene, self.chain, task, options)
        self.ends = np.cumsum([phase.segments for phase in task.phases])
        self.pose_goals = pose_goals(scene, self.chain, task, options)
        self.choices = chosen_freedoms(scene, self.chain, task)
        self.targets = tuple(goal.target for goal in self.pose_goals)
        rows, self.terms = term_goals(scene, self.chain, task, terms)
        self.transcription = transcribe(self._structure(rows), self.cache)
        self.effort = self._effort()
        self.start = self._start()
        self.lower, self.upper = self._bounds()
        for array in (self.start, self.lower, self.upper):
            array.setflags(write=False)
        self.term_numbers = TermNumbers(self.terms, self.transcription, self.start)
        self.term_numbers.check(self.still, np.full(self.segments, options.dt))

    def with_bounds(self, lower: Floats, upper: Floats) -> TrajectoryProblem:
        """Return the same problem with other bounds of z_1..z_N, shape (N, n)."""
        other = copy.copy(self)
        other.lower, other.upper = lower.copy(), upper.copy()
        for array in (other.lower, other.upper):
            array.setflags(write=False)
        return other

    @property
    def segments(self) -> int:
        """N, the number of waypoints after the start."""
        return int(self.ends[-1])

    @property
    def still(self) -> Floats:
        """z_1..z_N where nothing moves, shape (N, n)."""
        return np.tile(self.start, (self.segments, 1))

    def _structure(self, terms: tuple[TermRow, ...]) -> Structure:
        """Return what the symbolic program depends on: the frames of eqs. 2 and 3, stops and firm holds."""
        o = self.options
        # From the straight approach to the grasp on: there the hand must already be where it will
        # close.
        starts = np.concatenate([[0], self.ends[:-1]])
        begin = {int(end): int(start) for start, end in zip(starts, self.ends, strict=True)}
        clamped = tuple(
            (column, approach_at(begin[grasp], grasp, o), last)
            for column, grasp, last in self.choices
        )
        # The robot stands still while its gripper closes or opens.
        phases = zip(self.ends[:-1], self.task.phases[:-1], self.task.phases[1:], strict=True)
        stops = tuple(int(end) for end, phase, after in phases if phase.grasps or after.leaves)
        return Structure(
            model=self.chain.model,
            segments=self.segments,
            poses=tuple(goal.row for goal in self.pose_goals),
            slots=o.contact_slots,
            stops=stops,
            rolling=self.rolling,
            clamped=clamped,
            pushed=pushed_steps(self.chain, self.task),
            terms=terms,
        )

    def _effort(self) -> Effort:
        """Return what the way costs: metres of all coordinates alike, turns by whose they are."""
        o, robot = self.options, self.chain.robot.coordinates.size
        metric = np.full(self.chain.size, o.velocity_weight_object)
        metric[2], metric[3:robot] = o.velocity_weight_heading, o.velocity_weight_arm
        of = self.chain.coordinates  # of joints that move together, all ways count
        metric = metric * of.turns**2 + o.velocity_weight_base * of.lengths**2
        metric[[column for column, _, _ in self.choices]] *= _CHOICE_WEIGHT
        stops = self.transcription.structure.stops
        return Effort(
            metric, o.acceleration_weight / o.dt**2, self.ends, stops, length=o.effort == "length"
        )

    def _start(self) -> Floats:
        start = np.zeros(self.chain.size)
        start[: len(self.scene.start)] = self.scene.start
        for name, value in self.task.state.items():
            start[self.chain.index(name)] = value
        for hold in self._held_at_start():
            names = self.scene.objects[hold.object].object.attachment(hold.attachment).coordinates
            for name, value in zip(names, hold.at, strict=True):
                start[self.chain.index(f"{hold.object}.{name}")] = value
        return start

    def _held_at_start(self) -> list[Hold]:
        """Return what the start holds, without what is let go of then and there to be held otherwise."""
        return [hold for hold in self.scene.holds if hold in self.task.holds]

    def _bounds(self) -> tuple[Floats, Floats]:
        """Return the joint limits (eq. 4) at every waypoint, narrowed to what the phases and firm holds ask for."""
        lower, upper = (
            np.tile(self.chain.lower, (self.segments, 1)),
            np.tile(self.chain.upper, (self.segments, 1)),
        )
        for column, name in enumerate(self.chain.names[:3]):
            lower[:, column], upper[:, column] = self.limits(name)
        begin = 0
        for phase, end in zip(self.task.phases, self.ends, strict=True):
            inside = slice(begin, end)  # row t belongs to waypoint t + 1
            if phase.kind == "stand" and not self.closed(
                phase
            ):  # what is let go of then stands where it is
                own = slice(0, self.chain.robot.coordinates.size)
                lower[inside, own] = upper[inside, own] = self.start[own]
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
                        turn = wrap_angle(
                            goal - self.start[2]
                        )  # to the nearest of the equal headings
                        lower[end - 1, column] = upper[end - 1, column] = (
                            self.start[2] + turn if column == 2 else goal
                        )
            begin = end
        for (
            hold
        ) in self._held_at_start():  # until it is let go of, what is clamped stays where it is
            if self.scene.objects[hold.object].object.attachments[hold.attachment].firm:
                held = [hold in phase.held for phase in self.task.phases]
                until = (
                    int(self.ends[(held.index(False) if False in held else len(held)) - 1])
                    if held[0]
                    else 0
                )
                for column in map(self.chain.index, self.chain.virtual[hold]):
                    lower[:until, column] = upper[:until, column] = self.start[column]
        return lower, upper

    def timing_for(self, z: Floats) -> Timing:
        """Return how long steps take where z_1..z_N, shape (N, n), is the seed; see `time_for`. Terms may ask for more time."""
        structure, limits = (
            self.transcription.structure,
            (self.chain.velocity, self.chain.acceleration),
        )
        runs = runs_between(structure.stops, self.segments)
        path = self.waypoints(z)
        dt = time_for(path, self.options.dt, runs, limits, self.rolling.times(path))
        if structure.timed:
            dt = self.term_numbers.slower(z, dt, runs)
        return Timing(dt, dt, runs, limits)

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
            lower, upper = (
                max(lower, self.scene.arena[2 * column]),
                min(upper, self.scene.arena[2 * column + 1]),
            )
        return lower, upper

    def unit(self, name: str) -> str:
        """Return "m" or "rad", the unit of a coordinate."""
        return self.chain.coordinates.units[self.chain.index(name)]

    def waypoints(self, z: Floats) -> Floats:
        """Return `z`, shape (N, n), with the start before it, shape (N + 1, n)."""
        return np.vstack([self.start, z])

    def clip(self, z: Floats) -> Floats:
        """Return `z` with every coordinate within its bounds."""
        return np.clip(z, self.lower, self.upper)

    def evaluate_contacts(self, z: Floats, *, reach: float, nearest: int | None = None) -> Contacts:
        """Return the pairs closer than `reach` [m] at z_1..z_N, shape (N, n); at most `nearest` a waypoint."""
        return self.contacts.settled(z).evaluate(
            z, np.arange(1, self.segments + 1), reach=reach, nearest=nearest
        )

    def rates(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the steps δz, shape (N, n), and their differences δδz, shape (N + 1 + stops, n); see `Transcription`."""
        t = self.transcription
        first = t.first @ z + np.outer(t.start_first, self.start)
        return first, t.second @ z + np.outer(t.start_second, self.start)

    def pace(self, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Return `rates`, and how long steps take the wheels of the base at least, shape (N,) [s]; see `Timing.violation`."""
        return *self.rates(z), self.rolling.times(self.waypoints(z))

    def objective(self, z: Floats, dt: Floats) -> float:
        """Return what the way and the user's own terms cost at z_1..z_N, shape (N, n), in steps that take dt, shape (N,) [s]."""
        return self.effort.value(*self.rates(z)) + self.term_numbers.cost(z, dt)

    def pose_error(self, z: Floats) -> float:
        """Return the largest residual of closure (eq. 2), goals (eq. 3) and rolling, [m] or [rad], at z_1..z_N, shape (N, n)."""
        errors = [0.0]
        for goal, solver in zip(self.pose_goals, self.transcription.pose_solvers, strict=True):
            if goal.row.waypoints:
                residual, _ = solver.evaluate(z[np.array(goal.row.waypoints) - 1], goal.target)
                errors.append(float(np.abs(residual).max()))
        return max(*errors, self.rolling.error(self.waypoints(z)))

    def row_error(self, z: Floats, dt: Floats) -> float:
        """Return `pose_error`, or how much the user's own constraints are violated if that is more; see `TermNumbers.error`."""
        return max(self.pose_error(z), self.term_numbers.error(z, dt))

    def excess(self, z: Floats, timing: Timing, *, rates: bool = False) -> Floats:
        """Return by how much rolling, clamping and own constraints are out of their bounds, with a sign; see `Transcription`."""
        t = self.transcription
        if t.rows == t.firm_rows:
            return np.zeros(0)
        values = np.asarray(
            t.other_values(t.pack(z), self.start, timing.dt, self.rolling.gears(self.waypoints(z)))
        ).ravel()
        lower, upper = (
            bound[t.firm_rows : t.rows] for bound in self.row_bounds(timing if rates else None)
        )
        return np.asarray(values - np.clip(values, lower, upper))

    @cached_property
    def row_kinds(self) -> Mapping[str, Floats]:
        """For every kind of these rows, what of their excess counts, 0 for rows of other kinds."""
        t = self.transcription
        rolling, terms = np.zeros(t.rows), np.zeros(t.rows)
        rolling[t.base_rows] = 1.0
        terms[self.term_numbers.rows] = self.term_numbers.scale
        clamped = np.where((rolling == 0.0) & (terms == 0.0), 1.0, 0.0)
        return {
            kind: own[t.firm_rows :]
            for kind, own in (("rolling", rolling), ("clamped", clamped), ("terms", terms))
        }

    def drift(self, z: Floats) -> float:
        """Return how far grasps drift half-way between waypoints at most, relative to what `Options` allow."""
        path, worst = self.waypoints(z), 0.0
        between = (path[1:] + path[:-1]) / 2
        allowed = np.array([self.options.closure_position, self.options.closure_angle])
        for goal, solver in zip(self.pose_goals, self.transcription.pose_solvers, strict=True):
            held = np.array([t - 1 for t in goal.row.waypoints if t - 1 in goal.row.waypoints], int)
            if len(held) and goal.kind == "closure":
                residual, _ = solver.evaluate(between[held], goal.target)
                amounts = np.linalg.norm(residual.reshape(len(held), 2, 3), axis=2)
                worst = max(worst, float((amounts / allowed).max()))
        return worst

    def row_bounds(self, timing: Timing | None) -> tuple[Floats, Floats]:
        """Return the bounds of the program's rows, and with a timing those of its rates; shapes (rows,) and (rows,)."""
        t, terms = self.transcription, self.term_numbers
        lower, upper = np.zeros(t.rows), np.zeros(t.rows)
        upper[t.slot_rows] = upper[t.pushed_rows] = np.inf
        for pose, at in zip(t.structure.poses, t.pose_rows, strict=True):
            for rows in at.values():
                lower[rows], upper[rows] = ROW_BOUNDS[pose.kind]
        lower[terms.rows], upper[terms.rows] = terms.lower, terms.upper
        if not self.rolling.aside:
            lower[t.base_rows], upper[t.base_rows] = t.steps.bounds(
                None if timing is None else timing.dt
            )
        if timing is not None:
            rates = np.concatenate([timing.velocity.ravel(), timing.acceleration.ravel()])
            lower, upper = np.concatenate([lower, -rates]), np.concatenate([upper, rates])
        return lower, upper

    def target_matrix(self) -> Floats:
        """Return the pose targets as parameters, shape (poses, 12)."""
        return np.array([target_vector(t) for t in self.targets]).reshape(-1, 12)

    def __repr__(self) -> str:
        t, time = self.transcription, self.timing_for(self.still).dt.sum()
        return (
            f"<TrajectoryProblem {' → '.join(p.name for p in self.task.phases)}: {self.segments} steps in {time:g} s, "
            f"{t.size} variables, {t.rows} rows, {sum(len(p.pairs) for p in self.contacts.phases)} collision pairs>"
        )
