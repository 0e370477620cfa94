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
# [s]; shorter intervals are not bisected
_SHORTEST_INTERVAL = 1e-12


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
    moves_rigidly = samples.scene.objects[hold.object].object.free
    if moves_rigidly or samples.is_truncated:
        largest = errors.max(axis=0)
        return Drift(largest, largest, times[errors.argmax(axis=0)])
    hand = _find_hand_levers(samples, phase, hold)
    grasp = _find_grasp_levers(samples, hold)

    def bound_curvature(begin: Floats, end: Floats) -> Floats:
        speed, acceleration = _bound_rates(samples.trajectory, begin, end)
        of_hand = _bound_position_acceleration(hand, speed, acceleration)
        of_grasp = _bound_position_acceleration(grasp, speed, acceleration)
        rotation = _bound_rotation_acceleration([*hand, *grasp], speed, acceleration)
        return np.column_stack([of_hand + of_grasp, rotation])

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
    # One row an interval: its ends [s], and the errors there.
    begin = times[:-1]
    end = times[1:]
    left = errors[:-1]
    right = errors[1:]
    largest = errors.max(axis=0)
    when = times[errors.argmax(axis=0)]
    budget = MAX_SAMPLES
    while True:
        bulge = bound_curvature(begin, end) * ((end - begin) ** 2 / 8.0)[:, None]
        bound = np.maximum(left, right) + bulge
        bound[:, 1] = np.arcsin(np.minimum(bound[:, 1], 1.0))
        proven = largest + RESOLUTION * np.maximum(largest, 1.0)
        proven = np.maximum(proven, PROVEN_FRACTION * limits)
        is_open = (bound > proven).any(axis=1) & (end - begin > _SHORTEST_INTERVAL)
        undecided = np.flatnonzero(is_open)
        budget -= len(undecided)
        if not len(undecided) or budget < 0:
            break
        begin = begin[undecided]
        end = end[undecided]
        left = left[undecided]
        right = right[undecided]
        middle = (begin + end) / 2.0
        values = evaluate(middle)
        is_larger = values.max(axis=0) > largest
        when = np.where(is_larger, middle[values.argmax(axis=0)], when)
        largest = np.maximum(largest, values.max(axis=0))
        # Both halves of every interval, in the order of time.
        begins = np.concatenate([begin, middle])
        order = np.argsort(begins, kind="stable")
        begin = begins[order]
        end = np.concatenate([middle, end])[order]
        left = np.concatenate([left, values])[order]
        right = np.concatenate([values, right])[order]
    is_unproven = (largest <= limits) & (bound[undecided].max(axis=0, initial=0.0) > limits)
    if is_unproven.any():
        when = np.where(is_unproven, begin[bound.argmax(axis=0)], when)
    return Drift(largest, np.where(is_unproven, bound.max(axis=0), largest), when)


def _bound_rates(trajectory: Trajectory, begin: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Bound |velocity| and |acceleration| on N intervals between knots, shape (N, n) each.

    A cubic with slope s of its chord in a time h, and velocities v₀ and v₁ at its ends, has the
    accelerations (6 s − 4 v₀ − 2 v₁) / h and (−6 s + 2 v₀ + 4 v₁) / h there, and linear ones in
    between. Its velocity is a parabola, in the hull of its control points: both ends, and one more.
    """
    span = (end - begin)[:, None]
    slope = (trajectory.at(end) - trajectory.at(begin)) / span
    if trajectory.curve is None:
        return np.abs(slope), np.zeros_like(slope)
    first = trajectory.velocity(begin)
    last = trajectory.velocity(end)
    at_begin = (6.0 * slope - 4.0 * first - 2.0 * last) / span
    at_end = (-6.0 * slope + 2.0 * first + 4.0 * last) / span
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
    total = np.zeros(len(speed))
    turning = np.zeros(len(speed))  # sum of the angular velocities of earlier joints [rad/s]
    for lever in chain:
        v = lever.rate * speed[:, lever.column]
        a = lever.rate * acceleration[:, lever.column]
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
    turning = np.zeros(len(speed))
    change = np.zeros(len(speed))
    for lever in chain:
        if lever.is_revolute:
            turning += lever.rate * speed[:, lever.column]
            change += lever.rate * acceleration[:, lever.column]
    return np.asarray(change + 1.5 * turning**2)


def _find_hand_levers(samples: Samples, phase: PhaseSpan, hold: Hold) -> list[_Lever]:
    """Return the levers of the grasping frame, from the world on."""
    scene = samples.scene
    names = samples.trajectory.names
    hand_frame = compute_hand_frame(scene.robot, get_attachment(scene.objects, hold))
    reach = float(np.linalg.norm(hand_frame.translation))
    backwards: list[_Lever] = []
    frame = hold.frame
    through = hold.by
    # A link of a grasped object moves rigidly with the holder, except for the grasp's freedoms.
    while frame is not None and through is not None:
        reach += _find_max_distance(samples, phase, frame, through.frame or scene.robot.tool_frame)
        attachment = scene.objects[through.object].object.attachments[through.attachment]
        for suffix, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True):
            column = names.index(f"{through.object}.{suffix}")
            is_revolute = freedom.unit == "rad"
            arm = reach + float(np.linalg.norm(freedom.through)) if is_revolute else 1.0
            backwards.append(_Lever(column, 1.0, arm, is_revolute))
        frame = through.frame
        through = through.by
    return [*_find_levers(samples, scene.robot.tool_frame, reach), *reversed(backwards)]


def _find_max_distance(samples: Samples, phase: PhaseSpan, frame: str, other: str) -> float:
    """Return the largest distance of two frames' origins at the samples of a phase [m]."""
    rows = samples.get_rows(phase)
    placements = samples.compute_placements(rows, frame)
    others = samples.compute_placements(rows, other)
    distances = [
        float(np.linalg.norm(one.translation - another.translation))
        for one, another in zip(placements, others, strict=True)
    ]
    return max(distances)


def _find_grasp_levers(samples: Samples, hold: Hold) -> list[_Lever]:
    """Return the levers of the attachment's frame, from the world on."""
    names = samples.trajectory.names
    attachment = get_attachment(samples.scene.objects, hold)
    reach = float(np.linalg.norm(attachment.offset.translation))
    backwards: list[_Lever] = []
    freedoms = list(zip(attachment.coordinates, attachment.freedoms, strict=True))
    for suffix, freedom in reversed(freedoms):
        column = names.index(f"{hold.object}.{suffix}")
        if freedom.unit == "rad":
            through = float(np.linalg.norm(freedom.through))
            backwards.append(_Lever(column, 1.0, reach + through, is_revolute=True))
            reach += 2.0 * through
        else:
            _, upper = samples.trajectory.ranges()
            backwards.append(_Lever(column, 1.0, 1.0, is_revolute=False))
            reach += float(np.abs(upper[:, column]).max())
    reach += float(np.linalg.norm(attachment.placement.translation))
    of_link = _find_levers(samples, f"{hold.object}.{attachment.link}", reach)
    return [*of_link, *reversed(backwards)]


def _find_levers(samples: Samples, frame: str, reach: float) -> list[_Lever]:
    """Return the levers of a point within `reach` [m] of a frame's origin, from the world on."""
    names = samples.trajectory.names
    coordinates = samples.world.coordinates
    model = samples.world.model
    body = model.frames[model.getFrameId(frame)]
    reach += float(np.linalg.norm(body.placement.translation))
    joint = int(body.parentJoint)
    backwards: list[_Lever] = []
    while joint:
        moves = [move for move in coordinates.moves if move.joint == joint]
        for move in reversed(moves):
            name = coordinates.names[move.coordinate]
            if name in names:
                arm = 1.0 if move.slides else reach
                lever = _Lever(names.index(name), abs(move.factor), arm, not move.slides)
                backwards.append(lever)
            if move.slides and joint != 1:
                travel = np.abs(move.factor * samples.z[:, move.coordinate] + move.offset)
                reach += float(travel.max()) + LENGTH_STEP
        reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = int(model.parents[joint])
    return backwards[::-1]
