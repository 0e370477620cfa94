"""Report: what a check found, each violated constraint by name, place and amount; and what has one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import items, mapping, number, text, whole

if TYPE_CHECKING:
    from vkc_pin.options import Options
    from vkc_pin.world.scene.scene import Scene
    from vkc_pin.world.trajectory.trajectory import Trajectory

__all__ = ["Bound", "CheckedMotion", "Exemption", "Report", "Violation"]

AGREEMENT_TOLERANCE = (
    1e-5  # [m] or [rad] that two checks of the same motion may differ by, on two machines, say
)
MAX_BOUNDS = 4  # bounds that the text names
MAX_VIOLATIONS = 12  # violations that the text names; `violations` has them all


@dataclass(frozen=True)
class Violation:
    """One constraint that does not hold.

    Attributes:
        constraint: "start", "limit", "velocity", "acceleration", "jerk", "torque", "slip",
            "turning", "wheels", "dwell", "closure", "latch", "unheld", "tips", "slide", "push",
            "opening", "goal", "order", "clearance", "penetration" or "term", the user's own.
        subject: The coordinate, object, goal, term or pair of links it is about, e.g.
            "elbow_joint", "forearm_link – sofa".
        waypoint: Counted from 0; between two waypoints the earlier.
        time: [s].
        amount: By how much it is violated, in `unit`.
        unit: "m", "rad", "m/s", ...; empty for a term, whose unit is its own.
        detail: One sentence for people.
    """

    constraint: str
    subject: str
    _: KW_ONLY
    waypoint: int = 0
    time: float = 0.0
    amount: float
    unit: str
    detail: str

    def __str__(self) -> str:
        return f"{self.constraint} {self.subject}: {self.detail} (waypoint {self.waypoint}, {self.time:.2f} s)"


@dataclass(frozen=True)
class Bound:
    """A limit that bounds how fast a motion is.

    Attributes:
        subject: The coordinate whose limit it is; empty for a rest.
        kind: "velocity", "acceleration", "jerk", "torque", or "rest", where nothing moves.
        share: Of the duration, in which the motion is nearer to this limit than to any other, from
            0 to 1.
        begin: Of the longest stretch in which that is so [s].
        end: Of the same [s].
    """

    subject: str
    kind: str
    _: KW_ONLY
    share: float
    begin: float
    end: float

    def __str__(self) -> str:
        return f"{f'{self.subject} {self.kind}'.strip()} {100.0 * self.share:.0f} % ({self.begin:.1f} to {self.end:.1f} s)"


@dataclass(frozen=True)
class Exemption:
    """A pair of links that came closer than the clearance, or overlapped, and was exempt from it.

    Attributes:
        subject: The pair, "door.leaf – wall".
        distance: Their smallest signed distance where they were exempt [m].
        reason: Why they were.
    """

    subject: str
    distance: float
    reason: str

    def __str__(self) -> str:
        by = 1e3 * abs(self.distance)
        close = f"{by:.1f} mm apart" if self.distance >= 0.0 else f"overlap by {by:.1f} mm"
        return f"{self.subject}: {close}; {self.reason}"


@dataclass(frozen=True)
class Report:
    """What `validation` says of a motion.

    Attributes:
        violations: The worst of each constraint, subject and unit, in order of time; empty if the
            motion is right.
        clearance: Smallest distance of any pair anywhere along the motion [m].
        closure_error: Largest drift of a held object's base or of the grasp [m].
        closure_angle: The same for orientation [rad].
        clearances: The smallest distance at the waypoints of each phase, and anywhere in the phase
            of the smallest of all [m].
        states: How many configurations were looked at.
        notes: What prevents the task as a whole, if planning failed; one line each.
        torque: The largest torque of a joint of the arm, as a share of what its motor has; 0 if
            that is not known.
        bounds: What bounds the duration, the limit that does so for longest first.
        remarks: What was not looked at, as nobody states it: efforts, masses; one line each.
        exemptions: Pairs that came closer than the clearance, or overlapped, and were exempt from
            it.
    """

    violations: tuple[Violation, ...] = ()
    clearance: float = float("inf")
    _: KW_ONLY
    closure_error: float = 0.0
    closure_angle: float = 0.0
    clearances: tuple[float, ...] = ()
    states: int = 0
    notes: tuple[str, ...] = ()
    torque: float = 0.0
    bounds: tuple[Bound, ...] = ()
    remarks: tuple[str, ...] = ()
    exemptions: tuple[Exemption, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing is violated."""
        return not self.violations

    def lines(self) -> list[str]:
        """Return it as lines of text."""
        head = f"validation  {self.states} configurations checked: "
        if self.ok:
            return [head + "every constraint holds"]
        return [
            head + f"{len(self.violations)} constraint(s) violated",
            *(f"  - {v}" for v in self.violations[:MAX_VIOLATIONS]),
            *(
                [f"  ... and {len(self.violations) - MAX_VIOLATIONS} more"]
                if len(self.violations) > MAX_VIOLATIONS
                else []
            ),
            *(f"  because {note}" for note in self.notes),
        ]

    def measures(self) -> dict[str, float]:
        """Return what a motion is measured by: clearance and closure_error [m], torque [share of what a motor has]."""
        return {
            "clearance": self.clearance,
            "closure_error": self.closure_error,
            "torque": self.torque,
        }

    def timing(self) -> list[str]:
        """Return what bounds the duration and what the motors do, as lines of text."""
        told = ", ".join(map(str, self.bounds[:MAX_BOUNDS]))
        return [
            *([f"bounded by  {told}"] if told else []),
            *(
                [f"torques     {100.0 * self.torque:.0f} % of what the motors have, at most"]
                if self.torque > 0.0
                else []
            ),
            *(f"unknown     {remark}" for remark in self.remarks),
            *(f"exempt      {exemption}" for exemption in self.exemptions),
        ]

    def by_phase(self, trajectory: Trajectory) -> list[str]:
        """Return a line of text for each phase of the motion it is about: when, how much effort, and how close."""
        lines, nearest = [], self.clearances or (float("inf"),) * len(trajectory.phases)
        for part, close in zip(trajectory.parts(), nearest, strict=True):
            first, last, effort = (
                part.times[0],
                part.times[-1],
                (part.base_effort(), part.arm_effort()),
            )
            gone = f"base {effort[0]:5.2f} m, arm {effort[1]:5.2f} rad, {1e3 * close:6.1f} mm"
            lines.append(f"{first:6.1f} to {last:6.1f} s: {gone}, {part.phases[0].name}")
        return lines

    def with_reasons(self, reasons: Sequence[Violation]) -> Report:
        """Return the report of a motion that was never planned: only `reasons` are violated, the rest follows from them."""
        return replace(self, violations=tuple(reasons))

    def contradictions(self, claimed: Report) -> list[str]:
        """Return what another report of the same motion says otherwise, one line each; distances to 10 µm, angles to 1e-5 rad."""
        lines = []
        if claimed.ok != self.ok:
            lines.append(
                "every constraint holds"
                if claimed.ok
                else f"{len(claimed.violations)} constraint(s) violated"
            )
        for name, unit in (("clearance", "m"), ("closure_error", "m"), ("closure_angle", "rad")):
            there, here = getattr(claimed, name), getattr(self, name)
            if there != here and not abs(there - here) <= AGREEMENT_TOLERANCE:
                lines.append(f"{name} {there:.6g} {unit} instead of {here:.6g} {unit}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain data of it."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Report:
        """Return the report that `to_dict` made `data` of.

        Raises:
            InputError: Something is missing from it, or of another kind.
        """
        fields = dict(mapping(data, "report"))
        for name in (
            "clearance",
            "closure_error",
            "closure_angle",
        ):  # infinite where nothing can collide
            if name in fields:
                fields[name] = _parse_real(fields[name], name)
        nearest: tuple[Any, ...] = items(
            fields.get("clearances", ()), "clearances", "a list of distances"
        )
        fields["clearances"] = tuple(
            _parse_real(one, f"clearances[{k}]") for k, one in enumerate(nearest)
        )
        fields["states"] = whole(fields.get("states", 0), "states", low=0)
        listed: tuple[Any, ...] = items(
            fields.get("violations"), "violations", "a list of violations"
        )
        fields["violations"] = tuple(
            _parse_violation(one, f"violations[{k}]") for k, one in enumerate(listed)
        )
        notes: tuple[Any, ...] = items(fields.get("notes"), "notes", "a list of texts")
        fields["notes"] = tuple(text(note, f"notes[{k}]") for k, note in enumerate(notes))
        fields["torque"] = number(fields.get("torque", 0.0), "torque", low=0.0)
        bounds: tuple[Any, ...] = items(fields.get("bounds", ()), "bounds", "a list of bounds")
        fields["bounds"] = tuple(_parse_bound(one, f"bounds[{k}]") for k, one in enumerate(bounds))
        remarks: tuple[Any, ...] = items(fields.get("remarks", ()), "remarks", "a list of texts")
        fields["remarks"] = tuple(text(remark, f"remarks[{k}]") for k, remark in enumerate(remarks))
        exempt: tuple[Any, ...] = items(
            fields.get("exemptions", ()), "exemptions", "a list of exemptions"
        )
        fields["exemptions"] = tuple(
            _parse_exemption(one, f"exemptions[{k}]") for k, one in enumerate(exempt)
        )
        try:
            return cls(**fields)
        except TypeError as error:  # a field that there is not
            raise InputError(
                "not a report", expected="what Report.to_dict returns", got=str(error)
            ) from None


def _parse_real(value: Any, field: str) -> float:
    """Return a number, which may be infinite. Raises `InputError` if it is none."""
    return value if isinstance(value, float) else number(value, field)


def _parse_violation(data: Any, field: str) -> Violation:
    """Return the violation that plain data describe. Raises `InputError` if something is missing or of another kind."""
    given = mapping(data, field)
    for name in ("constraint", "subject", "unit", "detail"):
        given[name] = text(given.get(name), f"{field}.{name}")
    for name in ("time", "amount"):
        given[name] = _parse_real(given.get(name), f"{field}.{name}")
    given["waypoint"] = whole(given.get("waypoint"), f"{field}.waypoint", low=0)
    try:
        return Violation(**given)
    except TypeError as error:
        raise InputError(
            "not a violation", field=field, expected="what Report.to_dict returns", got=str(error)
        ) from None


def _parse_exemption(data: Any, field: str) -> Exemption:
    """Return the exemption that plain data describe. Raises `InputError` if something is missing or of another kind."""
    given = mapping(data, field)
    for name in ("subject", "reason"):
        given[name] = text(given.get(name), f"{field}.{name}")
    given["distance"] = number(given.get("distance"), f"{field}.distance")
    try:
        return Exemption(**given)
    except TypeError as error:
        raise InputError(
            "not an exemption", field=field, expected="what Report.to_dict returns", got=str(error)
        ) from None


def _parse_bound(data: Any, field: str) -> Bound:
    """Return the bound that plain data describe. Raises `InputError` if something is missing or of another kind."""
    given = mapping(data, field)
    for name in ("subject", "kind"):
        given[name] = text(given.get(name), f"{field}.{name}")
    for name in ("share", "begin", "end"):
        given[name] = number(given.get(name), f"{field}.{name}")
    try:
        return Bound(**given)
    except TypeError as error:
        raise InputError(
            "not a bound", field=field, expected="what Report.to_dict returns", got=str(error)
        ) from None


@runtime_checkable
class CheckedMotion(Protocol):
    """A motion in a scene that was checked, such as a `Plan`: what pictures show."""

    @property
    def scene(self) -> Scene:
        """Where it happens."""

    @property
    def options(self) -> Options:
        """What the check was told, such as the clearance asked for."""

    @property
    def trajectory(self) -> Trajectory:
        """The motion."""

    @property
    def validation(self) -> Report:
        """What the check says of it."""

    @property
    def status(self) -> str:
        """`success`, or why not."""

    @property
    def success(self) -> bool:
        """Whether it does what was asked for and nothing is violated."""

    @property
    def metrics(self) -> Mapping[str, float]:
        """Efforts, times and distances by name, as far as they are known."""

    @property
    def seed(self) -> int:
        """Of the random numbers it came from."""

    @property
    def initialization(self) -> str:
        """Which seed trajectory it came from."""
