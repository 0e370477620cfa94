"""Checks velocities, accelerations, jerks, torques and wheels of a motion against their limits."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.report import Bound, Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.trajectory.curve import sample_intervals
from vkc_pin.world.trajectory.torques import MotionSamples, Torques, sample_curve
from vkc_pin.world.trajectory.trajectory import Trajectory

_MOTION_TOLERANCE = 1e-9  # relative to a limit
_MIN_SHARE = 5e-3  # smaller shares of the duration are not reported
ACCEPTED_RATE_TOLERANCE = 1e-3  # relative excess over a limit
REST_TOLERANCE = 1e-6  # [m/s] or [rad/s]
JUMP_TOLERANCE = 1e-3  # jump of an acceleration, relative to its limit
# Relative excess over a limit. Torques are evaluated only at three times of every cubic.
TORQUE_TOLERANCE = 5e-3
STEP_TOLERANCE = 1e-4  # lateral motion, or shortfall for the turn, between waypoints [m]
SLIP_TOLERANCE = 1e-3  # lateral velocity, or shortfall for the turn, along a curve [m/s]
WHEEL_TOLERANCE = 1e-3  # relative excess over the limit
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
    curve, names = samples.trajectory.curve, samples.trajectory.names
    if curve is None:
        return ()
    limits = np.array([samples.get_limits(name)[2:] for name in names]).T
    shares = [rates / limit for rates, limit in zip(curve.compute_max_rates(), limits, strict=True)]
    shares.append(jerk_time * curve.compute_jerks()[0] / limits[1])
    shares.append(np.zeros((len(curve.times) - 1, torques.shape[1])))
    np.maximum.at(shares[-1], moments.pieces, torques)
    every = np.hstack(shares)
    labels = [(name, kind) for kind in ("velocity", "acceleration", "jerk") for name in names]
    labels += [(name, "torque") for name in names[: torques.shape[1]]]
    moving = (np.hstack(shares[:2]) > _MOTION_TOLERANCE).any(axis=1)
    nearest = np.where(moving, every.argmax(axis=1), len(labels))
    spans, found = np.diff(curve.times), list[Bound]()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(nearest)) + 1, [len(nearest)]])
    for number in np.unique(nearest).tolist():
        stretches = [
            (curve.times[a], curve.times[b])
            for a, b in itertools.pairwise(edges)
            if nearest[a] == number
        ]
        begin, end = max(stretches, key=lambda stretch: float(stretch[1] - stretch[0]))
        name, kind = (*labels, ("", "rest"))[number]
        share = float(spans[nearest == number].sum() / spans.sum())
        found.append(Bound(name, kind, share=share, begin=float(begin), end=float(end)))
    return tuple(
        sorted(
            (bound for bound in found if bound.share >= _MIN_SHARE), key=lambda bound: -bound.share
        )
    )


def check_rates(samples: Samples, options: Options) -> Iterator[Violation]:
    """Yield the worst violations of velocity and acceleration limits (eq. 5) and of jerk limits.

    A curve must begin and end at rest. Accelerations are evaluated at the ends of its cubics, where
    they are largest. The jerk of each cubic is constant; with jerk limits, accelerations must not
    jump between cubics. Jerks of a motion without a curve are not checked, as its velocities jump.
    """
    motion, curve = samples.trajectory, samples.trajectory.curve
    jerks: tuple[Floats, Floats] | None = None
    if curve is None:
        moments, rests = motion.times, np.zeros((2, len(motion.names)))
        velocities, accelerations = motion.velocities(), motion.accelerations()
    else:
        moments, rests = curve.times, np.abs(curve.rates[[0, -1]])
        velocities, accelerations = curve.compute_max_rates()
        jerks = curve.compute_jerks() if options.jerk_time > 0.0 else None
    for i, name in enumerate(motion.names):
        _, _, fastest, strongest = samples.get_limits(name)
        looks = [
            ("velocity", velocities[:, i], fastest, "s", moments),
            ("acceleration", accelerations[:, i], strongest, "s²", moments),
            ("velocity", rests[:, i], REST_TOLERANCE, "s", motion.times[[0, -1]]),
        ]
        if jerks is not None and np.isfinite(strongest):
            looks.append(("jerk", jerks[0][:, i], strongest / options.jerk_time, "s³", moments))
            looks.append(
                ("jerk", jerks[1][:, i], JUMP_TOLERANCE * strongest, "s² at once", moments)
            )
        unit = samples.get_unit(name)
        for kind, values, limit, per, when in looks:
            worst = int(np.argmax(np.abs(values)))
            value = abs(float(values[worst]))
            if not value <= limit * (1 + ACCEPTED_RATE_TOLERANCE) + 1e-9:
                at = max(int(np.searchsorted(motion.times, when[worst], side="right")) - 1, 0)
                detail = f"{value:.3f} {unit}/{per} is more than {limit:.3f} {unit}/{per}"
                yield samples.make_violation(
                    kind, name, value - limit, f"{unit}/{per}", detail, waypoint=at
                )


class MotorLoads:
    """Motor torques at the ends and middle of every cubic, or at waypoints if there is no curve."""

    def __init__(self, samples: Samples) -> None:
        self.samples, self.trajectory = samples, samples.trajectory
        self._torques = Torques(samples.scene, samples.trajectory, samples.free_objects)

    @cached_property
    def moments(self) -> MotionSamples:
        """Times of the evaluation and the motion at these times."""
        trajectory, curve = self.trajectory, self.trajectory.curve
        if curve is not None:
            return sample_curve(curve)
        speeds = np.pad(trajectory.velocities(), ((1, 1), (0, 0)))
        pieces = np.minimum(np.arange(len(trajectory.times)), len(trajectory.times) - 2)
        return MotionSamples(
            trajectory.times,
            pieces,
            trajectory.positions,
            0.5 * (speeds[1:] + speeds[:-1]),
            trajectory.accelerations(),
        )

    @cached_property
    def waypoints(self) -> Ints:
        """Last waypoint at or before each time."""
        edges = (
            self.trajectory.times if self.trajectory.curve is None else self.trajectory.curve.times
        )
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
        now, phases = self.moments, self._torques.phases_of(self.waypoints[rows])
        return self._torques.at(
            phases,
            now.positions[rows],
            speed * now.velocities[rows],
            speed**2 * now.accelerations[rows],
        )

    def find_violations(self) -> list[Violation]:
        """Return the worst violation of each joint's torque limit."""
        found = list[Violation]()
        for k in np.flatnonzero(self.torque_ratios.max(axis=0) > 1.0 + TORQUE_TOLERANCE).tolist():
            row = int(np.argmax(self.torque_ratios[:, k]))
            name, limit = self.trajectory.names[k], float(self._torques.torque_limits.limits[k])
            torque = abs(self.torques[row, k])
            unit = "N" if self.samples.get_unit(name) == "m" else "N·m"
            rest = abs(float(self._compute_torques(np.array([row]), 1e-2)[0, k]))
            why = f"{rest:.4g} {unit} {'even ' if rest > limit else ''}at rest"
            detail = f"{torque:.4g} {unit} exceeds the motor's {limit:.4g} {unit}, {why}"
            at, time = int(self.waypoints[row]), float(self.moments.times[row])
            found.append(
                self.samples.make_violation(
                    "torque", name, torque - limit, unit, detail, waypoint=at, time=time
                )
            )
        return found

    def summarize(self, jerk_time: float = 0.0) -> dict[str, Any]:
        """Return the fields of the report; `jerk_time` is that of `Options`."""
        remarks = [f"torques not checked: {note}" for note in self._torques.torque_limits.notes]
        if self._torques.massless_objects:
            remarks.append(
                "carried as massless, since no mass is given: "
                f"{', '.join(self._torques.massless_objects)}"
            )
        found = find_limiting_constraints(self.samples, self.moments, self.torque_ratios, jerk_time)
        return {
            "torque": float(self.torque_ratios.max(initial=0.0)),
            "bounds": found,
            "remarks": tuple(remarks),
        }


def check_rolling(samples: Samples) -> Iterator[Violation]:
    """Yield the worst violations of slip, turning radius and wheel speed of a wheeled base.

    Along a curve the velocity is checked at 16 times per cubic. Without a curve the motion between
    waypoints is undefined; the base is assumed to follow the arc between them, whose chord is
    parallel to the mean heading.
    """
    robot, motion = samples.scene.robot, samples.trajectory
    if robot.base not in ("differential", "ackermann"):
        return
    smooth = motion.curve is not None
    unit, per = ("m/s", "") if smooth else ("m", " in a step")
    usual = SLIP_TOLERANCE if smooth else STEP_TOLERANCE
    moments, along, aside, turn = _sample_velocities(motion) if smooth else _compute_steps(motion)
    spans = np.ones(len(moments)) if smooth else np.diff(motion.times)
    for kind, excess, tolerance, text in _compute_excesses(robot, along, aside, turn, spans):
        worst = int(np.argmax(excess))
        amount, time = float(excess[worst]), float(moments[worst])
        if not amount <= (usual if tolerance is None else tolerance):
            in_text = f"{1e3 * amount:.2f} m{unit}{per}"
            if tolerance is not None:
                unit, in_text = "m/s", f"{amount:.3f} m/s"
            detail = f"the base {text.format(in_text)}"
            yield samples.make_violation(kind, "base", amount, unit, detail, time=time)


def _compute_excesses(
    robot: Robot, along: Floats, aside: Floats, turn: Floats, spans: Floats
) -> Iterator[tuple[str, Floats, float | None, str]]:
    """Yield constraint, excess, tolerance (None: the default) and text for each constraint.

    `along`, `aside` and `turn` are displacements in times `spans`, or velocities, whose `spans` are
    1; all of shape (K,).
    """
    yield "slip", np.abs(aside), None, "slips sideways by {}"
    if robot.base == "ackermann":
        short = robot.turning_radius * np.abs(turn) - np.abs(along)
        radius = f"a radius of {robot.turning_radius:g} m"
        yield "turning", short, None, f"drives {{}} less than its turn requires at {radius}"
    if robot.wheels is not None:
        rim = robot.wheels.rim_speed
        fast = (np.abs(along) + robot.wheels.track / 2 * np.abs(turn)) / spans - rim
        yield "wheels", fast, WHEEL_TOLERANCE * rim, f"has a wheel that is {{}} over {rim:.3f} m/s"


def _compute_steps(motion: Trajectory) -> tuple[Floats, Floats, Floats, Floats]:
    """Return begin [s], longitudinal and lateral motion [m] and turn [rad] of every segment."""
    poses = motion.positions[:, :3]
    return motion.times[:-1], *_transform_to_base_frame(
        np.diff(poses, axis=0), (poses[1:, 2] + poses[:-1, 2]) / 2
    )


def _sample_velocities(motion: Trajectory) -> tuple[Floats, Floats, Floats, Floats]:
    """Return times on a curve and longitudinal, lateral [m/s] and angular velocity [rad/s]."""
    assert motion.curve is not None
    shares = np.arange(_SAMPLES_PER_CUBIC) / _SAMPLES_PER_CUBIC
    moments = sample_intervals(motion.curve.times, shares, last=True)
    return moments, *_transform_to_base_frame(
        motion.curve.velocity(moments)[:, :3], motion.curve.at(moments)[:, 2]
    )


def _transform_to_base_frame(change: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
    """Transform changes of (x, y, yaw), shape (K, 3), to the base frame: along, aside, turn."""
    dx, dy, turn = change.T
    return (
        np.cos(heading) * dx + np.sin(heading) * dy,
        np.cos(heading) * dy - np.sin(heading) * dx,
        turn,
    )
