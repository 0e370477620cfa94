"""Checks that a wheeled base does not slip, turn too tightly or turn its wheels too fast."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.trajectory.curve import sample_intervals
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["check_rolling"]

STEP_TOLERANCE = 1e-4  # lateral motion, or shortfall for the turn, between waypoints [m]
SLIP_TOLERANCE = 1e-3  # lateral velocity, or shortfall for the turn, along a curve [m/s]
WHEEL_TOLERANCE = 1e-3  # relative excess over the limit
_SAMPLES_PER_CUBIC = 16


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
