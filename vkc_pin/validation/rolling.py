"""Whether a base on wheels moves as wheels do: along, not aside, turning no tighter than it steers, and none too fast."""

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

STEP_TOLERANCE = 1e-4  # [m] aside, or too short for its turn, from one waypoint to the next
SLIP_TOLERANCE = 1e-3  # [m/s] aside, or too slow for its turn, along a curve
WHEEL_TOLERANCE = 1e-3  # excess over the limit, relative to it
_SAMPLES_PER_CUBIC = 16  # moments on each cubic of a curve


def check_rolling(samples: Samples) -> Iterator[Violation]:
    """Yield how a base on wheels slips, turns tighter than it can, and turns its wheels too fast, each where it does so most.

    Along a curve its velocity tells, at moments close to each other on every cubic. Where there is
    none, nothing is said of how the base gets from one waypoint to the next, and the arc that leads
    there is what counts: its chord points where the base heads half-way.
    """
    robot, motion = samples.scene.robot, samples.trajectory
    if robot.base not in ("differential", "ackermann"):
        return
    smooth = motion.curve is not None
    unit, per, usual = (
        ("m/s", "", SLIP_TOLERANCE) if smooth else ("m", " in a step", STEP_TOLERANCE)
    )
    moments, along, aside, turn = _sample_velocities(motion) if smooth else _compute_steps(motion)
    spans = np.ones(len(moments)) if smooth else np.diff(motion.times)
    for kind, excess, tolerance, text in _compute_excesses(robot, along, aside, turn, spans):
        worst = int(np.argmax(excess))
        amount, time = float(excess[worst]), float(moments[worst])
        if not amount <= (usual if tolerance is None else tolerance):
            said, of = (
                (f"{1e3 * amount:.2f} m{unit}{per}", unit)
                if tolerance is None
                else (f"{amount:.3f} m/s", "m/s")
            )
            at = min(int(np.searchsorted(motion.times, time, side="right")), len(motion.times)) - 1
            yield Violation(
                kind,
                "base",
                waypoint=at,
                time=time,
                amount=amount,
                unit=of,
                detail=f"the base {text.format(said)}",
            )


def _compute_excesses(
    robot: Robot, along: Floats, aside: Floats, turn: Floats, spans: Floats
) -> Iterator[tuple[str, Floats, float | None, str]]:
    """Yield, for each constraint, by how much it is exceeded, how much is all right if not the usual, and what is said of it.

    Args:
        robot: Whose base it is.
        along: How far it goes along, or how fast, shape (K,).
        aside: The same, aside.
        turn: How far it turns, or how fast.
        spans: In what time, shape (K,) [s].
    """
    yield "slip", np.abs(aside), None, "slips sideways by {}"
    if robot.base == "ackermann":
        short = robot.turning_radius * np.abs(turn) - np.abs(along)
        yield (
            "turning",
            short,
            None,
            f"drives {{}} less than its turn takes at a radius of {robot.turning_radius:g} m",
        )
    if robot.wheels is not None:
        rim = robot.wheels.rim_speed
        fast = (np.abs(along) + robot.wheels.track / 2 * np.abs(turn)) / spans - rim
        yield "wheels", fast, WHEEL_TOLERANCE * rim, f"has a wheel that is {{}} over {rim:.3f} m/s"


def _compute_steps(motion: Trajectory) -> tuple[Floats, Floats, Floats, Floats]:
    """Return when the steps from waypoint to waypoint begin, how far the base goes along and aside [m], and turns [rad]."""
    poses = motion.positions[:, :3]
    return motion.times[:-1], *_transform_to_base_frame(
        np.diff(poses, axis=0), (poses[1:, 2] + poses[:-1, 2]) / 2
    )


def _sample_velocities(motion: Trajectory) -> tuple[Floats, Floats, Floats, Floats]:
    """Return moments of a curve, how fast the base goes along and aside then [m/s], and turns [rad/s]."""
    assert motion.curve is not None
    moments = sample_intervals(
        motion.curve.times, np.arange(_SAMPLES_PER_CUBIC) / _SAMPLES_PER_CUBIC, last=True
    )
    return moments, *_transform_to_base_frame(
        motion.curve.velocity(moments)[:, :3], motion.curve.at(moments)[:, 2]
    )


def _transform_to_base_frame(change: Floats, heading: Floats) -> tuple[Floats, Floats, Floats]:
    """Return changes of (x, y, yaw), shape (K, 3), as a base with these headings sees them: along, aside, and its turn."""
    dx, dy, turn = change.T
    return (
        np.cos(heading) * dx + np.sin(heading) * dy,
        np.cos(heading) * dy - np.sin(heading) * dx,
        turn,
    )
