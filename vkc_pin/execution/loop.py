"""Runs a plan on a robot: monitors it, plans the rest again when something differs, or brakes."""

from __future__ import annotations

import dataclasses
import operator
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, format_value
from vkc_pin.execution.joint_observer import JointFinding, JointObserver, ObserveLink
from vkc_pin.execution.monitor import Monitor
from vkc_pin.execution.record import Cycle, Decision, ExecutionResult
from vkc_pin.execution.robots import Robot, RobotState, send_soon
from vkc_pin.execution.uncertain_joints import allow_near_neighbours
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import prepare
from vkc_pin.planning.replan import find_remaining_steps, measure_grasps, replan
from vkc_pin.planning.stopping import brake
from vkc_pin.utils.arguments import check_finite_array, check_instance, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL, MODEL_ERROR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import find_phase_at

Observe = Callable[[Scene], Scene]
"""Updates a scene with the present placements of objects and obstacles, as far as known."""

_STALE = 0.5  # [s], age of a measured state with which no robot is moved on
_REHEARSAL = 10.0  # [s], limit of a plan that is made before the robot moves
_FIRST_SEARCH = 0.5  # [s] of the first search from rest


def execute(  # noqa: PLR0913 - keyword options of a public call
    plan: Plan,
    robot: Robot,
    *,
    rate: float = 20.0,
    observe: Observe | None = None,
    observe_link: ObserveLink | None = None,
    link_noise: tuple[float, float] = (0.001, 0.005),
    force_limit: float | None = None,
    torque_limit: float | None = None,
    lead: float = 0.2,
    time_limit: float | None = None,
    patience: float = 10.0,
    tracking: float = 0.02,
    planner: Planner | None = None,
) -> ExecutionResult:
    """Execute a plan on a robot, and react to what differs from it.

    In every cycle, the state of the robot is compared with the plan, and the rest of the motion
    with the present world. If an object is elsewhere, an obstacle too near, or the robot off its
    motion, the rest is planned again, to begin `lead` seconds later, while the robot goes on. If no
    new motion is found in time, the robot brakes on its path, and plans from rest.

    While the hand moves a joint of a fixed object, the joint is estimated from poses of the grasped
    link. If the estimate is decisively better than the joint of the plan, the rest is planned again
    with it, and the grasp stays as it is. A force or torque beyond its limit ends the pull: the
    robot stops at once, and goes on if the joint is found to be elsewhere.

    Args:
        plan: A successful plan, in whose start the robot stands.
        robot: The robot.
        rate: Cycles per second [Hz].
        observe: Updates a scene with the present placements of objects and obstacles. Default:
            nothing changes.
        observe_link: Returns the measured pose of a grasped link in the world now, see
            `as_placement`, or None where it is not seen: (object, link) → pose. Default: joints
            are as described.
        link_noise: Standard deviations of these poses, per axis: position [m] and rotation [rad].
        force_limit: Force between hand and grasped object at which a pull ends [N]. Default: none.
        torque_limit: Torque at which it ends [N·m]. Default: none.
        lead: Time from a decision to the begin of the new motion, within which it must be found
            [s].
        time_limit: Wall-clock limit of planning again [s]. Default: `lead`. More makes sense for a
            simulated robot whose clock stands still meanwhile.
        patience: Longest time at rest without a motion before execution fails [s].
        tracking: Largest accepted distance from the planned configuration, [m] and [rad].
        planner: Planner whose caches are used.

    Raises:
        InputError: The plan is no success or ends in motion, the robot is not at its start or does
            not measure a limited load, or an argument is invalid.
    """
    check_instance(plan, Plan, "plan").check_success()
    if plan.ends_in_motion:
        problem, expected = "it ends in motion, and nothing follows", "a plan that ends at rest"
        raise InputError(problem, field="plan", expected=expected)
    if not isinstance(robot, Robot):
        expected = "an object with the methods of `Robot`"
        raise InputError("no robot", field="robot", expected=expected, got=format_value(robot))
    if observe is not None and not callable(observe):
        expected, got = "a function of a Scene", format_value(observe)
        raise InputError("cannot be called", field="observe", expected=expected, got=got)
    observer = _make_observer(observe_link, link_noise)
    state = robot.read()
    force_limit = _check_load_limit(force_limit, state.grasp_force, "force")
    torque_limit = _check_load_limit(torque_limit, state.grasp_torque, "torque")
    period = 1.0 / check_number(rate, "rate", "cycles per second", low=0.1, high=1000.0)
    lead = check_number(lead, "lead", "a time [s]", low=period)
    if time_limit is None:
        time_limit = lead
    settings = _Settings(
        period=period,
        observe=observe,
        observer=observer,
        force_limit=force_limit,
        torque_limit=torque_limit,
        lead=lead,
        time_limit=check_number(time_limit, "time_limit", "a time [s]", low=0.0, strict=True),
        patience=check_number(patience, "patience", "a time [s]", low=0.0),
        tracking=tracking,
        planner=planner,
    )
    return _Loop(plan, robot, settings).run()


def _make_observer(
    observe_link: ObserveLink | None, link_noise: tuple[float, float]
) -> JointObserver | None:
    """Return the observer of joints, if there is one. Raises `InputError`."""
    if observe_link is None:
        return None
    if not callable(observe_link):
        expected, got = "a function of object and link", format_value(observe_link)
        raise InputError("cannot be called", field="observe_link", expected=expected, got=got)
    deviations = check_finite_array(link_noise, "link_noise")
    if deviations.shape != (2,) or (deviations <= 0.0).any():
        raise InputError(
            "invalid noise",
            field="link_noise",
            expected="deviations of position [m] and rotation [rad], more than 0",
            got=format_value(link_noise),
        )
    return JointObserver(observe_link, *deviations.tolist())


def _check_load_limit(limit: float | None, measured: float | None, quantity: str) -> float:
    """Return a limit of a grasp's load; inf: none. Raises `InputError`."""
    if limit is None:
        return np.inf
    field = f"{quantity}_limit"
    checked = check_number(limit, field, low=0.0, strict=True)
    if measured is None:
        raise InputError(
            f"the robot does not measure the {quantity} of its grasp",
            field=field,
            expected=f"None, or states with `grasp_{quantity}`",
            got=limit,
        )
    return checked


@dataclass(frozen=True)
class _Settings:
    """Arguments of `execute`.

    Attributes:
        period: Duration of a cycle [s].
        force_limit, torque_limit: Limits of a pull [N], [N·m]; inf: none.
    """

    period: float
    observe: Observe | None
    observer: JointObserver | None
    force_limit: float
    torque_limit: float
    lead: float
    time_limit: float
    patience: float
    tracking: float
    planner: Planner | None


@dataclass
class _Rest:
    """State of a robot that brakes or stands until a motion is found.

    Attributes:
        steps: Remaining steps.
        guess: Motion from which the search for the next one starts.
        since: When the robot has come to rest [s].
        attempts: Number of searches so far.
        timeouts: Number of these that the time limit has ended.
        margins: Links that may be nearer than usual → distance that they keep [m]; negative: how
            deep they may overlap.
    """

    steps: tuple[Step, ...]
    guess: Trajectory
    since: float = np.inf
    attempts: int = 0
    timeouts: int = 0
    margins: dict[tuple[str, str], float] = field(default_factory=dict)

    def begin_again(self, since: float) -> None:
        """Count the searches from now on, since the robot brakes until then [s]."""
        self.since = since
        self.attempts = 0
        self.timeouts = 0


@dataclass
class _Pull:
    """Why the hand no longer pulls at the mechanism, until there is a motion to go on.

    Attributes:
        reason: The finding.
        is_released: Whether the robot rests where the mechanism has it.
    """

    reason: str
    is_released: bool = False


class _Loop:
    """State of an execution."""

    def __init__(self, plan: Plan, robot: Robot, settings: _Settings) -> None:
        self._first = plan
        self._robot = robot
        self._settings = settings
        self._joint: JointFinding | None = None  # that the present motion does not account for
        self._pull: _Pull | None = None
        # Configuration in which the hand closed, or went on after the last pull
        self._held_from: Floats | None = None
        self._rest: _Rest | None = None
        self._cycles = list[Cycle]()
        self._sent = list[tuple[float, Plan]]()
        self._late = 0
        self._seen = list[tuple[float, tuple[pin.GeometryObject, ...]]]()

    def run(self) -> ExecutionResult:
        state = self._read()
        monitor = Monitor(self._first, tracking=self._settings.tracking)
        finding = monitor.check_tracking(float(self._first.trajectory.times[0]), state)
        if finding:
            expected = "a robot at the start of the plan"
            raise InputError("not at its start", field="robot", expected=expected, got=finding)
        self._rehearse()
        self._monitor = monitor
        blocked = self._find_blockage(self._first, monitor)
        begin = self._robot.time + self._settings.period
        if blocked:
            self._sent.append((np.inf, self._first))  # it never begins: the robot stays there
            self._brake(blocked)
            del self._sent[0]
        else:
            self._robot.send(self._first.trajectory, begin)
            self._sent.append((begin, self._first))
        try:
            reason = self._run_cycles(begin)
        except BaseException:  # also Ctrl-C: nobody watches the robot any more
            self._robot.stop()
            raise
        return ExecutionResult(
            self._first,
            not reason,
            reason,
            tuple(self._cycles),
            tuple(self._sent),
            self._late,
            tuple(self._seen),
        )

    def _run_cycles(self, next_cycle: float) -> str:
        """Run cycles until the motion is over; return why it cannot go on, "" if it is done."""
        while True:
            self._robot.wait(next_cycle)
            now = self._robot.time
            began = time.perf_counter()
            motion_time = self._get_motion_time(now)
            decision, why = self._decide(now, self._read())
            latency = time.perf_counter() - began
            self._cycles.append(Cycle(now, motion_time, latency, decision, why))
            # A robot at rest misses nothing while a motion is searched.
            self._late += latency > self._settings.period and decision in ("go on", "replan")
            if decision == "stop":
                return why
            end = float(self._plan.trajectory.times[-1])
            if self._rest is None and self._get_motion_time(now) >= end:
                return self._monitor.check_tracking(end, self._read())
            next_cycle = max(next_cycle + self._settings.period, self._robot.time)

    def _read(self) -> RobotState:
        """Return the measured state; headings count turns as the present motion does."""
        state = self._robot.read()
        motion = self._first.trajectory
        time = float(motion.times[0])
        if self._sent:
            motion = self._plan.trajectory
            time = self._get_motion_time(state.time)
        near = motion.at(time)[: motion.robot_size]
        positions = self._first.scene.robot.unwrap(state.positions, near)
        return dataclasses.replace(state, positions=positions)

    def _rehearse(self) -> None:
        """Plan the rest of the motion before it begins, to load and build what that takes.

        The first time it takes up to seconds, for which a moving robot has no time.
        """
        triangulate(coal.Box(1.0, 1.0, 1.0))  # imports what other surfaces take, too
        begin = float(self._first.trajectory.times[0])
        replan(self._first, begin, time_limit=_REHEARSAL, planner=self._settings.planner)

    @property
    def _plan(self) -> Plan:
        return self._sent[-1][1]

    def _get_motion_time(self, now: float) -> float:
        """Return the time of the present motion at a time of the robot's clock [s]."""
        begin, plan = self._sent[-1]
        first = float(plan.trajectory.times[0])
        return min(max(now - begin + first, first), float(plan.trajectory.times[-1]))

    def _send(self, plan: Plan, begin: float | None = None) -> bool:
        """Send a plan's motion, unless it is too late or blocked; return whether it was sent.

        Args:
            plan: The plan.
            begin: Time of the robot's clock at which it begins [s]. Default: as soon as possible.
        """
        monitor = Monitor(plan, tracking=self._settings.tracking)
        if self._find_blockage(plan, monitor):
            return False
        now = self._robot.time
        if begin is None:
            begin = now + self._settings.period
        elif now >= begin:
            return False
        self._robot.send(plan.trajectory, begin)
        self._sent.append((begin, plan))
        self._monitor = monitor
        return True

    def _find_blockage(self, plan: Plan, monitor: Monitor) -> str:
        """Return the obstacle that blocks a motion in the present world; "" if none does.

        The world may have changed while the motion was planned.
        """
        scene = None if self._settings.observe is None else self._look(plan.scene)
        return monitor.check_world(float(plan.trajectory.times[0]), scene)[0]

    def _look(self, scene: Scene) -> Scene:
        """Return a scene with the present placements of objects and obstacles."""
        if self._settings.observe is None:
            return scene
        seen = self._settings.observe(scene)
        shapes = seen.obstacle_visual
        before = self._seen[-1][1] if self._seen else ()
        if len(shapes) != len(before) or any(map(operator.is_not, shapes, before)):
            self._seen.append((self._robot.time, shapes))
        return seen

    def _decide(self, now: float, state: RobotState) -> tuple[Decision, str]:
        begin, plan = self._sent[-1]
        if now - state.time > _STALE:
            self._robot.stop()
            return "stop", f"the robot's state is {now - state.time:.2g} s old"
        self._note_hold(now, state)
        overload = self._find_overload(state) if now >= begin else ""
        if overload and not self._pull:
            return self._brake(overload, pulls=True)
        if self._settings.observer is not None and now >= begin:
            self._joint = self._settings.observer.observe(plan, self._get_motion_time(now))
            if self._joint is not None and self._joint.is_other_kind:
                self._robot.stop()
                return "stop", self._joint.reason
            left = float(plan.trajectory.times[-1]) - self._get_motion_time(now)
            if self._joint is not None and not self._pull and left > self._settings.lead:
                return self._brake(self._joint.reason, pulls=True)
        if self._rest is not None:
            return self._plan_from_rest(now, self._rest)
        if min(now, state.time) < begin:
            return "go on", ""  # a motion has been sent that has not begun
        scene = None if self._settings.observe is None else self._look(plan.scene)
        motion_time = self._get_motion_time(now)
        finding, touched = self._monitor.check_world(motion_time, scene)
        if np.isfinite(touched):
            stop = self._make_stop(motion_time)
            if touched - motion_time < self._settings.lead + float(stop.times[-1]):
                return self._brake(finding)  # there is no time to look for another motion
        error = None
        if not finding:
            measured = self._get_motion_time(state.time)
            finding = self._monitor.check_tracking(measured, state)
            planned = plan.trajectory.at(measured)[: plan.trajectory.robot_size]
            error = state.positions - planned
        if not finding:
            return "go on", ""
        return self._react(now, finding, error)

    def _note_hold(self, now: float, state: RobotState) -> None:
        """Note where the hand closes."""
        phase = find_phase_at(self._plan.trajectory, self._get_motion_time(now))
        if not phase.holds:
            self._held_from = None
        elif self._held_from is None:
            self._held_from = state.positions

    def _react(self, now: float, finding: str, error: Floats | None) -> tuple[Decision, str]:
        """Plan the rest again, or brake.

        Args:
            now: Time of the robot's clock [s].
            finding: Why.
            error: Distance of the robot from its motion, shape (n,), if that is why.
        """
        plan = self._plan
        takeover = self._get_motion_time(now) + self._settings.lead
        if takeover < float(plan.trajectory.times[-1]):
            try:
                scene = self._look(plan.scene_at(takeover))
                state = None if error is None else scene.start + error
                found = replan(
                    plan,
                    takeover,
                    state=state,
                    scene=scene,
                    time_limit=self._settings.time_limit,
                    planner=self._settings.planner,
                )
            except InputError as impossible:  # the steps are, there
                return self._brake(f"{finding}; {impossible}", error=error)
            if found.success and self._send(found, now + self._settings.lead):
                return "replan", finding
            too_late = "too late, or blocked meanwhile"
            finding = f"{finding}; {too_late if found.success else found.status}"
        return self._brake(finding, error=error)

    def _make_stop(self, motion_time: float) -> Trajectory:
        """Return the motion that brakes from a time of the present motion on [s]."""
        plan = self._plan
        return brake(plan.scene, plan.trajectory, motion_time)

    def _brake(
        self, reason: str, *, error: Floats | None = None, pulls: bool = False
    ) -> tuple[Decision, str]:
        """Send a braking motion on the path.

        Whatever will be touched, nothing is better than to brake: it is sent unchecked.

        Args:
            reason: Why.
            error: Distance of the robot from its motion, shape (n,), if that is why: it brakes at
                this distance from the path.
            pulls: Whether the hand pulls against the mechanism that it holds. To brake on the path
                would be to pull on: the robot brakes where it really goes.
        """
        if pulls and self._robot.time < self._sent[-1][0] and len(self._sent) > 1:
            self._sent.pop()  # a motion that has not begun, and never will
        plan = self._plan
        size = plan.trajectory.robot_size
        error = np.zeros(size) if error is None else error
        error_rate = np.zeros(size)
        measured = 0.0
        if pulls:
            state = self._read()
            measured = self._get_motion_time(state.time)
            error = state.positions - plan.trajectory.at(measured)[:size]
            error_rate = state.velocities - plan.trajectory.velocity(measured)[:size]

        def brake_from(begin: float) -> Trajectory:
            motion_time = self._get_motion_time(begin)
            return brake(
                plan.scene,
                plan.trajectory,
                motion_time,
                error=error + error_rate * (motion_time - measured),
                error_rate=error_rate,
            )

        sent = send_soon(self._robot, brake_from)
        assert sent is not None  # it always brakes
        begin, motion = sent
        motion_time = self._get_motion_time(begin)
        if self._rest is None:
            try:
                steps = find_remaining_steps(plan, motion_time)
            except InputError:
                return "stop", reason
            self._rest = _Rest(steps, plan.trajectory)
        stop = plan.check_stop(motion, self._look(plan.scene_at(motion_time)))
        self._sent.append((begin, stop))
        self._rest.begin_again(begin + float(motion.times[-1]))
        if pulls:
            self._pull = _Pull(reason)
        return "brake", reason

    def _find_overload(self, state: RobotState) -> str:
        """Return how a limit of force or torque is exceeded; "" if none is."""
        force, torque = state.grasp_force or 0.0, state.grasp_torque or 0.0
        if force > self._settings.force_limit:
            return f"pulls against the mechanism with {force:.0f} N"
        if torque > self._settings.torque_limit:
            return f"pulls against the mechanism with {torque:.0f} N·m"
        return ""

    def _plan_from_rest(self, now: float, rest: _Rest) -> tuple[Decision, str]:
        """Plan the remaining steps from where the robot stands, once it does."""
        if now < rest.since:
            return "wait", "braking"
        pull = self._pull
        if now > rest.since + self._settings.patience:
            return "stop", pull.reason if pull else "no motion was found from rest"
        if pull and not pull.is_released:
            self._robot.stop()  # commands that are off the mechanism pull at rest, too
            pull.is_released = True
            return "wait", pull.reason
        if pull and self._joint is None and not self._has_moved_on():
            decision: Decision = "stop" if self._settings.observer is None else "wait"
            return decision, pull.reason
        try:
            scene = self._look_from_rest(rest)
            prepared = prepare(
                scene,
                rest.steps,
                options=self._first.options,
                terms=self._first.terms,
                planner=self._settings.planner,
            )
        except InputError as impossible:
            return "wait", str(impossible)
        # A search that time has ended is followed by a longer one, with other random numbers.
        first = max(self._settings.time_limit, _FIRST_SEARCH)
        limit = min(first * 2.0**rest.timeouts, max(self._settings.patience, first))
        found = prepared.solve(
            guess=rest.guess,
            time_limit=limit,
            seed=self._first.seed + rest.attempts,
            explain=False,
        )
        rest.attempts += 1
        rest.timeouts += found.status == "time limit"
        if not found.success:
            rest.margins |= _find_small_overlaps(found)
            return "wait", found.status
        if not self._send(found):
            return "wait", "blocked meanwhile"
        self._rest = None
        self._joint = None  # the new motion accounts for it
        if pull:
            self._pull = None
            self._held_from = found.scene.start
        return "replan", "from rest"

    def _look_from_rest(self, rest: _Rest) -> Scene:
        """Return the present world, in which the robot stands. Raises `InputError`."""
        end = float(self._plan.trajectory.times[-1])
        scene = self._look(self._plan.scene_at(end))
        if self._joint is not None:
            joint = self._joint
            scene = allow_near_neighbours(
                joint.update(scene),
                joint.object,
                joint.joint,
                rest.steps,
                self._first.options.dist_safe,
            )
        positions = self._read().positions
        distance = float(np.abs(positions - scene.start).max())
        if self._pull or distance > self._settings.tracking:
            scene = scene.with_start(base=positions[:3], arm=positions[3:])
        for links, margin in rest.margins.items():
            scene = scene.with_allowed(*links, margin)
        return measure_grasps(scene)

    def _has_moved_on(self) -> bool:
        """Return whether the mechanism has moved since the hand closed, or since the pull before.

        Then it is not blocked: the joint's error is too small to be estimated yet, and adds up.
        """
        if self._settings.observer is None or self._held_from is None:
            return False
        moved = np.abs(self._read().positions - self._held_from)
        return bool(moved.max() > self._settings.tracking)


def _find_small_overlaps(failed: Plan) -> dict[tuple[str, str], float]:
    """Return the links that overlap at the start of a failed plan → distance to allow [m].

    An object that is first seen while the robot brakes may overlap it a little. If any overlap is
    deeper than an error of the model, none is allowed.
    """
    margins = dict[tuple[str, str], float]()
    for violation in failed.report.violations:
        if violation.constraint != "start":
            continue
        first, dash, second = violation.subject.partition(" – ")
        if not dash or violation.amount > MODEL_ERROR:
            return {}
        margins[first, second] = -violation.amount - ACCEPTED_SHORTFALL
    return margins
