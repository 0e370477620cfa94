"""Validates a motion independently of the planner, continuously in time.

It shares no code with the optimizer. Kinematics are computed numerically by Pinocchio on a plain
tree of robot and objects (`world`). coal measures every pair that could come close, at samples at
most 5 mm and 0.01 rad apart, and at finer ones where a collision could hide between two samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.clearance import ClearanceCheck, ClearanceResult
from vkc_pin.validation.closure import find_drift
from vkc_pin.validation.contact_windows import check_gripper, check_pushes
from vkc_pin.validation.goals import MOTION_TOLERANCE, check_goals, check_steps
from vkc_pin.validation.limits import MotorLoads, check_rates, check_rolling
from vkc_pin.validation.loads import check_loads
from vkc_pin.validation.report import Report, Violation, select_worst
from vkc_pin.validation.samples import MAX_SAMPLES, Samples
from vkc_pin.validation.terms import check_terms
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.articulated_object import Latch
from vkc_pin.world.models.shapes import START_SLACK
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import MAX_TILT, compute_tilt
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, trace_terms
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

# difference from the scene's start [m] or [rad]
START_TOLERANCE = 1e-9
# excess over a position limit [m] or [rad]
LIMIT_TOLERANCE = 1e-5
# displacement of a latched joint, and shortfall of the releasing one [m] or [rad]
LATCH_TOLERANCE = 1e-4
# smaller displacements of a latched joint are rounding errors [m] or [rad]
_LATCH_ROUNDING = 1e-12


def validate(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    options: Options | None = None,
    terms: Sequence[Term] = (),
    *,
    tolerances: Tolerances | None = None,
) -> Report:
    """Check a motion against its scene, steps and user terms.

    Args:
        scene: Scene of the motion. The motion must begin at the scene's start.
        steps: Steps that the motion must carry out, in this order.
        trajectory: Motion, along its curve or linear between waypoints.
        options: Clearances and durations to keep. Default: `Options()`.
        terms: User terms. Constraints are checked, costs are ignored.
        tolerances: Accepted errors of grasps and goals. Default: `Tolerances()`.

    Returns:
        Report of all violated constraints: start; limits of position, velocity, acceleration, jerk
        and torque; slip, turning radius and wheel speed of the base; grasp closure; latches; rests
        for the gripper and its opening; undriven joints of objects; tilt of supporting links;
        sliding of firm grasps; pushes that would have to pull; released objects that fall or tip
        over; the robot's payload; goals and their order; clearance at
        waypoints; penetration anywhere; user constraints. A motion too long to be sampled is
        reported as such.

    Raises:
        InputError: The trajectory does not belong to the scene's robot and objects.
        UnknownNameError: A step or term names something that does not exist.
    """
    options = Options() if options is None else check_instance(options, Options, "options")
    tolerances = Tolerances() if tolerances is None else tolerances
    check_instance(tolerances, Tolerances, "tolerances")
    samples, asked, traced = check_arguments(scene, steps, trajectory, terms)
    motors = MotorLoads(samples)
    violations = [
        *_check_start(samples),
        *_check_limits(samples),
        *_check_undriven_joints(samples),
        *_check_tilt(samples),
        *_check_latches(samples),
        *check_rates(samples, asked, options),
        *check_rolling(samples),
        *check_goals(samples, asked, tolerances),
        *check_terms(samples, traced),
        *check_gripper(samples, options),
        *check_pushes(samples),
        *motors.find_violations(),
    ]
    loads = check_loads(samples, asked, options, tolerances)
    violations += loads.violations
    drift = _check_closure(samples, tolerances, violations)
    violations += _check_firm_grasps(samples)
    excess = list(_check_sample_count(samples))
    if excess:
        violations += excess
        clearance = ClearanceResult(samples)
    else:
        clearance = ClearanceCheck(samples, asked, options, tolerances).check_all()
        violations += clearance.violations
    motor_fields = motors.summarize(options.jerk_time)
    return Report(
        select_worst(violations),
        float(min(clearance.smallest)),
        closure_error=float(drift[0]),
        closure_angle=float(drift[1]),
        clearances=tuple(clearance.smallest.tolist()),
        states=len(samples.times),
        exemptions=tuple(clearance.exemptions.values()),
        allowed=loads.allowed,
        **motor_fields,
    )


def check_arguments(
    scene: Scene, steps: Sequence[Step], trajectory: Trajectory, terms: Sequence[Term] = ()
) -> tuple[Samples, tuple[Step, ...], tuple[Term, ...]]:
    """Check the arguments of `validate` and prepare them; raises what `validate` raises."""
    check_instance(scene, Scene, "scene")
    samples = Samples(scene, check_instance(trajectory, Trajectory, "trajectory"))
    asked = as_steps(steps)
    check_steps(samples, asked)
    return samples, asked, trace_terms(scene, terms)


def _check_sample_count(samples: Samples) -> Iterator[Violation]:
    """Yield a violation if the motion is too long to be checked for collisions."""
    motion = samples.trajectory
    required = samples.required_count
    most = max(MAX_SAMPLES, len(motion.times))
    if required > most:
        detail = f"{required:.3g} samples are required, more than {most}: collisions not checked"
        steps = np.abs(np.diff(motion.positions, axis=0)).max(axis=1)
        yield samples.make_violation(
            "sampling",
            "motion",
            required - most,
            "configurations",
            detail,
            waypoint=int(np.argmax(steps)),
        )


def _check_start(samples: Samples) -> Iterator[Violation]:
    """Check that a motion begins where the scene's robot and objects are."""
    motion = samples.trajectory
    world = samples.world
    start = dict(zip(world.coordinates.names, world.start, strict=True))
    for name, value in zip(motion.names, motion.positions[0], strict=True):
        expected = start.get(name, value)
        unit = samples.get_unit(name)
        difference = abs(value - expected)
        if not difference <= START_TOLERANCE:
            detail = f"{value:.6g} {unit} instead of {expected:.6g} {unit}"
            yield samples.make_violation("start", name, difference, unit, detail, waypoint=0)


def _check_limits(samples: Samples) -> Iterator[Violation]:
    """Check that every coordinate stays within its limits (eq. 4).

    A joint of the robot that starts outside may be as far outside as at the start until it is first
    inside, any other coordinate at the start alone.
    """
    motion = samples.trajectory
    all_low, all_high = samples.ranges
    for i, name in enumerate(motion.names):
        low = all_low[:, i]
        high = all_high[:, i]
        start = motion.positions[0, i]
        lower, upper, _, _ = samples.get_limits(name)
        start_excess = max(lower - start, start - upper)
        excess = np.maximum(lower - low, high - upper)  # in each segment
        if 0.0 < start_excess <= START_SLACK + START_TOLERANCE:
            entered = 0  # the segment at whose end the coordinate is first inside
            if i < motion.robot_size:
                is_inside = (motion.positions[1:, i] >= lower) & (motion.positions[1:, i] <= upper)
                entered = int(np.argmax(is_inside)) if is_inside.any() else len(excess)
            excess[: entered + 1] -= start_excess
        worst = int(np.argmax(excess))
        if not excess[worst] <= LIMIT_TOLERANCE:
            yield _make_limit_violation(samples, i, worst, (lower, upper))


def _make_limit_violation(
    samples: Samples, column: int, segment: int, limits: tuple[float, float]
) -> Violation:
    """Make the violation of a coordinate's position limits in a segment."""
    motion = samples.trajectory
    name = motion.names[column]
    unit = samples.get_unit(name)
    lower, upper = limits
    low, high = (float(side[segment, column]) for side in samples.ranges)
    low_excess = max(lower - low, low - upper)
    high_excess = max(lower - high, high - upper)
    if high_excess > low_excess:
        value = high
        amount = high_excess
    else:
        value = low
        amount = low_excess
    ends = motion.positions[segment : segment + 2, column]
    waypoint = segment + int(np.argmin(np.abs(ends - value)))
    span = f"{lower:.4f} to {upper:.4f} {unit}"
    detail = f"{value:.4f} {unit} is outside {span} by {amount:.4f} {unit}"
    return samples.make_violation("limit", name, amount, unit, detail, waypoint=waypoint)


def _check_tilt(samples: Samples) -> Iterator[Violation]:
    """Check that objects on moving links stay as upright as they were when last put down."""
    objects = samples.scene.objects
    phases = zip(samples.trajectory.phases, samples.free_objects.supports, strict=True)
    put_down: dict[str, pin.SE3] = {}
    for phase, supported in phases:
        put_down = {name: there for name, there in put_down.items() if name not in phase.held}
        rows = samples.get_rows(phase)
        for owner, label in supported.items():
            frame = f"{owner}.{objects[owner].object.base_link}"
            placements = samples.compute_placements(rows, frame)
            begin = put_down.setdefault(owner, placements[0])
            angles = np.array([compute_tilt(begin, placement) for placement in placements])
            worst = int(np.argmax(angles))
            angle = angles[worst]
            if not angle <= MAX_TILT:
                tilt = f"{angle:.2f} rad, more than {MAX_TILT:g} rad"
                detail = f"its support '{label}' tilts it by {tilt}, since it was put down"
                yield samples.make_violation(
                    "tips", owner, angle - MAX_TILT, "rad", detail, row=int(rows[worst])
                )


def _check_undriven_joints(samples: Samples) -> Iterator[Violation]:
    """Check that object joints that no hand drives do not move."""
    motion = samples.trajectory
    for phase in motion.phases:
        driven = samples.find_driven_coordinates(phase.holds)
        for name in motion.names[motion.robot_size :]:
            if name in driven or name in samples.grasp_freedoms:
                continue
            owner = name.partition(".")[0]
            why = "no hold drives it" if owner in phase.held else f"{owner} is not grasped"
            detail = f"moves by {{}} while {why}"
            yield from _check_stationary(samples, phase, "unheld", name, detail)


def _check_firm_grasps(samples: Samples) -> Iterator[Violation]:
    """Check that a firm grasp neither slides nor turns."""
    for phase in samples.trajectory.phases:
        for owner, attachment in phase.held.items():
            grasp = samples.scene.objects[owner].object.attachments[attachment]
            if not grasp.firm:
                continue
            detail = f"the hand moves on '{owner}' by {{}} while it clamps it"
            for name in grasp.coordinates:
                yield from _check_stationary(samples, phase, "slide", f"{owner}.{name}", detail)


def _check_stationary(
    samples: Samples, phase: PhaseSpan, kind: str, name: str, detail: str
) -> Iterator[Violation]:
    """Check that a coordinate is constant in a phase; the amount is inserted into `detail`."""
    column = samples.trajectory.names.index(name)
    begin = samples.trajectory.positions[phase.first, column]
    low, high = (side[phase.first : phase.last, column] for side in samples.ranges)
    moved = np.maximum(high - begin, begin - low)
    unit = samples.get_unit(name)
    worst = int(np.argmax(moved))
    if not moved[worst] <= MOTION_TOLERANCE:
        text = detail.format(f"{moved[worst]:.4f} {unit}")
        at = phase.first + worst + 1
        yield samples.make_violation(kind, name, moved[worst], unit, text, waypoint=at)


def _check_latches(samples: Samples) -> Iterator[Violation]:
    """Check that a latched joint leaves its latched position only while its latch is released."""
    for owner, placed in samples.scene.objects.items():
        for latch in placed.object.latches:
            yield from _check_latch(samples, owner, latch)


def _check_latch(samples: Samples, owner: str, latch: Latch) -> Iterator[Violation]:
    """Yield the worst violation of a latch.

    Between two samples both joints are linear in time. The shortfall of the releasing joint is
    therefore largest where the latched joint starts to move or leaves the latch's range. These two
    are fractions of the interval, `begin` and `end`.
    """
    z = samples.z
    coordinates = samples.world.coordinates
    name = f"{owner}.{latch.joint}"
    release = f"{owner}.{latch.released_by}"
    offset = z[:, coordinates.index(name)] - latch.held_at
    before = np.abs(offset[:-1])
    after = np.abs(offset[1:])
    crosses = offset[:-1] * offset[1:] < 0  # the latched position
    begin = np.where(crosses, before / np.where(crosses, before + after, 1.0), 0.0)
    begin_offset = np.where(crosses, 0.0, before)
    moves = (after > begin_offset + _LATCH_ROUNDING) & (after > LATCH_TOLERANCE)
    leaves = moves & (begin_offset <= latch.engaged_within)
    moved = np.where(leaves, after - begin_offset, 1.0)
    engaged = np.clip((latch.engaged_within - begin_offset) / moved, 0.0, 1.0)
    end = np.where(leaves, begin + engaged * (1 - begin), begin)
    releasing = z[:, coordinates.index(release)]
    change = np.diff(releasing)
    lowest = releasing[:-1] + np.minimum(begin * change, end * change)
    shortfall = np.where(leaves, latch.threshold - lowest, 0.0)
    row = int(np.argmax(shortfall))
    if not shortfall[row] <= LATCH_TOLERANCE:
        detail = (
            f"leaves {latch.held_at:g} while {latch.released_by} is at {lowest[row]:.3f}, "
            f"{shortfall[row]:.3f} short of {latch.threshold:g}"
        )
        unit = samples.get_unit(release)
        yield samples.make_violation("latch", name, shortfall[row], unit, detail, row=row)


def _check_closure(samples: Samples, tolerances: Tolerances, violations: list[Violation]) -> Floats:
    """Add violations of grasp closure (eq. 2); return the largest drift, [m] and [rad]."""
    largest = np.zeros(2)
    limits = (tolerances.closure_position, tolerances.closure_angle)
    for phase in samples.trajectory.phases:
        for hold in phase.holds:
            drift = find_drift(samples, phase, hold, limits)
            largest = np.maximum(largest, drift.measured)
            parts = zip(*drift, limits, ("m", "rad"), strict=True)
            for measured, bound, time, limit, unit in parts:
                if bound <= limit:
                    continue
                amount = measured if measured > limit else bound
                excess = f"{1e3 * amount:.3f} m{unit}, more than {1e3 * limit:g} m{unit}"
                violations.append(
                    samples.make_violation(
                        "closure",
                        f"{hold.object}.{hold.attachment}",
                        amount - limit,
                        unit,
                        f"the grasp drifts by {excess}",
                        time=time,
                    )
                )
    return largest
