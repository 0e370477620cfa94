"""Brakes on the path of a planned motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Configure, Step
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import find_phase_at

_STEP = 5e-3  # [s] of the motion's time between knots of the braking motion
# Share of the acceleration limits that is used: between knots, a cubic may exceed its accelerations
# at the knots a little.
_SHARE = 0.97
_SLOW = 1e-9  # [m/s] or [rad/s] below which a coordinate does not bound the braking
_REST = 2e-3  # [s], duration of a stop of a motion that rests already


def brake(
    scene: Scene,
    motion: Trajectory,
    time: float,
    *,
    error: ArrayLike = 0.0,
    error_rate: ArrayLike = 0.0,
) -> Trajectory:
    """Return a motion along a path that comes to rest as soon as possible.

    The motion q(τ) is run through by a clock τ(t) whose rate r = dτ/dt falls from 1 to 0:

        dq/dt = r q'(τ),    d²q/dt² = r² q''(τ) + u q'(τ),    u = d²τ/dt² = ½ d(r²)/dτ

    From one knot to the next, u is constant. It is the least value at which no coordinate exceeds
    its acceleration limit at either. As the motion keeps its limits at r = 1, u = 0 does at every
    r ≤ 1, so that there always is one.

    A robot whose hand is guided by something is off the path: by e = `error` at first, which grows
    with e' = `error_rate`. It is braked on q(τ) + e + e' (τ - `time`), which is where it really
    goes, up to terms of second order.

    Args:
        scene: Scene of the motion.
        motion: Smooth motion within the limits.
        time: Time at which braking begins [s].
        error: Distance of the robot from the path then, shape (n,), [m] and [rad].
        error_rate: Its rate, shape (n,), [m/s] and [rad/s].

    Returns:
        The motion from `time` on, which counts from 0.
    """
    limits = Limits.from_scene(scene, motion.names, jerk_time=0.0)
    limit = _SHARE * limits.acceleration
    places = _choose_places(motion, time)
    velocity = motion.velocity(places)
    begin, end = _compute_accelerations(motion, places)
    clocks = [time]
    squares = [1.0]  # of the rate r
    for k, duration in enumerate(np.diff(places).tolist()):
        square = squares[-1]
        # At the end of the part, r² has become square + 2 u duration: linear in u there, too.
        factors = np.concatenate([velocity[k], velocity[k + 1] + 2.0 * duration * end[k]])
        offsets = square * np.concatenate([begin[k], end[k]])
        braking = _find_least(factors, offsets, np.concatenate([limit, limit]))
        next_square = square + 2.0 * braking * duration
        if next_square <= 0.0:
            distance = -square / (2.0 * braking)
            if distance > _SLOW:
                clocks.append(float(places[k]) + distance)
                squares.append(0.0)
            squares[-1] = 0.0
            break
        clocks.append(float(places[k + 1]))
        squares.append(next_square)
    offset = np.zeros(len(motion.names))
    slope = np.zeros(len(motion.names))
    offset[: motion.robot_size] = error
    slope[: motion.robot_size] = error_rate
    return _run_through(motion, np.array(clocks), np.sqrt(squares), offset, slope)


def _choose_places(motion: Trajectory, time: float) -> Floats:
    """Return times of a motion from `time` to its end, with all its knots among them."""
    end = float(motion.times[-1])
    every = np.arange(time, end, _STEP)
    knots = motion.times if motion.curve is None else motion.curve.times
    places = np.union1d(every, knots[(knots > time) & (knots <= end)])
    is_apart = np.diff(places, prepend=-np.inf) > _SLOW
    return np.asarray(places[is_apart])


def _compute_accelerations(motion: Trajectory, places: Floats) -> tuple[Floats, Floats]:
    """Return the accelerations at begin and end of the parts between places, (K − 1, n) each.

    In a part without knots inside, the acceleration of a cubic is linear. It jumps at knots.
    """
    durations = np.diff(places)
    at_middle = motion.acceleration(places[:-1] + durations / 2.0)
    at_quarter = motion.acceleration(places[:-1] + durations / 4.0)
    change = 2.0 * (at_middle - at_quarter)
    return at_middle - change, at_middle + change


def _find_least(factors: Floats, offsets: Floats, limits: Floats) -> float:
    """Return the least u ≤ 0 with |factor·u + offset| ≤ limit for all of m rows, shape (m,)."""
    counts = (np.abs(factors) > _SLOW) & np.isfinite(limits)
    # Where the factor is positive, u ≥ -(limit + offset)/factor, else u ≥ (limit - offset)/factor.
    along = offsets[counts] * np.sign(factors[counts])
    lowest = -(limits[counts] + along) / np.abs(factors[counts])
    return float(min(lowest.max(initial=-np.inf), 0.0))


def _run_through(
    motion: Trajectory, clocks: Floats, rates: Floats, offset: Floats, slope: Floats
) -> Trajectory:
    """Return a motion that has the given clocks τ and rates r at its knots.

    It is displaced by an offset that grows with the slope from the first clock on, shape (n,).
    """
    is_resting = len(clocks) == 1 or not motion.velocity(clocks[0]).any()
    if is_resting:
        clocks = np.repeat(clocks[:1], 2)
        rates = np.zeros(2)
        durations = np.array([_REST])
    else:
        durations = 2.0 * np.diff(clocks) / (rates[1:] + rates[:-1])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    positions = motion.at(clocks) + offset + (clocks - clocks[0])[:, None] * slope
    velocities = rates[:, None] * (motion.velocity(clocks) + slope)
    curve = Curve(times, positions, velocities)
    spans = _split_into_phases(motion, clocks)
    return Trajectory(motion.names, times, positions, spans, motion.robot_size, curve)


def _split_into_phases(motion: Trajectory, clocks: Floats) -> tuple[PhaseSpan, ...]:
    """Return the phases of a motion as spans of rows at its times `clocks`."""
    end = len(clocks) - 1
    current = motion.phases.index(find_phase_at(motion, float(clocks[0])))
    spans = list[PhaseSpan]()
    first = 0
    for phase in motion.phases[current:]:
        last = int(np.searchsorted(clocks, motion.times[phase.last]))
        if first < last < end:
            spans.append(replace(phase, first=first, last=last))
            first = last
        elif last >= end or not spans:  # in a pause for the gripper, the phase before it goes on
            spans.append(replace(phase, first=first, last=end))
            break
    return tuple(spans)


def list_steps_of_stop(scene: Scene, motion: Trajectory) -> tuple[Step, ...]:
    """Return the steps that a braking motion carries out: it ends where it ends.

    Joints of an object in the hand that is fixed in the world move with it; else the robot's joints
    reach their last values.
    """
    last = dict(zip(motion.names, motion.positions[-1].tolist(), strict=True))
    for hold in motion.phases[-1].holds:
        placed = scene.objects[hold.object]
        values = {}
        for joint in placed.object.coordinates.names:
            coordinate = f"{hold.object}.{joint}"
            if coordinate in last:
                values[joint] = last[coordinate]
        if values and not placed.object.free:
            return (Actuate(hold.object, values, hold.attachment),)
    return (Configure({name: last[name] for name in scene.robot.coordinates.names}),)
