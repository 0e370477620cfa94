"""Bounds the drift of grasps continuously along a motion.

A position error e(t) between times t₀ and t₁ differs from its linear interpolation by at most
(t₁ − t₀)²/8 · max |ë|. A bound of |ë| follows from the coordinates' velocities and accelerations,
which are polynomials, and from the lever arms of the joints. Where this bound does not prove that
the error is small enough, the interval is bisected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.samples import LENGTH_STEP, MAX_SAMPLES, Samples
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

RESOLUTION = 1e-6
"""Accuracy of a maximum: absolute up to 1 m or 1 rad, relative beyond."""
PROVEN_FRACTION = 0.5
"""Fraction of a limit below which errors are only bounded, and not maximized."""


class Drift(NamedTuple):
    """The largest error of a grasp in a phase.

    Attributes:
        measured: Largest evaluated position error [m] and angle [rad], shape (2,).
        bound: `measured` where every error is proven to be within the limit, up to `RESOLUTION`;
            otherwise the proven bound, shape (2,).
        times: Times of the largest evaluated errors or, where only the bound exceeds the limit, of
            the largest bound, shape (2,) [s].
    """

    measured: Floats
    bound: Floats
    times: Floats


class _Lever(NamedTuple):
    """The effect of a trajectory coordinate on a frame within `arm` [m] of its axis."""

    column: int
    rate: float
    arm: float
    is_revolute: bool


def find_drift(
    samples: Samples, phase: PhaseSpan, hold: Hold, limits: tuple[float, float]
) -> Drift:
    """Find the largest drift of a grasp in a phase; limits of position [m] and angle [rad]."""
    rows = samples.get_rows(phase)
    times = samples.times[rows]
    errors = samples.compute_grasp_errors(hold, rows)
    # A free object moves rigidly with the hand.
    if samples.scene.objects[hold.object].object.free or samples.is_truncated:
        return Drift(errors.max(axis=0), errors.max(axis=0), times[errors.argmax(axis=0)])
    hand, grasp = _find_hand_levers(samples, phase, hold), _find_grasp_levers(samples, hold)

    def bound_curvature(begin: Floats, end: Floats) -> Floats:
        speed, acceleration = _bound_rates(samples.trajectory, begin, end)
        position = sum(
            _bound_position_acceleration(chain, speed, acceleration) for chain in (hand, grasp)
        )
        return np.column_stack(
            [position, _bound_rotation_acceleration([*hand, *grasp], speed, acceleration)]
        )

    def evaluate(moments: Floats) -> Floats:
        return samples.compute_grasp_errors_at(hold, moments)

    return _maximize(times, errors, evaluate, bound_curvature, np.array(limits))


def _maximize(
    times: Floats,
    errors: Floats,
    evaluate: Callable[[Floats], Floats],
    bound_curvature: Callable[[Floats, Floats], Floats],
    limits: Floats,
) -> Drift:
    """Maximize position and angle errors by bisection (branch and bound).

    The errors at `times`, shape (K,), are `errors`, shape (K, 2); `evaluate` computes them at other
    times. `bound_curvature` bounds second derivatives of position and angle sine on intervals.
    """
    begin, end, left, right = times[:-1], times[1:], errors[:-1], errors[1:]
    found, when = errors.max(axis=0), times[errors.argmax(axis=0)]
    budget = MAX_SAMPLES
    while True:
        bound = (
            np.maximum(left, right)
            + bound_curvature(begin, end) * ((end - begin) ** 2 / 8.0)[:, None]
        )
        bound[:, 1] = np.arcsin(np.minimum(bound[:, 1], 1.0))
        proven = found + RESOLUTION * np.maximum(found, 1.0)
        proven = np.maximum(proven, PROVEN_FRACTION * limits)
        open_ = np.flatnonzero((bound > proven).any(axis=1) & (end - begin > 1e-12))
        if not len(open_) or (budget := budget - len(open_)) < 0:
            break
        begin, end, left, right = begin[open_], end[open_], left[open_], right[open_]
        middle = (begin + end) / 2.0
        values = evaluate(middle)
        better = values.max(axis=0) > found
        when = np.where(better, middle[values.argmax(axis=0)], when)
        found = np.maximum(found, values.max(axis=0))
        order = np.argsort(np.concatenate([begin, middle]), kind="stable")
        begin, end = np.concatenate([begin, middle])[order], np.concatenate([middle, end])[order]
        left, right = np.concatenate([left, values])[order], np.concatenate([values, right])[order]
    unproven = (found <= limits) & (bound[open_].max(axis=0, initial=0.0) > limits)
    if unproven.any():
        when = np.where(unproven, begin[bound.argmax(axis=0)], when)
    return Drift(found, np.where(unproven, bound.max(axis=0), found), when)


def _bound_rates(trajectory: Trajectory, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Bound |velocity| and |acceleration| on N intervals between knots, shape (N, n) each."""
    span = (end - begin)[:, None]
    slope = (trajectory.at(end) - trajectory.at(begin)) / span
    if trajectory.curve is None:
        return np.abs(slope), np.zeros_like(slope)
    first, last = trajectory.velocity(begin), trajectory.velocity(end)
    at_begin = (6.0 * slope - 4.0 * first - 2.0 * last) / span
    at_end = (-6.0 * slope + 2.0 * first + 4.0 * last) / span
    # The velocity is a parabola, in the hull of its control points: both ends, and this one.
    control = first + span * at_begin / 2.0
    speed = np.maximum.reduce([np.abs(first), np.abs(control), np.abs(last)])
    return speed, np.maximum(np.abs(at_begin), np.abs(at_end))


def _bound_position_acceleration(
    chain: Iterable[_Lever], speed: Floats, acceleration: Floats
) -> Floats:
    """Bound the acceleration of a frame's origin, shape (N,) [m/s²].

    With joints numbered from the world on, |∂²p/∂i∂j| is at most the arm of the later joint, and 0
    if the earlier joint is prismatic.
    """
    total, turning = np.zeros(len(speed)), np.zeros(len(speed))
    for lever in chain:
        v, a = lever.rate * speed[:, lever.column], lever.rate * acceleration[:, lever.column]
        own = v if lever.is_revolute else 0.0
        total += lever.arm * (a + v * (2.0 * turning + own))
        turning += own
    return total


def _bound_rotation_acceleration(
    chain: Iterable[_Lever], speed: Floats, acceleration: Floats
) -> Floats:
    """Bound the second derivative of the sine of the angle between two frames, shape (N,).

    The sine is the norm of the axial vector of the rotation R. With R̈ = ([ω̇] + [ω]²) R, the second
    derivative of that vector is at most |ω̇| + |ω|², where |ω| ≤ Σ|v| and |ω̇| ≤ Σ|a| + ½ (Σ|v|)².
    """
    turning, change = np.zeros(len(speed)), np.zeros(len(speed))
    for lever in chain:
        if lever.is_revolute:
            turning += lever.rate * speed[:, lever.column]
            change += lever.rate * acceleration[:, lever.column]
    return np.asarray(change + 1.5 * turning**2)


def _find_hand_levers(samples: Samples, phase: PhaseSpan, hold: Hold) -> list[_Lever]:
    """Return the levers of the grasping frame, from the world on."""
    scene = samples.scene
    tip = compute_hand_frame(scene.robot, get_attachment(scene.objects, hold))
    reach, backwards = float(np.linalg.norm(tip.translation)), list[_Lever]()
    frame, through = hold.frame, hold.by
    # A link of a grasped object moves rigidly with the holder, except for the grasp's freedoms.
    while frame is not None and through is not None:
        holder = through.frame or scene.robot.tool_frame
        ends = zip(
            *(
                samples.compute_placements(samples.get_rows(phase), name)
                for name in (frame, holder)
            ),
            strict=True,
        )
        reach += max(
            float(np.linalg.norm(one.translation - other.translation)) for one, other in ends
        )
        attachment = scene.objects[through.object].object.attachments[through.attachment]
        for suffix, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True):
            turns = freedom.unit == "rad"
            arm = reach + float(np.linalg.norm(freedom.through)) if turns else 1.0
            backwards.append(
                _Lever(
                    samples.trajectory.names.index(f"{through.object}.{suffix}"), 1.0, arm, turns
                )
            )
        frame, through = through.frame, through.by
    return [*_find_levers(samples, scene.robot.tool_frame, reach), *reversed(backwards)]


def _find_grasp_levers(samples: Samples, hold: Hold) -> list[_Lever]:
    """Return the levers of the attachment's frame, from the world on."""
    attachment = get_attachment(samples.scene.objects, hold)
    reach, backwards = float(np.linalg.norm(attachment.offset.translation)), list[_Lever]()
    for suffix, freedom in reversed(
        list(zip(attachment.coordinates, attachment.freedoms, strict=True))
    ):
        column = samples.trajectory.names.index(f"{hold.object}.{suffix}")
        if freedom.unit == "rad":
            through = float(np.linalg.norm(freedom.through))
            backwards.append(_Lever(column, 1.0, reach + through, is_revolute=True))
            reach += 2.0 * through
        else:
            backwards.append(_Lever(column, 1.0, 1.0, is_revolute=False))
            reach += float(np.abs(samples.trajectory.ranges()[1][:, column]).max())
    reach += float(np.linalg.norm(attachment.placement.translation))
    return [*_find_levers(samples, f"{hold.object}.{attachment.link}", reach), *reversed(backwards)]


def _find_levers(samples: Samples, frame: str, reach: float) -> list[_Lever]:
    """Return the levers of a point within `reach` [m] of a frame's origin, from the world on."""
    world, names = samples.world, samples.trajectory.names
    model, body = world.model, world.model.frames[world.model.getFrameId(frame)]
    reach += float(np.linalg.norm(body.placement.translation))
    joint, backwards = int(body.parentJoint), list[_Lever]()
    while joint:
        for move in reversed([move for move in world.coordinates.moves if move.joint == joint]):
            name, rate = world.coordinates.names[move.coordinate], abs(move.factor)
            if name in names:
                backwards.append(
                    _Lever(names.index(name), rate, 1.0 if move.slides else reach, not move.slides)
                )
            if move.slides and joint != 1:
                travel = np.abs(move.factor * samples.z[:, move.coordinate] + move.offset)
                reach += float(travel.max()) + LENGTH_STEP
        reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = int(model.parents[joint])
    return backwards[::-1]
