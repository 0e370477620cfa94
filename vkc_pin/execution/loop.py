"""Runs a plan on a robot: monitors it, plans the rest again when something differs, or brakes."""

from __future__ import annotations

import time
from collections.abc import Callable

import coal
import numpy as np

from vkc_pin.errors import InputError, format_value
from vkc_pin.execution.monitor import Monitor
from vkc_pin.execution.record import Cycle, Decision, ExecutionResult
from vkc_pin.execution.robots import Robot, RobotState
from vkc_pin.planning.plan import Plan
from vkc_pin.planning.planner import Planner
from vkc_pin.planning.prepare import prepare
from vkc_pin.planning.replan import find_remaining_steps, measure_grasps, replan
from vkc_pin.planning.stopping import brake
from vkc_pin.utils.arguments import check_instance, check_number
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.trajectory import Trajectory

Observe = Callable[[Scene], Scene]
"""Updates a scene with the present placements of objects and obstacles, as far as known."""

_STALE = 0.5  # [s], age of a measured state with which no robot is moved on
_REHEARSAL = 10.0  # [s], limit of a plan that is made before the robot moves
_FIRST_SEARCH = 0.5  # [s] of the first search from rest
_BRAKE_DELAY = 0.02  # [s] from the decision to brake to its begin, for sending the motion


def execute(
    plan: Plan,
    robot: Robot,
    *,
    rate: float = 20.0,
    observe: Observe | None = None,
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

    Args:
        plan: A successful plan, in whose start the robot stands.
        robot: The robot.
        rate: Cycles per second [Hz].
        observe: Updates a scene with the present placements of objects and obstacles. Default:
            nothing changes.
        lead: Time from a decision to the begin of the new motion, within which it must be found
            [s].
        time_limit: Wall-clock limit of planning again [s]. Default: `lead`. More makes sense for a
            simulated robot whose clock stands still meanwhile.
        patience: Longest time at rest without a motion before execution fails [s].
        tracking: Largest accepted distance from the planned configuration, [m] and [rad].
        planner: Planner whose caches are used.

    Raises:
        InputError: The plan is no success or ends in motion, the robot is not at its start, or an
            argument is invalid.
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
    period = 1.0 / check_number(rate, "rate", "cycles per second", low=0.1, high=1000.0)
    lead = check_number(lead, "lead", "a time [s]", low=period)
    if time_limit is None:
        time_limit = lead
    time_limit = check_number(time_limit, "time_limit", "a time [s]", low=0.0, strict=True)
    patience = check_number(patience, "patience", "a time [s]", low=0.0)
    loop = _Loop(plan, robot, period, observe, lead, time_limit, patience, tracking, planner)
    return loop.run()


class _Loop:
    """State of an execution."""

    def __init__(
        self,
        plan: Plan,
        robot: Robot,
        period: float,
        observe: Observe | None,
        lead: float,
        time_limit: float,
        patience: float,
        tracking: float,
        planner: Planner | None,
    ) -> None:
        self._first = plan
        self._robot = robot
        self._period = period
        self._observe = observe
        self._lead = lead
        self._time_limit = time_limit
        self._patience = patience
        self._tracking = tracking
        self._planner = planner
        self._cycles = list[Cycle]()
        self._sent = list[tuple[float, Plan]]()
        # While the robot brakes or stands, the steps that are left, and the motion to guess from.
        self._waiting: tuple[tuple[Step, ...], Trajectory] | None = None
        self._rest_since = 0.0
        self._attempts = 0  # to find a motion from rest
        self._late = 0

    def run(self) -> ExecutionResult:
        state = self._robot.read()
        monitor = Monitor(self._first, tracking=self._tracking)
        finding = monitor.check_tracking(float(self._first.trajectory.times[0]), state)
        if finding:
            expected = "a robot at the start of the plan"
            raise InputError("not at its start", field="robot", expected=expected, got=finding)
        self._rehearse()
        begin = self._robot.time + self._period
        self._robot.send(self._first.trajectory, begin)
        self._sent.append((begin, self._first))
        self._monitor = monitor
        try:
            reason = self._run_cycles(begin)
        except BaseException:  # also Ctrl-C: nobody watches the robot any more
            self._robot.stop()
            raise
        return ExecutionResult(
            self._first, not reason, reason, tuple(self._cycles), tuple(self._sent), self._late
        )

    def _run_cycles(self, next_cycle: float) -> str:
        """Run cycles until the motion is over; return why it cannot go on, "" if it is done."""
        while True:
            self._robot.wait(next_cycle)
            now = self._robot.time
            began = time.perf_counter()
            motion_time = self._get_motion_time(now)
            decision, why = self._decide(now, self._robot.read())
            latency = time.perf_counter() - began
            self._cycles.append(Cycle(now, motion_time, latency, decision, why))
            # A robot at rest misses nothing while a motion is searched.
            self._late += latency > self._period and decision in ("go on", "replan")
            if decision == "stop":
                return why
            end = float(self._plan.trajectory.times[-1])
            if self._waiting is None and self._get_motion_time(now) >= end:
                return self._monitor.check_tracking(end, self._robot.read())
            next_cycle = max(next_cycle + self._period, self._robot.time)

    def _rehearse(self) -> None:
        """Plan the rest of the motion before it begins, to load and build what that takes.

        The first time it takes up to seconds, for which a moving robot has no time.
        """
        triangulate(coal.Box(1.0, 1.0, 1.0))  # imports what other surfaces take, too
        begin = float(self._first.trajectory.times[0])
        replan(self._first, begin, time_limit=_REHEARSAL, planner=self._planner)

    @property
    def _plan(self) -> Plan:
        return self._sent[-1][1]

    def _get_motion_time(self, now: float) -> float:
        """Return the time of the present motion at a time of the robot's clock [s]."""
        begin, plan = self._sent[-1]
        first = float(plan.trajectory.times[0])
        return min(max(now - begin + first, first), float(plan.trajectory.times[-1]))

    def _send(self, plan: Plan, begin: float) -> bool:
        """Send a plan's motion; return whether it is not too late for that."""
        monitor = Monitor(plan, tracking=self._tracking)
        if self._robot.time >= begin:
            return False
        self._robot.send(plan.trajectory, begin)
        self._sent.append((begin, plan))
        self._monitor = monitor
        return True

    def _look(self, scene: Scene) -> Scene:
        """Return a scene with the present placements of objects and obstacles."""
        return scene if self._observe is None else self._observe(scene)

    def _decide(self, now: float, state: RobotState) -> tuple[Decision, str]:
        begin, plan = self._sent[-1]
        if now - state.time > _STALE:
            self._robot.stop()
            return "stop", f"the robot's state is {now - state.time:.2g} s old"
        if self._waiting is not None:
            return self._plan_from_rest(now, self._waiting)
        if min(now, state.time) < begin:
            return "go on", ""  # a motion has been sent that has not begun
        scene = None if self._observe is None else self._look(plan.scene)
        motion_time = self._get_motion_time(now)
        finding, touched = self._monitor.check_world(motion_time, scene)
        if np.isfinite(touched):
            stop = self._make_stop(motion_time)
            if touched - motion_time < self._lead + float(stop.times[-1]):
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

    def _react(self, now: float, finding: str, error: Floats | None) -> tuple[Decision, str]:
        """Plan the rest again, or brake.

        Args:
            now: Time of the robot's clock [s].
            finding: Why.
            error: Distance of the robot from its motion, shape (n,), if that is why.
        """
        plan = self._plan
        takeover = self._get_motion_time(now) + self._lead
        if takeover < float(plan.trajectory.times[-1]):
            try:
                scene = self._look(plan.scene_at(takeover))
                state = None if error is None else scene.start + error
                found = replan(
                    plan,
                    takeover,
                    state=state,
                    scene=scene,
                    time_limit=self._time_limit,
                    planner=self._planner,
                )
            except InputError as impossible:  # the steps are, there
                return self._brake(f"{finding}; {impossible}")
            if found.success and self._send(found, now + self._lead):
                return "replan", finding
            finding = f"{finding}; {'too late' if found.success else found.status}"
        return self._brake(finding)

    def _make_stop(self, motion_time: float) -> Trajectory:
        """Return the motion that brakes from a time of the present motion on [s]."""
        plan = self._plan
        return brake(plan.scene, plan.trajectory, motion_time, plan.options)

    def _brake(self, reason: str) -> tuple[Decision, str]:
        """Send a braking motion on the path.

        Whatever will be touched, nothing is better than to brake: it is sent unchecked.
        """
        plan = self._plan
        delay = _BRAKE_DELAY
        while True:
            begin = self._robot.time + delay
            motion_time = self._get_motion_time(begin)
            motion = self._make_stop(motion_time)
            if self._robot.time < begin:
                break
            delay *= 2.0  # on a slow machine
        self._robot.send(motion, begin)
        try:
            steps = find_remaining_steps(plan, motion_time)
        except InputError:
            return "stop", reason
        self._waiting = (steps, plan.trajectory)
        stop = plan.check_stop(motion, self._look(plan.scene_at(motion_time)))
        self._sent.append((begin, stop))
        self._rest_since = begin + float(motion.times[-1])
        self._attempts = 0
        return "brake", reason

    def _plan_from_rest(
        self, now: float, waiting: tuple[tuple[Step, ...], Trajectory]
    ) -> tuple[Decision, str]:
        """Plan the remaining steps from where the robot stands, once it does."""
        if now < self._rest_since:
            return "wait", "braking"
        steps, guess = waiting
        if now > self._rest_since + self._patience:
            return "stop", "no motion was found from rest"
        end = float(self._plan.trajectory.times[-1])
        try:
            scene = measure_grasps(self._look(self._plan.scene_at(end)))
            prepared = prepare(
                scene,
                steps,
                options=self._first.options,
                terms=self._first.terms,
                planner=self._planner,
            )
        except InputError as impossible:
            return "wait", str(impossible)
        # Each search is longer than the one before, with other random numbers.
        first = max(self._time_limit, _FIRST_SEARCH)
        limit = min(first * 2.0**self._attempts, max(self._patience, first))
        found = prepared.solve(
            guess=guess, time_limit=limit, seed=self._first.seed + self._attempts, explain=False
        )
        self._attempts += 1
        if not found.success:
            return "wait", found.status
        if not self._send(found, self._robot.time + self._period):
            return "wait", "too late"
        self._waiting = None
        return "replan", "from rest"
