"""Defines the validation report and the violations, limiting constraints and exemptions in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol, runtime_checkable

from pydantic.types import FailFast

from vkc_pin.utils.arguments import check_mapping
from vkc_pin.world.files.documents import Document, parse_document
from vkc_pin.world.files.fields import Count, Distance, Finite, Measured, StoredRecord, Text

if TYPE_CHECKING:
    from vkc_pin.options import Options
    from vkc_pin.world.scene.scene import Scene
    from vkc_pin.world.trajectory.trajectory import Trajectory


AGREEMENT_TOLERANCE = 1e-5  # accepted difference of two checks of one motion [m] or [rad]
MAX_BOUNDS = 4  # limiting constraints listed in the text
MAX_VIOLATIONS = 12  # violations listed in the text; `violations` has all of them


@dataclass(frozen=True)
class Violation(StoredRecord):
    """A violated constraint.

    Attributes:
        constraint: "start", "limit", "velocity", "acceleration", "jerk", "torque", "slip",
            "turning", "wheels", "dwell", "closure", "latch", "unheld", "tips", "slide", "push",
            "opening", "support" (an object falls where it is released), "payload", "goal",
            "order", "clearance", "penetration", "sampling" (the motion is too long to be checked)
            or "term" (a user constraint).
        subject: Violating coordinate, object, goal, term or pair of links, e.g.
            "elbow_joint", "forearm_link – sofa".
        waypoint: Index from 0; between two waypoints, the earlier one.
        time: [s].
        amount: Amount of the violation, in `unit`.
        unit: "m", "rad", "m/s", ...; empty for a user term.
        detail: Description in one sentence.
    """

    required_fields: ClassVar = ("waypoint", "time")
    constraint: Text
    subject: Text
    _: KW_ONLY
    waypoint: Count = 0
    time: Finite = 0.0
    amount: Distance  # infinite for a user constraint that overflows
    unit: Text
    detail: Text

    @property
    def text(self) -> str:
        """Constraint, subject and detail, without the place."""
        return f"{self.constraint} {self.subject}: {self.detail}"

    def __str__(self) -> str:
        return f"{self.text} (waypoint {self.waypoint}, {self.time:.2f} s)"


@dataclass(frozen=True)
class Bound(StoredRecord):
    """A limit that bounds the speed of a motion.

    Attributes:
        subject: Limited coordinate; empty for a rest.
        kind: "velocity", "acceleration", "jerk", "torque", or "rest" where nothing moves.
        share: Fraction of the duration during which the motion is nearest to this limit, from 0
            to 1.
        begin: Begin of the longest interval during which this limit is the nearest [s].
        end: End of that interval [s].
    """

    subject: Text
    kind: Text
    _: KW_ONLY
    share: Measured
    begin: Finite
    end: Finite

    def __str__(self) -> str:
        limit = f"{self.subject} {self.kind}" if self.subject else "pauses"
        return f"{limit} {100.0 * self.share:.0f} % ({self.begin:.1f} to {self.end:.1f} s)"


@dataclass(frozen=True)
class Exemption(StoredRecord):
    """A pair of links that violated the clearance, or overlapped, but was exempt from it.

    Attributes:
        subject: Pair of links, e.g. "door.leaf – wall".
        distance: Smallest signed distance while the pair was exempt [m].
        reason: Reason for the exemption.
    """

    subject: Text
    distance: Finite
    reason: Text

    def __str__(self) -> str:
        millimetres = 1e3 * abs(self.distance)
        if self.distance >= 0.0:
            return f"{self.subject}: {millimetres:.1f} mm apart; {self.reason}"
        return f"{self.subject}: overlap by {millimetres:.1f} mm; {self.reason}"


@dataclass(frozen=True)
class Report(StoredRecord):
    """The result of validating a motion.

    Attributes:
        violations: Worst violation of each constraint, subject and unit, in order of time; empty
            if the motion is valid.
        clearance: Smallest distance of any pair anywhere along the motion [m].
        closure_error: Largest position error of a grasp [m].
        closure_angle: Largest orientation error of a grasp [rad].
        clearances: Smallest distance at the waypoints of each phase [m]. In the phase with the
            smallest of all, the smallest distance anywhere.
        states: Number of checked configurations.
        notes: Reasons why the task as a whole is infeasible, if planning failed; one line each.
        torque: Largest torque of an arm joint, as a fraction of its limit; 0 if limits are
            unknown.
        bounds: Limits that bound the duration, by decreasing share.
        remarks: Checks that were skipped because data are missing (torque limits, masses); one
            line each.
        exemptions: Pairs that violated the clearance, or overlapped, but were exempt from it.
        allowed: Objects that fall where they are released, or are heavier than the payload, because
            a step or an option allows it; one line each.
    """

    # Older files lack the others.
    required_fields: ClassVar = (
        "violations",
        "clearance",
        "closure_error",
        "closure_angle",
        "states",
        "notes",
    )
    violations: Annotated[tuple[Violation, ...], FailFast()] = ()
    clearance: Distance = float("inf")
    _: KW_ONLY
    closure_error: Measured = 0.0
    closure_angle: Measured = 0.0
    clearances: Annotated[tuple[Distance, ...], FailFast()] = ()
    states: Count = 0
    notes: Annotated[tuple[Text, ...], FailFast()] = ()
    torque: Measured = 0.0
    bounds: Annotated[tuple[Bound, ...], FailFast()] = ()
    remarks: Annotated[tuple[Text, ...], FailFast()] = ()
    exemptions: Annotated[tuple[Exemption, ...], FailFast()] = ()
    allowed: Annotated[tuple[Text, ...], FailFast()] = ()

    @property
    def ok(self) -> bool:
        """Whether no constraint is violated."""
        return not self.violations

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        head = f"validation  {self.states} configurations checked: "
        if self.ok:
            return [head + "every constraint holds"]
        lines = [head + f"{len(self.violations)} constraint(s) violated"]
        lines += [f"  - {violation}" for violation in self.violations[:MAX_VIOLATIONS]]
        more = len(self.violations) - MAX_VIOLATIONS
        if more > 0:
            lines.append(f"  ... and {more} more")
        lines += [f"  because {note}" for note in self.notes]
        return lines

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def measures(self) -> dict[str, float]:
        """Return metrics: clearance and closure_error [m], and torque [fraction of its limit]."""
        return {
            "clearance": self.clearance,
            "closure_error": self.closure_error,
            "torque": self.torque,
        }

    def timing(self) -> list[str]:
        """Return limiting constraints, torques, remarks, exemptions and what else is allowed."""
        lines = list[str]()
        if self.bounds:
            lines.append(f"bounded by  {', '.join(map(str, self.bounds[:MAX_BOUNDS]))}")
        if self.torque > 0.0:
            lines.append(f"torques     at most {100.0 * self.torque:.0f} % of the motors' limits")
        lines += [f"unknown     {remark}" for remark in self.remarks]
        lines += [f"exempt      {exemption}" for exemption in self.exemptions]
        lines += [f"allowed     {line}" for line in self.allowed]
        return lines

    def by_phase(self, trajectory: Trajectory) -> list[str]:
        """Return a line of text per phase: time span, base and arm travel, and clearance."""
        lines = list[str]()
        clearances = self.clearances or (float("inf"),) * len(trajectory.phases)
        for part, clearance in zip(trajectory.parts(), clearances, strict=True):
            base = part.base_path_length()
            arm = part.arm_path_length()
            travel = f"base {base:5.2f} m, arm {arm:5.2f} rad, {1e3 * clearance:6.1f} mm"
            span = f"{part.times[0]:6.1f} to {part.times[-1]:6.1f} s"
            lines.append(f"{span}: {travel}, {part.phases[0].name}")
        return lines

    def with_reasons(self, reasons: Sequence[Violation]) -> Report:
        """Return the report of a failed plan whose only violations are `reasons`."""
        return replace(self, violations=tuple(reasons))

    def contradictions(self, claimed: Report) -> list[str]:
        """Return contradictions to another report of the same motion (to 10 µm and 1e-5 rad)."""
        lines = []
        if claimed.ok != self.ok:
            count = len(claimed.violations)
            lines.append(f"{count} constraint(s) violated" if count else "every constraint holds")
        for name, unit in (("clearance", "m"), ("closure_error", "m"), ("closure_angle", "rad")):
            other = getattr(claimed, name)
            own = getattr(self, name)
            # Infinite numbers are equal without a difference, and NaN equals nothing.
            if other != own and not abs(other - own) <= AGREEMENT_TOLERANCE:
                lines.append(f"{name} {other:.6g} {unit} instead of {own:.6g} {unit}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain data."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Report:
        """Return the report described by data from `to_dict`.

        Raises:
            InputError: A field is missing, unknown, or has the wrong type.
        """
        return parse_document(Document(dict(check_mapping(data, "report"))), cls)


def select_worst(violations: Sequence[Violation]) -> tuple[Violation, ...]:
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


@runtime_checkable
class CheckedMotion(Protocol):
    """A validated motion in a scene, such as a `Plan`, as shown by viewers and plots."""

    @property
    def scene(self) -> Scene:
        """Scene of the motion."""

    @property
    def options(self) -> Options:
        """Options of the validation, such as the required clearance."""

    @property
    def trajectory(self) -> Trajectory:
        """Validated motion."""

    @property
    def report(self) -> Report:
        """Validation report."""

    @property
    def status(self) -> str:
        """`success`, or the reason of the failure."""

    @property
    def success(self) -> bool:
        """Whether the motion carries out its task and violates no constraint."""

    @property
    def metrics(self) -> Mapping[str, float]:
        """Known metrics by name: travel, times and distances."""

    @property
    def seed(self) -> int:
        """Random seed."""

    @property
    def initialization(self) -> str:
        """Initialization method."""
