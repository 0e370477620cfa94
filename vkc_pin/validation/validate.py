"""Validates a motion independently of the planner, continuously in time.

It shares no code with the optimizer. Kinematics are computed numerically by Pinocchio on a plain
tree of robot and objects (`world`). coal measures every pair that could come close, at samples at
most 5 mm and 0.01 rad apart, and at finer ones where a collision could hide between two samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.options import Options
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.closure import find_drift
from vkc_pin.validation.contact_windows import check_gripper, check_pushes, find_contact_windows
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.dynamics.rates import check_rates
from vkc_pin.validation.dynamics.torques import MotorLoads
from vkc_pin.validation.goals import MOTION_TOLERANCE, check_goals, check_steps
from vkc_pin.validation.pairs import PairTable
from vkc_pin.validation.report import Exemption, Report, Violation
from vkc_pin.validation.rolling import check_rolling
from vkc_pin.validation.samples import MAX_SAMPLES, Samples
from vkc_pin.validation.sweep import Hit, sweep
from vkc_pin.validation.terms import check_terms
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.scene.clearance_exemptions import (
    CONTACT_DEPTH,
    ClearanceExemption,
    find_clearance_exemptions,
)
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import MAX_TILT, compute_tilt
from vkc_pin.world.task.steps import Step, as_steps
from vkc_pin.world.task.terms import Term, trace_terms
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["check_arguments", "validate"]

START_TOLERANCE = 1e-9  # difference from the scene's start [m] or [rad]
LIMIT_TOLERANCE = 1e-5  # excess over a position limit [m] or [rad]
START_LIMIT_TOLERANCE = 1e-2  # accepted excess at the start, where the robot already is [m], [rad]
LATCH_TOLERANCE = 1e-4
WAYPOINT_TOLERANCE = 1e-3  # accepted shortfall of dist_safe at a waypoint [m]


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
        sliding of firm grasps; pushes that would have to pull; goals and their order; clearance at
        waypoints; penetration anywhere; user constraints. A motion too long to be sampled is
        reported as such.

    Raises:
        InputError: The trajectory does not belong to the scene's robot and objects.
        UnknownNameError: A step or term names something that does not exist.
    """
    options = Options() if options is None else check_instance(options, Options, "options")
    accepted = Tolerances()
    if tolerances is not None:
        accepted = check_instance(tolerances, Tolerances, "tolerances")
    arguments = check_arguments(scene, steps, trajectory, terms)
    return _Validator(*arguments, options, accepted).make_report()


def check_arguments(
    scene: Scene, steps: Sequence[Step], trajectory: Trajectory, terms: Sequence[Term] = ()
) -> tuple[Samples, tuple[Step, ...], tuple[Term, ...]]:
    """Check the arguments of `validate` and prepare them; raises what `validate` raises."""
    samples, asked = (
        Samples(
            check_instance(scene, Scene, "scene"),
            check_instance(trajectory, Trajectory, "trajectory"),
        ),
        as_steps(steps),
    )
    check_steps(samples, asked)
    return samples, asked, trace_terms(scene, terms)


class _Validator:
    def __init__(
        self,
        samples: Samples,
        steps: Sequence[Step],
        terms: Sequence[Term],
        options: Options,
        tolerances: Tolerances,
    ) -> None:
        self.tolerances = tolerances
        self.samples, self.steps, self.options, self.terms = samples, steps, options, terms
        self.scene, self.trajectory = samples.scene, samples.trajectory
        self.violations: list[Violation] = []
        self.exemptions: dict[tuple[str, str], Exemption] = {}
        self._ranges = samples.trajectory.ranges()

    def make_report(self) -> Report:
        """Run all checks and return the report."""
        for check in (
            self._check_start,
            self._check_limits,
            self._check_undriven_joints,
            self._check_tilt,
            self._check_latches,
        ):
            check()
        self.violations += check_rates(self.samples, self.options)
        self.violations += check_rolling(self.samples)
        self.violations += check_goals(self.samples, self.steps, self.tolerances)
        self.violations += check_terms(self.samples, self.terms)
        motors = MotorLoads(self.samples)
        self.violations += [
            *check_gripper(self.samples, self.options),
            *check_pushes(self.samples),
            *motors.find_violations(),
        ]
        error, angle = self._check_closure()
        self._check_firm_grasps()
        nearest = (
            self._check_clearance()
            if self._check_sample_count()
            else np.full(len(self.trajectory.phases), np.inf)
        )
        worst: dict[tuple[str, str, str], Violation] = {}
        for violation in self.violations:
            key = (violation.constraint, violation.subject, violation.unit)
            if key not in worst or worst[key].amount < violation.amount:
                worst[key] = violation
        for violation in self.violations:  # a penetration implies a clearance violation
            if violation.constraint == "penetration":
                worst.pop(("clearance", violation.subject, violation.unit), None)
        ordered = tuple(
            sorted(worst.values(), key=lambda v: (v.time, v.constraint, v.subject, v.unit))
        )
        close, facts = tuple(nearest.tolist()), motors.summarize(self.options.jerk_time)
        return Report(
            ordered,
            min(close),
            closure_error=error,
            closure_angle=angle,
            clearances=close,
            states=len(self.samples.times),
            exemptions=tuple(self.exemptions.values()),
            **facts,
        )

    def _add_violation(
        self,
        constraint: str,
        subject: str,
        amount: float,
        unit: str,
        detail: str,
        *,
        waypoint: int = 0,
        row: int | None = None,
        time: float | None = None,
    ) -> None:
        """Add a violation at a waypoint, at sample `row`, or at a time [s] after the waypoint."""
        at = waypoint if row is None else self.samples.find_waypoint(row)
        if time is None:
            time = self.trajectory.times[at] if row is None else self.samples.times[row]
        self.violations.append(
            Violation(
                constraint,
                subject,
                waypoint=int(at),
                time=float(time),
                amount=float(amount),
                unit=unit,
                detail=detail,
            )
        )

    def _check_sample_count(self) -> bool:
        """Return whether the motion is short enough to be checked for collisions."""
        needed, most = self.samples.required_count, max(MAX_SAMPLES, len(self.trajectory.times))
        if needed > most:
            detail = f"{needed:.3g} samples are required, more than {most}: collisions not checked"
            step = int(np.argmax(np.abs(np.diff(self.trajectory.positions, axis=0)).max(axis=1)))
            self._add_violation(
                "sampling", "motion", needed - most, "configurations", detail, waypoint=step
            )
        return needed <= most

    def _check_start(self) -> None:
        """Check that the motion begins at the scene's start."""
        known = dict(
            zip(self.samples.world.coordinates.names, self.samples.world.start, strict=True)
        )
        for name, value in zip(self.trajectory.names, self.trajectory.positions[0], strict=True):
            right, unit = known.get(name, value), self.samples.get_unit(name)
            if not abs(value - right) <= START_TOLERANCE:
                self._add_violation(
                    "start",
                    name,
                    abs(value - right),
                    unit,
                    f"{value:.6g} {unit} instead of {right:.6g} {unit}",
                )

    def _check_limits(self) -> None:
        """Check that every coordinate stays within its limits (eq. 4)."""
        ranges = zip(
            self.trajectory.names,
            self.trajectory.positions[0],
            *(side.T for side in self._ranges),
            strict=True,
        )
        for name, start, low, high in ranges:
            lower, upper, _, _ = self.samples.get_limits(name)
            most = max(lower - start, start - upper)
            excess = np.maximum(lower - low, high - upper)
            excess[0] -= (
                most if 0.0 < most <= START_LIMIT_TOLERANCE else 0.0
            )  # no further out than it begins
            worst = int(np.argmax(excess))
            if not excess[worst] <= LIMIT_TOLERANCE:
                unit, value = (
                    self.samples.get_unit(name),
                    float(max(low[worst], high[worst], key=lambda v: max(lower - v, v - upper))),
                )
                out, ends = (
                    max(lower - value, value - upper),
                    self.trajectory.column(name)[worst : worst + 2],
                )
                limits = f"{lower:.4f} to {upper:.4f} {unit}"
                detail = f"{value:.4f} {unit} is outside {limits} by {out:.4f} {unit}"
                self._add_violation(
                    "limit",
                    name,
                    out,
                    unit,
                    detail,
                    waypoint=worst + int(np.argmin(np.abs(ends - value))),
                )

    def _check_tilt(self) -> None:
        """Check that moving links that support an object stay level."""
        for phase, riding in zip(
            self.trajectory.phases, self.samples.free_objects.supports, strict=True
        ):
            rows = self.samples.get_rows(phase)
            for owner, label in riding.items():
                links = self.samples.compute_placements(rows, label)
                angles = np.array([compute_tilt(links[0], link) for link in links])
                worst = int(np.argmax(angles))
                if not angles[worst] <= MAX_TILT:
                    angle = f"{angles[worst]:.2f} rad, more than {MAX_TILT:g} rad"
                    detail = f"its support '{label}' tilts by {angle}"
                    self._add_violation(
                        "tips", owner, angles[worst] - MAX_TILT, "rad", detail, row=int(rows[worst])
                    )

    def _check_undriven_joints(self) -> None:
        """Check that joints that no hand drives do not move."""
        for phase in self.trajectory.phases:
            driven = self.samples.find_driven_coordinates(phase.holds)
            for i, name in enumerate(self.trajectory.names):
                if (
                    i < self.trajectory.robot_size
                    or name in driven
                    or name in self.samples.grasp_freedoms
                ):
                    continue
                owner = name.partition(".")[0]
                why = "no hold drives it" if owner in phase.held else f"{owner} is not grasped"
                self._check_stationary(phase, "unheld", name, "moves by ", f" while {why}")

    def _check_latches(self) -> None:
        """Check that a latched joint leaves its latched position only while its latch is released.

        Between two samples both joints are linear in time. The shortfall of the releasing joint is
        therefore largest where the latched joint starts to move or leaves the latch's range.
        """
        z, names = self.samples.z, self.samples.world.coordinates
        for owner, placed in self.scene.objects.items():
            for latch in placed.object.latches:
                name, release = f"{owner}.{latch.joint}", f"{owner}.{latch.released_by}"
                off = z[:, names.index(name)] - latch.held_at
                before, after = np.abs(off[:-1]), np.abs(off[1:])
                crossed = (
                    off[:-1] * off[1:] < 0
                )  # goes through where it is held, and leaves on the other side
                begin = np.where(crossed, before / np.where(crossed, before + after, 1.0), 0.0)
                reach = np.where(crossed, 0.0, before)
                leaves = (
                    (after > reach + 1e-12)
                    & (after > LATCH_TOLERANCE)
                    & (reach <= latch.engaged_within)
                )
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
                    self._add_violation(
                        "latch", name, short[row], self.samples.get_unit(release), detail, row=row
                    )

    def _check_closure(self) -> tuple[float, float]:
        """Check grasp closure (eq. 2) and return the largest drift, [m] and [rad]."""
        largest, limits = (
            np.zeros(2),
            (self.tolerances.closure_position, self.tolerances.closure_angle),
        )
        for phase in self.trajectory.phases:
            for hold in phase.holds:
                drift = find_drift(self.samples, phase, hold, limits)
                largest = np.maximum(largest, drift.measured)
                subject = f"{hold.object}.{hold.attachment}"
                rows = zip(
                    drift.measured, drift.bound, drift.times, limits, ("m", "rad"), strict=True
                )
                for found, bound, time, limit, unit in rows:
                    if not bound <= limit:
                        amount = found if found > limit else bound
                        excess = f"{1e3 * amount:.3f} m{unit}, more than {1e3 * limit:g} m{unit}"
                        detail = f"the grasp drifts by {excess}"
                        at = min(
                            int(np.searchsorted(self.trajectory.times, time, side="right")) - 1,
                            phase.last,
                        )
                        self._add_violation(
                            "closure",
                            subject,
                            amount - limit,
                            unit,
                            detail,
                            waypoint=at,
                            time=float(time),
                        )
        return float(largest[0]), float(largest[1])

    def _check_firm_grasps(self) -> None:
        """Check that a firm grasp neither slides nor turns."""
        for phase in self.trajectory.phases:
            for owner, attachment in phase.held.items():
                grasp = self.scene.objects[owner].object.attachments[attachment]
                for name in grasp.coordinates if grasp.firm else ():
                    detail = f"the hand moves on '{owner}' by "
                    self._check_stationary(
                        phase, "slide", f"{owner}.{name}", detail, " while it clamps it"
                    )

    def _check_stationary(
        self, phase: PhaseSpan, kind: str, name: str, before: str, after: str
    ) -> None:
        """Check that a coordinate is constant in a phase; detail: `before`, amount, `after`."""
        column, begin = self.trajectory.names.index(name), self.trajectory.column(name)[phase.first]
        low, high = (side[phase.first : phase.last, column] for side in self._ranges)
        moved, unit = np.maximum(high - begin, begin - low), self.samples.get_unit(name)
        worst = int(np.argmax(moved))
        if not moved[worst] <= MOTION_TOLERANCE:
            at = phase.first + worst + 1
            self._add_violation(
                kind,
                name,
                moved[worst],
                unit,
                f"{before}{moved[worst]:.4f} {unit}{after}",
                waypoint=at,
            )

    def _check_clearance(self) -> Floats:
        """Check clearance at waypoints (eqs. 6 and 7) and penetration anywhere.

        Pairs that move together are ignored. At the start the clearance may be violated, since the
        robot is already there, but nothing may penetrate.

        Returns:
            Smallest distance of each phase [m].
        """
        samples, solids, lasts = (
            self.samples,
            CollisionShapes(self.samples.world),
            [phase.last for phase in self.trajectory.phases],
        )
        near = find_contact_windows(samples, solids, self.steps, self.options, self.tolerances)
        safe, own = self.options.dist_safe, self.options.self_distance
        pairs = PairTable(
            self.scene, solids, self.trajectory, safe, own, windows=near, samples=samples
        )
        nearest, exempt = np.full(len(lasts), np.inf), self._find_exempt_pairs()
        names = samples.world.coordinates.names
        for hit in sweep(pairs, samples.z, samples.waypoint_rows):
            state = samples.z[[hit.row]]
            # The exemption also covers the segment before it ends and the one after it begins.
            tolerated = max(
                (
                    -one.margin
                    for one in exempt.get(hit.shapes, ())
                    if one.is_active(names, state)[0]
                ),
                default=0.0,
            )
            overlap = max(hit.contact, CONTACT_DEPTH + tolerated if tolerated > 0.0 else 0.0)
            if hit.margin > -np.inf and not tolerated > 0.0:
                np.minimum.at(
                    nearest, np.searchsorted(lasts, samples.find_waypoint(hit.row)), hit.distance
                )
            subject, millimetres = f"{hit.first} – {hit.second}", 1e3 * abs(hit.distance)
            short = (
                (min(hit.margin, -tolerated) if tolerated > 0.0 else hit.margin)
                - WAYPOINT_TOLERANCE
                - hit.distance
            )
            if hit.distance < -overlap:
                self._add_violation(
                    "penetration",
                    subject,
                    -hit.distance,
                    "m",
                    f"overlap by {millimetres:.1f} mm",
                    row=hit.row,
                )
            elif hit.at_waypoint and hit.row > 0 and short > 0.0:
                detail = (
                    f"are only {millimetres:.1f} mm apart, {1e3 * hit.margin:.0f} mm are required"
                )
                self._add_violation("clearance", subject, short, "m", detail, row=hit.row)
            elif hit.distance < -CONTACT_DEPTH or (
                hit.at_waypoint
                and hit.row > 0
                and hit.distance < hit.exempt_clearance - WAYPOINT_TOLERANCE
            ):
                self._record_exemption(hit, exempt.get(hit.shapes, ()))
        return nearest

    def _find_exempt_pairs(self) -> dict[tuple[int, int], list[ClearanceExemption]]:
        """Return the pairs of shapes that the scene exempts from clearance, with the reasons."""
        world, found = self.samples.world, dict[tuple[int, int], list[ClearanceExemption]]()
        for one in find_clearance_exemptions(self.scene, self.options.dist_safe):
            for pair in one.find_shape_pairs(world.collision_labels, world.collision_keys):
                found.setdefault(pair, []).append(one)
        return found

    def _record_exemption(self, hit: Hit, allowed: Sequence[ClearanceExemption]) -> None:
        """Record the smallest distance of a pair that used its exemption."""
        known = self.exemptions.get((hit.first, hit.second))
        if known is not None and known.distance <= hit.distance:
            return
        reason = "no deeper than the object at the start"
        if allowed:
            one = allowed[0]
            side = "apart" if one.distance >= 0.0 else "inside each other"
            stood = f"{abs(1e3 * one.distance):.1f} mm {side}"
            reason = (
                "the scene allows it" if one.shapes is None else f"{one} stand {stood} as built"
            )
        self.exemptions[hit.first, hit.second] = Exemption(
            f"{hit.first} – {hit.second}", hit.distance, reason
        )
