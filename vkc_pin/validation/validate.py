"""Validates a motion independently of the planner, continuously in time.

It shares no code with the optimizer. Kinematics are computed numerically by Pinocchio on a plain
tree of robot and objects (`world`). coal measures every pair that could come close, at samples at
most 5 mm and 0.01 rad apart, and at finer ones where a collision could hide between two samples.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.closure import find_drift
from vkc_pin.validation.collisions import Hit, PairTable, sweep
from vkc_pin.validation.contact_windows import check_gripper, check_pushes, find_contact_windows
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.goals import MOTION_TOLERANCE, check_goals, check_steps
from vkc_pin.validation.limits import MotorLoads, check_rates, check_rolling
from vkc_pin.validation.loads import check_loads
from vkc_pin.validation.neighbours import ExemptPairs, find_exempt_pairs
from vkc_pin.validation.report import Exemption, Report, Violation
from vkc_pin.validation.samples import MAX_SAMPLES, Samples
from vkc_pin.validation.terms import check_terms
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.shapes import START_SLACK
from vkc_pin.world.scene.clearance_exemptions import ACCEPTED_SHORTFALL, CONTACT_DEPTH
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import MAX_TILT, compute_tilt
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, trace_terms
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

START_TOLERANCE = 1e-9  # difference from the scene's start [m] or [rad]
LIMIT_TOLERANCE = 1e-5  # excess over a position limit [m] or [rad]
LATCH_TOLERANCE = 1e-4


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
        *check_rates(samples, options),
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
    clearances = np.full(len(trajectory.phases), np.inf)
    exemptions: dict[tuple[str, str], Exemption] = {}
    if excess := list(_check_sample_count(samples)):
        violations += excess
    else:
        solids = CollisionShapes(samples.world)
        windows = find_contact_windows(samples, solids, asked, options, tolerances)
        pairs = PairTable(
            scene,
            solids,
            trajectory,
            options.dist_safe,
            options.self_distance,
            windows=windows,
            samples=samples,
        )
        _check_clearance(pairs, samples, options, violations, clearances, exemptions)
    return Report(
        _select_worst(violations),
        float(min(clearances)),
        closure_error=float(drift[0]),
        closure_angle=float(drift[1]),
        clearances=tuple(clearances.tolist()),
        states=len(samples.times),
        exemptions=tuple(exemptions.values()),
        allowed=loads.allowed,
        **motors.summarize(options.jerk_time),
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


def _select_worst(violations: Sequence[Violation]) -> tuple[Violation, ...]:
    """Return the worst violation of each constraint, subject and unit, in order of time."""
    worst: dict[tuple[str, str, str], Violation] = {}
    for violation in violations:
        key = (violation.constraint, violation.subject, violation.unit)
        if key not in worst or worst[key].amount < violation.amount:
            worst[key] = violation
    for violation in violations:  # a penetration implies a clearance violation
        if violation.constraint == "penetration":
            worst.pop(("clearance", violation.subject, violation.unit), None)
    return tuple(sorted(worst.values(), key=lambda v: (v.time, v.constraint, v.subject, v.unit)))


def _check_sample_count(samples: Samples) -> Iterator[Violation]:
    """Yield a violation if the motion is too long to be checked for collisions."""
    motion, needed = samples.trajectory, samples.required_count
    most = max(MAX_SAMPLES, len(motion.times))
    if needed > most:
        detail = f"{needed:.3g} samples are required, more than {most}: collisions not checked"
        step = int(np.argmax(np.abs(np.diff(motion.positions, axis=0)).max(axis=1)))
        yield samples.make_violation(
            "sampling", "motion", needed - most, "configurations", detail, waypoint=step
        )


def _check_start(samples: Samples) -> Iterator[Violation]:
    motion, world = samples.trajectory, samples.world
    known = dict(zip(world.coordinates.names, world.start, strict=True))
    for name, value in zip(motion.names, motion.positions[0], strict=True):
        right, unit = known.get(name, value), samples.get_unit(name)
        if not abs(value - right) <= START_TOLERANCE:
            detail = f"{value:.6g} {unit} instead of {right:.6g} {unit}"
            yield samples.make_violation(
                "start", name, abs(value - right), unit, detail, waypoint=0
            )


def _check_limits(samples: Samples) -> Iterator[Violation]:
    """Check that every coordinate stays within its limits (eq. 4).

    A joint of the robot that starts outside may be as far outside as at the start until it is first
    inside, any other coordinate at the start alone.
    """
    motion = samples.trajectory
    for i, name in enumerate(motion.names):
        (low, high), start = (side[:, i] for side in samples.ranges), motion.positions[0, i]
        lower, upper, _, _ = samples.get_limits(name)
        begin = max(lower - start, start - upper)
        excess = np.maximum(lower - low, high - upper)
        if 0.0 < begin <= START_SLACK + START_TOLERANCE:
            is_inside = (motion.positions[1:, i] >= lower) & (motion.positions[1:, i] <= upper)
            if i >= motion.robot_size:
                entered = 0
            else:
                entered = int(np.argmax(is_inside)) if is_inside.any() else len(excess)
            excess[: entered + 1] -= begin
        worst = int(np.argmax(excess))
        if not excess[worst] <= LIMIT_TOLERANCE:
            value = float(max(low[worst], high[worst], key=lambda v: max(lower - v, v - upper)))
            out, unit = max(lower - value, value - upper), samples.get_unit(name)
            at = worst + int(np.argmin(np.abs(motion.positions[worst : worst + 2, i] - value)))
            limits = f"{lower:.4f} to {upper:.4f} {unit}"
            detail = f"{value:.4f} {unit} is outside {limits} by {out:.4f} {unit}"
            yield samples.make_violation("limit", name, out, unit, detail, waypoint=at)


def _check_tilt(samples: Samples) -> Iterator[Violation]:
    """Check that objects on moving links stay as upright as they were when last put down."""
    phases, objects = samples.trajectory.phases, samples.scene.objects
    put_down: dict[str, pin.SE3] = {}
    for phase, supported in zip(phases, samples.free_objects.supports, strict=True):
        put_down = {name: there for name, there in put_down.items() if name not in phase.held}
        rows = samples.get_rows(phase)
        for owner, label in supported.items():
            frame = f"{owner}.{objects[owner].object.base_link}"
            placements = samples.compute_placements(rows, frame)
            begin = put_down.setdefault(owner, placements[0])
            angles = np.array([compute_tilt(begin, placement) for placement in placements])
            worst = int(np.argmax(angles))
            if not angles[worst] <= MAX_TILT:
                angle = f"{angles[worst]:.2f} rad, more than {MAX_TILT:g} rad"
                detail = f"its support '{label}' tilts it by {angle}, since it was put down"
                yield samples.make_violation(
                    "tips", owner, angles[worst] - MAX_TILT, "rad", detail, row=int(rows[worst])
                )


def _check_undriven_joints(samples: Samples) -> Iterator[Violation]:
    """Check that object joints that no hand drives do not move."""
    motion = samples.trajectory
    for phase in motion.phases:
        driven = samples.find_driven_coordinates(phase.holds) | samples.grasp_freedoms.keys()
        for name in motion.names[motion.robot_size :]:
            if name not in driven:
                owner = name.partition(".")[0]
                why = "no hold drives it" if owner in phase.held else f"{owner} is not grasped"
                yield from _check_stationary(
                    samples, phase, "unheld", name, f"moves by {{}} while {why}"
                )


def _check_firm_grasps(samples: Samples) -> Iterator[Violation]:
    """Check that a firm grasp neither slides nor turns."""
    for phase in samples.trajectory.phases:
        for owner, attachment in phase.held.items():
            grasp = samples.scene.objects[owner].object.attachments[attachment]
            detail = f"the hand moves on '{owner}' by {{}} while it clamps it"
            for name in grasp.coordinates if grasp.firm else ():
                yield from _check_stationary(samples, phase, "slide", f"{owner}.{name}", detail)


def _check_stationary(
    samples: Samples, phase: PhaseSpan, kind: str, name: str, detail: str
) -> Iterator[Violation]:
    """Check that a coordinate is constant in a phase; the amount is inserted into `detail`."""
    column = samples.trajectory.names.index(name)
    begin = samples.trajectory.positions[phase.first, column]
    low, high = (side[phase.first : phase.last, column] for side in samples.ranges)
    moved, unit = np.maximum(high - begin, begin - low), samples.get_unit(name)
    worst = int(np.argmax(moved))
    if not moved[worst] <= MOTION_TOLERANCE:
        text = detail.format(f"{moved[worst]:.4f} {unit}")
        at = phase.first + worst + 1
        yield samples.make_violation(kind, name, moved[worst], unit, text, waypoint=at)


def _check_latches(samples: Samples) -> Iterator[Violation]:
    """Check that a latched joint leaves its latched position only while its latch is released.

    Between two samples both joints are linear in time. The shortfall of the releasing joint is
    therefore largest where the latched joint starts to move or leaves the latch's range.
    """
    z, names = samples.z, samples.world.coordinates
    for owner, placed in samples.scene.objects.items():
        for latch in placed.object.latches:
            name, release = f"{owner}.{latch.joint}", f"{owner}.{latch.released_by}"
            off = z[:, names.index(name)] - latch.held_at
            before, after = np.abs(off[:-1]), np.abs(off[1:])
            crossed = off[:-1] * off[1:] < 0  # passes the latched position
            begin = np.where(crossed, before / np.where(crossed, before + after, 1.0), 0.0)
            reach = np.where(crossed, 0.0, before)
            moves = (after > reach + 1e-12) & (after > LATCH_TOLERANCE)
            leaves = moves & (reach <= latch.engaged_within)
            share = (latch.engaged_within - reach) / np.where(leaves, after - reach, 1.0)
            end = np.where(leaves, begin + np.clip(share, 0.0, 1.0) * (1 - begin), begin)
            value, change = z[:-1, names.index(release)], np.diff(z[:, names.index(release)])
            lowest = value + np.minimum(begin * change, end * change)
            short = np.where(leaves, latch.threshold - lowest, 0.0)
            row = int(np.argmax(short))
            if not short[row] <= LATCH_TOLERANCE:
                detail = (
                    f"leaves {latch.held_at:g} while {latch.released_by} is at {lowest[row]:.3f}, "
                    f"{short[row]:.3f} short of {latch.threshold:g}"
                )
                unit = samples.get_unit(release)
                yield samples.make_violation("latch", name, short[row], unit, detail, row=row)


def _check_closure(samples: Samples, tolerances: Tolerances, violations: list[Violation]) -> Floats:
    """Add violations of grasp closure (eq. 2); return the largest drift, [m] and [rad]."""
    largest, limits = np.zeros(2), (tolerances.closure_position, tolerances.closure_angle)
    for phase in samples.trajectory.phases:
        for hold in phase.holds:
            drift = find_drift(samples, phase, hold, limits)
            largest = np.maximum(largest, drift.measured)
            for found, bound, time, limit, unit in zip(*drift, limits, ("m", "rad"), strict=True):
                if not bound <= limit:
                    amount = found if found > limit else bound
                    excess = f"{1e3 * amount:.3f} m{unit}, more than {1e3 * limit:g} m{unit}"
                    detail = f"the grasp drifts by {excess}"
                    subject = f"{hold.object}.{hold.attachment}"
                    violations.append(
                        samples.make_violation(
                            "closure", subject, amount - limit, unit, detail, time=time
                        )
                    )
    return largest


def _check_clearance(
    pairs: PairTable,
    samples: Samples,
    options: Options,
    violations: list[Violation],
    nearest: Floats,
    exemptions: dict[tuple[str, str], Exemption],
) -> None:
    """Add violations of clearance at waypoints (eqs. 6 and 7) and penetrations anywhere.

    Pairs that move together are ignored. At the start the clearance may be violated, since the
    robot is already there, but nothing may penetrate. The smallest distance of each phase [m] goes
    to `nearest`, and used exemptions to `exemptions`.
    """
    lasts = [phase.last for phase in samples.trajectory.phases]
    exempt = dict[tuple[int, int], list[ExemptPairs]]()
    for one in find_exempt_pairs(samples.scene, pairs.solids, options.dist_safe):
        for first, second in one.pairs.tolist():
            exempt.setdefault((first, second), []).append(one)
    for hit in sweep(pairs, samples.z, samples.waypoint_rows):
        allowed = exempt.get(hit.shapes, ())
        # The exemption also covers the segment before it ends and the one after it begins.
        active = [one for one in allowed if one.are_active(samples.z[[hit.row]])[0]]
        tolerated = max([0.0, *(-one.margin for one in active)])
        overlap = max(hit.contact, CONTACT_DEPTH + tolerated if tolerated > 0.0 else 0.0)
        if hit.margin > -np.inf and not tolerated > 0.0:
            phase = bisect.bisect_left(lasts, samples.find_waypoint(hit.row))
            nearest[phase] = min(nearest[phase], hit.distance)
        is_checked, millimetres = hit.at_waypoint and hit.row > 0, 1e3 * abs(hit.distance)
        margin = min(hit.margin, -tolerated) if tolerated > 0.0 else hit.margin
        short = margin - ACCEPTED_SHORTFALL - hit.distance
        if hit.distance < -overlap:
            kind, amount, detail = "penetration", -hit.distance, f"overlap by {millimetres:.1f} mm"
        elif is_checked and short > 0.0:
            required = f"{1e3 * hit.margin:.0f} mm are required"
            kind, amount = "clearance", short
            detail = f"are only {millimetres:.1f} mm apart, {required}"
        else:
            if hit.distance < -CONTACT_DEPTH or (
                is_checked and hit.distance < hit.exempt_clearance - ACCEPTED_SHORTFALL
            ):
                _record_exemption(exemptions, hit, allowed)
            continue
        subject = f"{hit.first} – {hit.second}"
        violations.append(samples.make_violation(kind, subject, amount, "m", detail, row=hit.row))


def _record_exemption(
    exemptions: dict[tuple[str, str], Exemption], hit: Hit, allowed: Sequence[ExemptPairs]
) -> None:
    """Record the smallest distance of a pair that used its exemption."""
    known = exemptions.get((hit.first, hit.second))
    if known is not None and known.distance <= hit.distance:
        return
    reason = allowed[0].reason if allowed else "no deeper than the object at the start"
    subject = f"{hit.first} – {hit.second}"
    exemptions[hit.first, hit.second] = Exemption(subject, hit.distance, reason)
