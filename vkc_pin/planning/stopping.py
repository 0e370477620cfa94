"""Brakes on the path of a planned motion."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from vkc_pin.options import Options
from vkc_pin.planning.retiming.limits import Limits
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Configure, Step
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import find_phase_at

_STEP = 5e-3  # [s] of the motion's time between knots of the braking motion
# Share of the acceleration limits that is used: between knots, a cubic may exceed what it has
# there a little.
_SHARE = 0.97
_SLOW = 1e-9  # [m/s] or [rad/s] below which a coordinate does not bound the braking
_REST = 2e-3  # [s], duration of a stop of a motion that rests already


def brake(scene: Scene, motion: Trajectory, time: float, options: Options) -> Trajectory:
    """Return a motion along a path that comes to rest as soon as possible.

    The motion q(τ) is run through by a clock τ(t) whose rate r = dτ/dt falls from 1 to 0:

        dq/dt = r q'(τ),    d²q/dt² = r² q''(τ) + u q'(τ),    u = d²τ/dt² = ½ d(r²)/dτ

    From one knot to the next, u is constant. It is the least value at which no coordinate exceeds
    its acceleration limit at either. As the motion keeps its limits at r = 1, u = 0 does at every
    r ≤ 1, so that there always is one.

    Args:
        scene: Scene of the motion.
        motion: Smooth motion within the limits.
        time: Time at which braking begins [s].
        options: Options of planning.

    Returns:
        The motion from `time` on, which counts from 0.
    """
    limits = Limits.from_scene(scene, motion.names, options.jerk_time)
    limit = _SHARE * limits.acceleration
    clocks = [time]
    squares = [1.0]  # of the rate r
    for first, last in itertools.pairwise(_choose_places(motion, time)):
        braking = _find_strongest_braking(motion, first, last, squares[-1], limit)
        square = squares[-1] + 2.0 * braking * (last - first)
        if square <= 0.0:
            clocks.append(first + min(-squares[-1] / (2.0 * braking), last - first))
            squares.append(0.0)
            break
        clocks.append(last)
        squares.append(square)
    return _run_through(motion, np.array(clocks), np.sqrt(squares))


def _choose_places(motion: Trajectory, time: float) -> Floats:
    """Return times of a motion from `time` to its end, with all its knots among them."""
    end = float(motion.times[-1])
    every = np.arange(time, end, _STEP)
    knots = motion.times if motion.curve is None else motion.curve.times
    places = np.union1d(every, knots[(knots > time) & (knots <= end)])
    is_apart = np.diff(places, prepend=-np.inf) > _SLOW
    return np.asarray(places[is_apart])


def _find_strongest_braking(
    motion: Trajectory, first: float, last: float, square: float, limit: Floats
) -> float:
    """Return the least u ≤ 0 with |r² q'' + u q'| ≤ limit at both ends of a part of a motion.

    At the end, r² has become `square` + 2 u (last - first), so that this is linear in u there, too.

    Args:
        motion: The motion.
        first: Begin of the part [s].
        last: End of the part [s]; there is no knot in between.
        square: r² at its begin.
        limit: Largest accelerations, shape (n,).
    """
    middle = (first + last) / 2.0
    duration = last - first
    # The acceleration of a cubic is linear, and jumps at knots.
    at_middle = motion.acceleration(middle)
    slope = (motion.acceleration(first + duration / 4.0) - at_middle) * -4.0 / duration
    begin = at_middle - slope * duration / 2.0
    end = at_middle + slope * duration / 2.0
    factors = np.concatenate([motion.velocity(first), motion.velocity(last) + 2 * duration * end])
    offsets = square * np.concatenate([begin, end])
    both_limits = np.concatenate([limit, limit])
    bounds_u = (np.abs(factors) > _SLOW) & np.isfinite(both_limits)
    # Where the factor f is positive, u ≥ -(limit + offset) / f, else u ≥ (limit - offset) / f.
    along = offsets[bounds_u] * np.sign(factors[bounds_u])
    lowest = -(both_limits[bounds_u] + along) / np.abs(factors[bounds_u])
    return float(min(lowest.max(initial=-np.inf), 0.0))


def _run_through(motion: Trajectory, clocks: Floats, rates: Floats) -> Trajectory:
    """Return a motion that has the given clocks τ and rates r at its knots."""
    is_resting = len(clocks) == 1 or not motion.velocity(clocks[0]).any()
    if is_resting:
        clocks = np.repeat(clocks[:1], 2)
        rates = np.zeros(2)
        durations = np.array([_REST])
    else:
        durations = 2.0 * np.diff(clocks) / (rates[1:] + rates[:-1])
    times = np.concatenate([[0.0], np.cumsum(durations)])
    positions = motion.at(clocks)
    curve = Curve(times, positions, rates[:, None] * motion.velocity(clocks))
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
