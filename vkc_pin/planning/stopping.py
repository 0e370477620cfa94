"""Brakes on the path of a planned motion."""

from __future__ import annotations

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

_TICK = 2e-3  # [s] between knots of the braking motion
# Share of the acceleration limits that is used: between knots, a cubic may exceed what it has
# there by a few per cent.
_SHARE = 0.9
_SLOW = 1e-9  # [m/s] or [rad/s] below which a coordinate does not bound the braking


def brake(scene: Scene, motion: Trajectory, time: float, options: Options) -> Trajectory:
    """Return a motion along a path that comes to rest as soon as possible.

    The motion q(τ) is run through by a clock τ(t) whose rate r = dτ/dt falls from 1 to 0:

        dq/dt = r q'(τ),    d²q/dt² = r² q''(τ) + r' q'(τ)

    At every tick, r' is the least value at which no coordinate exceeds its acceleration limit. As
    the motion keeps its limits at r = 1, r' = 0 does at r ≤ 1, so that there always is one.

    Args:
        scene: Scene of the motion.
        motion: Smooth motion within the limits.
        time: Time at which braking begins [s].
        options: Options of planning.

    Returns:
        The motion from `time` on, which counts from 0.
    """
    acceleration = _SHARE * Limits.from_scene(scene, motion.names, options.jerk_time).acceleration
    clocks = [float(time)]
    rates = [1.0]
    while rates[-1] > 0.0:
        clock, rate = clocks[-1], rates[-1]
        velocity = motion.velocity(clock)
        curvature = rate**2 * motion.acceleration(clock)
        slowing = _find_strongest_braking(velocity, curvature, acceleration)
        next_rate = max(rate + _TICK * slowing, 0.0)
        clocks.append(min(clock + _TICK * (rate + next_rate) / 2.0, float(motion.times[-1])))
        rates.append(next_rate)
    return _run_through(motion, np.array(clocks), np.array(rates))


def _find_strongest_braking(velocity: Floats, curvature: Floats, limit: Floats) -> float:
    """Return the least r' ≤ 0 with |r² q'' + r' q'| ≤ limit.

    Args:
        velocity: q', shape (n,).
        curvature: r² q'', shape (n,).
        limit: Largest accelerations, shape (n,).
    """
    moves = (np.abs(velocity) > _SLOW) & np.isfinite(limit)
    speed = np.abs(velocity[moves])
    # Along the direction of its motion, a coordinate has r² q'' sign(q') + r' |q'|.
    along = curvature[moves] * np.sign(velocity[moves])
    bounds = -(limit[moves] + along) / speed
    return float(min(bounds.max(initial=-np.inf), 0.0))


def _run_through(motion: Trajectory, clocks: Floats, rates: Floats) -> Trajectory:
    """Return a motion that is at q(clocks) after every tick, with the velocities rates·q'."""
    times = _TICK * np.arange(len(clocks), dtype=float)
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
