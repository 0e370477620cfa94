"""Checks velocities, accelerations, jerks, torques and wheels of a motion against their limits."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.report import Bound, Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.task.steps import Configure, Step
from vkc_pin.world.trajectory.curve import sample_intervals
from vkc_pin.world.trajectory.torques import MotionSamples, Torques, sample_curve
from vkc_pin.world.trajectory.trajectory import Trajectory

# relative to a limit; slower segments are at rest
_MOTION_TOLERANCE = 1e-9
# smaller shares of the duration are not reported
_MIN_SHARE = 5e-3
# relative excess over a limit
ACCEPTED_RATE_TOLERANCE = 1e-3
# deviation of the velocity at the ends [m/s] or [rad/s]
REST_TOLERANCE = 1e-6
_END_TEXT = "{value} from the velocity that is required there"
# jump of an acceleration, relative to its limit
JUMP_TOLERANCE = 1e-3
# Relative excess over a limit. Torques are evaluated only at three times of every cubic.
TORQUE_TOLERANCE = 5e-3
# lateral motion, or shortfall for the turn, between waypoints [m]
STEP_TOLERANCE = 1e-4
# lateral velocity, or shortfall for the turn, along a curve [m/s]
SLIP_TOLERANCE = 1e-3
# relative excess over the limit
WHEEL_TOLERANCE = 1e-3
# times per cubic at which rolling is checked
_SAMPLES_PER_CUBIC = 16


def find_limiting_constraints(
    samples: Samples, moments: MotionSamples, torques: Floats, jerk_time: float
) -> tuple[Bound, ...]:
    """Find the limits that bound the speed of a motion, by decreasing share of the duration.

    Args:
        samples: Sampled motion. Without a curve the result is empty.
        moments: Motion at K times.
        torques: Torques at these times relative to their limits, shape (K, robot coordinates).
        jerk_time: See `Options.jerk_time`.
    """
    curve = samples.trajectory.curve
    names = samples.trajectory.names
    if curve is None:
        return ()
    limits = np.array([samples.get_limits(name)[2:] for name in names])
    velocity_limits = limits[:, 0]
    acceleration_limits = limits[:, 1]
    # The largest rates of each cubic relative to their limits, one column a limit.
    speeds, accelerations = curve.compute_max_rates()
    velocity_ratios = speeds / velocity_limits
    acceleration_ratios = accelerations / acceleration_limits
    jerk_ratios = jerk_time * curve.compute_jerks()[0] / acceleration_limits
    torque_ratios = np.zeros((len(curve.times) - 1, torques.shape[1]))
    np.maximum.at(torque_ratios, moments.pieces, torques)
    ratios = np.hstack([velocity_ratios, acceleration_ratios, jerk_ratios, torque_ratios])
    labels: list[tuple[str, str]] = []
    for kind in ("velocity", "acceleration", "jerk"):
        labels += [(name, kind) for name in names]
    labels += [(name, "torque") for name in names[: torques.shape[1]]]
    rates = np.hstack([velocity_ratios, acceleration_ratios])
    is_moving = (rates > _MOTION_TOLERANCE).any(axis=1)
    at_rest = len(labels)
    labels.append(("", "rest"))
    nearest = np.where(is_moving, ratios.argmax(axis=1), at_rest)
    spans = np.diff(curve.times)
    found: list[Bound] = []
    for number in np.unique(nearest).tolist():
        share = float(spans[nearest == number].sum() / spans.sum())
        if share < _MIN_SHARE:
            continue
        name, kind = labels[number]
        begin, end = _find_longest_stretch(curve.times, nearest, number)
        found.append(Bound(name, kind, share=share, begin=begin, end=end))
    return tuple(sorted(found, key=lambda bound: -bound.share))


def _find_longest_stretch(times: Floats, labels: Ints, label: int) -> tuple[float, float]:
    """Return begin and end [s] of the longest run of intervals with a label, the first of equals.

    Args:
        times: Edges of the intervals, shape (K + 1,) [s].
        labels: Label of each interval, shape (K,).
        label: The label of the run.
    """
    changes = np.flatnonzero(np.diff(labels)) + 1
    edges = np.concatenate([[0], changes, [len(labels)]])
    longest = -np.inf
    stretch = (0.0, 0.0)
    for first, last in itertools.pairwise(edges):
        begin = float(times[first])
        end = float(times[last])
        if labels[first] == label and end - begin > longest:
            longest = end - begin
            stretch = (begin, end)
    return stretch


def check_rates(samples: Samples, steps: Sequence[Step], options: Options) -> Iterator[Violation]:
    """Yield the worst violations of velocity and acceleration limits (eq. 5) and of jerk limits.

    A curve must begin with the velocity of the scene's start and end with that of the last step, at
    rest if it states none. Accelerations are
    evaluated at the ends of its cubics, where they are largest. The jerk of each cubic is constant;
    with jerk limits, accelerations must not jump between cubics. Jerks of a motion without a curve
    are not checked, as its velocities jump.
    """
    motion = samples.trajectory
    curve = motion.curve
    ends = motion.times[[0, -1]]
    jerks: tuple[Floats, Floats] | None = None
    if curve is None:
        moments = motion.times
        end_errors = np.zeros((2, len(motion.names)))
        velocities = motion.velocities()
        accelerations = motion.accelerations(samples.estimate_start_velocity())
    else:
        moments = curve.times
        end_errors = curve.rates[[0, -1]] - [
            samples.start_velocity,
            _find_end_velocity(samples, steps[-1]),
        ]
        end_errors = np.nan_to_num(np.abs(end_errors))
        velocities, accelerations = curve.compute_max_rates()
        if options.jerk_time > 0.0:
            jerks = curve.compute_jerks(samples.start_acceleration)
    for i, name in enumerate(motion.names):
        _, _, max_speed, max_acceleration = samples.get_limits(name)
        checks = [
            _RateCheck("velocity", velocities[:, i], max_speed, "s", moments),
            _RateCheck("acceleration", accelerations[:, i], max_acceleration, "s²", moments),
            _RateCheck("velocity", end_errors[:, i], REST_TOLERANCE, "s", ends, _END_TEXT),
        ]
        if jerks is not None and np.isfinite(max_acceleration):
            inside, jumps = jerks
            max_jerk = max_acceleration / options.jerk_time
            max_jump = JUMP_TOLERANCE * max_acceleration
            checks.append(_RateCheck("jerk", inside[:, i], max_jerk, "s³", moments))
            checks.append(_RateCheck("jerk", jumps[:, i], max_jump, "s² at once", moments))
        for check in checks:
            yield from _check_rate(samples, name, check)


def _find_end_velocity(samples: Samples, step: Step) -> Floats:
    """Return the velocity of the trajectory's coordinates with which a last step ends, (n,)."""
    velocity = np.zeros(len(samples.trajectory.names))
    if isinstance(step, Configure):
        for joint, value in step.velocities.items():
            move = samples.scene.robot.planned_joints[joint]
            velocity[move.coordinate] = value / move.factor
    return velocity


class _RateCheck(NamedTuple):
    """Values of one coordinate, and the limit of their magnitudes.

    Attributes:
        kind: Name of the constraint.
        values: The values, shape (K,).
        limit: Limit of their magnitudes.
        per: What follows "m/" or "rad/" in their unit.
        times: Times of the values [s], shape (K,) or more.
        text: Text of a violation.
    """

    kind: str
    values: Floats
    limit: float
    per: str
    times: Floats
    text: str = "{value} is more than {limit}"


def _check_rate(samples: Samples, name: str, check: _RateCheck) -> Iterator[Violation]:
    """Yield the worst violation of one limit of a coordinate."""
    limit = check.limit
    worst = int(np.argmax(np.abs(check.values)))
    value = abs(float(check.values[worst]))
    if value <= limit * (1 + ACCEPTED_RATE_TOLERANCE) + 1e-9:
        return
    before = int(np.searchsorted(samples.trajectory.times, check.times[worst], side="right")) - 1
    unit = f"{samples.get_unit(name)}/{check.per}"
    detail = check.text.format(value=f"{value:.3f} {unit}", limit=f"{limit:.3f} {unit}")
    yield samples.make_violation(
        check.kind, name, value - limit, unit, detail, waypoint=max(before, 0)
    )


class MotorLoads:
    """Motor torques at the ends and middle of every cubic, or at waypoints if there is no curve."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        self.trajectory = samples.trajectory
        self._torques = Torques(samples.scene, samples.trajectory, samples.free_objects)

    @cached_property
    def moments(self) -> MotionSamples:
        """Times of the evaluation and the motion at these times."""
        trajectory = self.trajectory
        if trajectory.curve is not None:
            return sample_curve(trajectory.curve)
        count = len(trajectory.times)
        segments = np.minimum(np.arange(count), count - 2)
        # The velocity at a waypoint is the mean of those before and after it: before the motion it
        # is the start's, after it zero.
        start_velocity = self.samples.estimate_start_velocity()
        speeds = np.pad(trajectory.velocities(), ((1, 1), (0, 0)))
        speeds[0] = start_velocity
        velocities = 0.5 * (speeds[1:] + speeds[:-1])
        return MotionSamples(
            trajectory.times,
            segments,
            trajectory.positions,
            velocities,
            trajectory.accelerations(start_velocity),
        )

    @cached_property
    def waypoints(self) -> Ints:
        """Last waypoint at or before each time."""
        curve = self.trajectory.curve
        edges = self.trajectory.times if curve is None else curve.times
        before = np.searchsorted(self.trajectory.times, edges[:-1], side="right") - 1
        return np.asarray(before[self.moments.pieces])

    @cached_property
    def torques(self) -> Floats:
        """Torques at every time, shape (K, robot coordinates) [N·m], [N]."""
        return self._compute_torques(np.arange(len(self.moments.times)))

    @cached_property
    def torque_ratios(self) -> Floats:
        """|Torques| relative to their limits, shape (K, robot coordinates); 0 if unknown."""
        if not self._torques.torque_limits.is_known:
            return np.zeros((len(self.moments.times), self.trajectory.robot_size))
        return np.asarray(np.abs(self.torques) / self._torques.torque_limits.limits)

    def _compute_torques(self, rows: Ints, speed: float = 1.0) -> Floats:
        """Compute the torques at some times of a motion that is `speed` times as fast."""
        moments = self.moments
        return self._torques.at(
            self._torques.phases_of(self.waypoints[rows]),
            moments.positions[rows],
            speed * moments.velocities[rows],
            speed**2 * moments.accelerations[rows],
        )

    def find_violations(self) -> list[Violation]:
        """Return the worst violation of each joint's torque limit."""
        exceeded = self.torque_ratios.max(axis=0) > 1.0 + TORQUE_TOLERANCE
        return [self._make_violation(k) for k in np.flatnonzero(exceeded).tolist()]

    def _make_violation(self, k: int) -> Violation:
        """Make the worst violation of the torque limit of coordinate k."""
        row = int(np.argmax(self.torque_ratios[:, k]))
        name = self.trajectory.names[k]
        limit = float(self._torques.torque_limits.limits[k])
        torque = abs(self.torques[row, k])
        unit = "N" if self.samples.get_unit(name) == "m" else "N·m"
        # At a hundredth of the speed little but the weight is left.
        torque_at_rest = abs(float(self._compute_torques(np.array([row]), 1e-2)[0, k]))
        even = "even " if torque_at_rest > limit else ""
        why = f"{torque_at_rest:.4g} {unit} {even}at rest"
        return self.samples.make_violation(
            "torque",
            name,
            torque - limit,
            unit,
            f"{torque:.4g} {unit} exceeds the motor's {limit:.4g} {unit}, {why}",
            waypoint=int(self.waypoints[row]),
            time=float(self.moments.times[row]),
        )

    def summarize(self, jerk_time: float = 0.0) -> dict[str, Any]:
        """Return the fields of the report; `jerk_time` is that of `Options`."""
        remarks = [f"torques not checked: {note}" for note in self._torques.torque_limits.notes]
        if self._torques.massless_objects:
            names = ", ".join(self._torques.massless_objects)
            remarks.append(f"carried as massless, since no mass is given: {names}")
        ratios = self.torque_ratios
        return {
            "torque": float(ratios.max(initial=0.0)),
            "bounds": find_limiting_constraints(self.samples, self.moments, ratios, jerk_time),
            "remarks": tuple(remarks),
        }


def check_rolling(samples: Samples) -> Iterator[Violation]:
    """Yield the worst violations of slip, turning radius and wheel speed of a wheeled base.

    Along a curve the velocity is checked at 16 times per cubic. Without a curve the motion between
    waypoints is undefined; the base is assumed to follow the arc between them, whose chord is
    parallel to the mean heading.
    """
    robot = samples.scene.robot
    if robot.base not in ("differential", "ackermann"):
        return
    rolling = _measure_rolling(samples.trajectory)
    for check in _compute_excesses(robot, rolling):
        worst = int(np.argmax(check.excess))
        amount = float(check.excess[worst])
        if not amount <= check.tolerance:
            detail = f"the base {check.text.format(check.format_amount(amount))}"
            yield samples.make_violation(
                check.kind, "base", amount, check.unit, detail, time=float(rolling.times[worst])
            )


class _Rolling(NamedTuple):
    """Motion of the base in its own frame: velocities on a curve, or displacements of segments.

    Attributes:
        times: Times on the curve, or begins of the segments, shape (K,) [s].
        along: Longitudinal motion, shape (K,) [m/s] or [m].
        aside: Lateral motion, shape (K,) [m/s] or [m].
        turn: Change of the heading, shape (K,) [rad/s] or [rad].
        spans: Durations of the displacements, shape (K,) [s]; 1 for velocities.
        is_velocity: Whether these are velocities.
    """

    times: Floats
    along: Floats
    aside: Floats
    turn: Floats
    spans: Floats
    is_velocity: bool


class _RollingCheck(NamedTuple):
    """How far one constraint of rolling is exceeded, with the text of a violation.

    Attributes:
        kind: Name of the constraint.
        excess: Excess over the limit, shape (K,).
        tolerance: Accepted excess.
        unit: Unit of both.
        text: Text, in which "{}" stands for the excess.
        format_amount: Makes the text of an excess.
    """

    kind: str
    excess: Floats
    tolerance: float
    unit: str
    text: str
    format_amount: Callable[[float], str]


def _compute_excesses(robot: Robot, rolling: _Rolling) -> Iterator[_RollingCheck]:
    """Yield the excess of each constraint of a wheeled base.

    A base rolls without slip if its lateral motion is 0. With a turning radius r it moves at least
    r |turn| along. Its outer wheel moves by |along| + track / 2 · |turn|.
    """
    if rolling.is_velocity:
        unit = "m/s"
        tolerance = SLIP_TOLERANCE
        format_amount = _format_velocity
    else:
        unit = "m"
        tolerance = STEP_TOLERANCE
        format_amount = _format_step
    slip = np.abs(rolling.aside)
    yield _RollingCheck("slip", slip, tolerance, unit, "slips sideways by {}", format_amount)
    if robot.base == "ackermann":
        shortfall = robot.turning_radius * np.abs(rolling.turn) - np.abs(rolling.along)
        text = f"drives {{}} less than its turn requires at a radius of {robot.turning_radius:g} m"
        yield _RollingCheck("turning", shortfall, tolerance, unit, text, format_amount)
    if robot.wheels is not None:
        rim_speed = robot.wheels.rim_speed
        outer = np.abs(rolling.along) + robot.wheels.track / 2 * np.abs(rolling.turn)
        excess = outer / rolling.spans - rim_speed
        text = f"has a wheel that is {{}} over {rim_speed:.3f} m/s"
        yield _RollingCheck(
            "wheels", excess, WHEEL_TOLERANCE * rim_speed, "m/s", text, _format_wheel_speed
        )


def _format_velocity(amount: float) -> str:
    return f"{1e3 * amount:.2f} mm/s"


def _format_step(amount: float) -> str:
    return f"{1e3 * amount:.2f} mm in a step"


def _format_wheel_speed(amount: float) -> str:
    return f"{amount:.3f} m/s"


def _measure_rolling(motion: Trajectory) -> _Rolling:
    """Return the velocities of the base on a motion's curve, or its segments without a curve."""
    curve = motion.curve
    if curve is None:
        times = motion.times[:-1]
        poses = motion.positions[:, :3]
        mean_headings = (poses[1:, 2] + poses[:-1, 2]) / 2
        along, aside, turn = _transform_to_base_frame(np.diff(poses, axis=0), mean_headings)
        return _Rolling(times, along, aside, turn, np.diff(motion.times), is_velocity=False)
    fractions = np.arange(_SAMPLES_PER_CUBIC) / _SAMPLES_PER_CUBIC
    times = sample_intervals(curve.times, fractions, last=True)
    velocities = curve.velocity(times)[:, :3]
    headings = curve.at(times)[:, 2]
    along, aside, turn = _transform_to_base_frame(velocities, headings)
    return _Rolling(times, along, aside, turn, np.ones(len(times)), is_velocity=True)


def _transform_to_base_frame(change: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
    """Transform changes of (x, y, yaw), shape (K, 3), to the base frame: along, aside, turn.

    With the heading θ, along = cos θ dx + sin θ dy and aside = cos θ dy − sin θ dx.
    """
    dx, dy, turn = change.T
    along = np.cos(heading) * dx + np.sin(heading) * dy
    aside = np.cos(heading) * dy - np.sin(heading) * dx
    return along, aside, turn
