"""What a check makes of what it finds: the worst of each, in order, with place and time; and rules on numbers alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.options import Options
from vkc_pin.validation import validate as module
from vkc_pin.validation.report import Report, Violation
from vkc_pin.validation.sweep import Hit
from vkc_pin.validation.validate import (
    LATCH_TOLERANCE,
    LIMIT_TOLERANCE,
    START_LIMIT_TOLERANCE,
    START_TOLERANCE,
    WAYPOINT_TOLERANCE,
    _Validator,
)
from vkc_pin.world.scene.clearance_exemptions import ClearanceExemption
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.support import MAX_TILT
from vkc_pin.world.trajectory.phase_span import PhaseSpan


def check(
    *,
    phases: list[PhaseSpan] | None = None,
    times: Any = (0.0, 1.0, 2.0, 3.0),
    each: int = 2,
    **fields: Any,
) -> Any:
    """Return a check of a motion of which only times are known, with `each` samples a step."""
    made = object.__new__(_Validator)
    edges = np.array(times)
    rows = each * np.arange(len(edges))
    samples = SimpleNamespace(
        times=np.interp(np.arange(rows[-1] + 1), rows, edges),
        waypoint_rows=rows,
        find_waypoint=lambda row: int(np.searchsorted(rows, row, side="right")) - 1,
        get_rows=lambda phase: np.arange(rows[phase.first], rows[phase.last] + 1),
        get_unit=lambda name: "rad" if "turn" in name else "m",
        grasp_freedoms=set(),
    )
    defaults: dict[str, Any] = {
        "samples": samples,
        "trajectory": SimpleNamespace(
            times=edges, phases=phases or [PhaseSpan("p", 0, len(edges) - 1)]
        ),
        "options": Options(),
        "violations": [],
        "exemptions": {},
        "steps": [],
    }
    for name, value in {**defaults, **fields}.items():
        setattr(made, name, value)
    return made


def told(made: Any) -> list[tuple[Any, ...]]:
    rows = [
        (one.constraint, one.subject, one.waypoint, one.time, one.amount, one.unit)
        for one in made.violations
    ]
    made.violations.clear()
    return rows


def test_tolerances_are_those_of_the_pages() -> None:
    assert (START_TOLERANCE, LIMIT_TOLERANCE, START_LIMIT_TOLERANCE) == (1e-9, 1e-5, 1e-2)
    assert (LATCH_TOLERANCE, WAYPOINT_TOLERANCE) == (1e-4, 1e-3)


def test_where_something_is_noted() -> None:
    """At a waypoint, or at a sample: then it is the waypoint before, and the sample's own time."""
    made = check()
    made._add_violation("limit", "x", 0.5, "m", "d")
    made._add_violation("limit", "x", 0.5, "m", "d", waypoint=2)
    made._add_violation("limit", "x", 0.5, "m", "d", row=3)
    assert told(made) == [("limit", "x", *at, 0.5, "m") for at in ((0, 0.0), (2, 2.0), (1, 1.5))]


# --- the report
# -------------------------------------------------------------------------------------------------------


def violation(kind: str, subject: str, amount: float, time: float, unit: str = "m") -> Violation:
    return Violation(kind, subject, waypoint=0, time=time, amount=amount, unit=unit, detail="")


def reported(
    monkeypatch: pytest.MonkeyPatch,
    *found: Violation,
    reason: bool = True,
    nearest: tuple[float, ...] = (0.3, 0.1, 0.2),
) -> Report:
    """Return the report of a check that finds these."""
    phases = [PhaseSpan(f"p{k}", k, k + 1) for k in range(3)]
    made = check(phases=phases, violations=list(found), terms=(), scene=None)
    for name in (
        "check_rates",
        "check_rolling",
        "check_goals",
        "check_terms",
        "check_gripper",
        "check_pushes",
    ):
        monkeypatch.setattr(module, name, lambda *_: [])
    motors = SimpleNamespace(
        find_violations=list, summarize=lambda jerk_time: {"torque": jerk_time}
    )
    monkeypatch.setattr(module, "MotorLoads", lambda samples: motors)
    made._check_start = made._check_limits = made._check_undriven_joints = made._check_tilt = (
        made._check_latches
    ) = made._check_firm_grasps = lambda: None
    made._check_closure, made._check_clearance = lambda: (0.25, 0.5), lambda: np.array(nearest)
    made._check_sample_count = lambda: reason
    made.options = Options(jerk_time=0.125)
    report: Report = made.make_report()
    return report


def test_the_worst_of_each_constraint_subject_and_unit_in_order_of_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    early, late = violation("limit", "x", 0.1, 1.0), violation("limit", "x", 0.2, 5.0)
    other, unit = violation("limit", "y", 0.05, 3.0), violation("limit", "x", 0.01, 2.0, "rad")
    kind, same = violation("goal", "x", 0.02, 3.0), violation("goal", "a", 0.02, 3.0)
    for found in ([early, late, other, unit, kind, same], [late, same, early, unit, kind, other]):
        assert reported(monkeypatch, *found).violations == (unit, same, kind, other, late)
    first, second = violation("limit", "x", 0.2, 5.0), violation("limit", "x", 0.2, 6.0)
    assert reported(monkeypatch, first, second).violations == (first,)  # as bad: where it begins


def test_what_overlaps_is_not_said_to_be_too_close_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    close, deep = (
        violation("clearance", "a – b", 0.01, 1.0),
        violation("penetration", "a – b", 0.02, 2.0),
    )
    other = violation("clearance", "a – c", 0.01, 3.0)
    assert reported(monkeypatch, close, deep, other).violations == (deep, other)
    assert reported(monkeypatch, close, other).violations == (close, other)
    assert reported(monkeypatch, deep).violations == (deep,)


def test_what_else_a_report_says(monkeypatch: pytest.MonkeyPatch) -> None:
    report = reported(monkeypatch)
    assert (report.ok, report.clearance, report.clearances) == (True, 0.1, (0.3, 0.1, 0.2))
    assert (report.closure_error, report.closure_angle, report.states, report.torque) == (
        0.25,
        0.5,
        7,
        0.125,
    )
    blind = reported(monkeypatch, reason=False)
    assert (blind.clearance, blind.clearances) == (np.inf, (np.inf,) * 3)


@pytest.mark.parametrize(
    ("needed", "most", "right"),
    [(20.0, 20, True), (21.0, 20, False), (3.0, 2, True), (5.0, 2, False)],
)
def test_what_is_longer_than_can_be_looked_at(
    needed: float, most: int, right: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At least its waypoints can; it is named where it jumps furthest."""
    monkeypatch.setattr(module, "MAX_SAMPLES", most)
    made = check()
    made.samples.required_count = needed
    made.trajectory.positions = np.array([[0.0, 0.0], [2.0, 2.0], [-3.0, 2.0], [-1.0, 4.0]])
    assert made._check_sample_count() == right
    expected = ("sampling", "motion", 1, 1.0, needed - max(most, 4), "configurations")
    assert told(made) == ([] if right else [expected])


# --- limits
# -----------------------------------------------------------------------------------------------------------


def limited(way: list[float], *, bulge: tuple[int, float] | None = None) -> list[tuple[Any, ...]]:
    """Return what is said of a coordinate from −1 to 2 that goes this way, at one moment between two waypoints further."""
    column = np.array(way)
    low, high = np.minimum(column[:-1], column[1:]), np.maximum(column[:-1], column[1:])
    if bulge is not None:
        (high if bulge[1] > 0.0 else low)[bulge[0]] += bulge[1]
    made = check(times=np.arange(float(len(way))), _ranges=(low[:, None], high[:, None]))
    made.samples.get_limits = lambda name: (-1.0, 2.0, 0.0, 0.0)
    made.trajectory.names, made.trajectory.positions = ("turn",), column[:, None]
    made.trajectory.column = lambda name: column
    made._check_limits()
    details = [one.detail for one in made.violations]
    rows = [(*row[:4], pytest.approx(row[4]), row[5]) for row in told(made)]
    for row, detail in zip(rows, details, strict=True):
        value = (
            -1.0 - row[4].expected if "-1." in detail.split(" rad")[0] else 2.0 + row[4].expected
        )
        assert (
            detail
            == f"{value:.4f} rad is outside -1.0000 to 2.0000 rad by {row[4].expected:.4f} rad"
        )
    return rows


def test_limits_are_kept_at_waypoints_and_between_them() -> None:
    assert limited([0.0, 2.0, -1.0, 0.0]) == []
    assert limited([0.0, 2.25, -1.0, 0.0]) == [
        ("limit", "turn", 1, 1.0, pytest.approx(0.25), "rad")
    ]
    assert limited([0.0, 1.0, -1.5, 0.0]) == [("limit", "turn", 2, 2.0, pytest.approx(0.5), "rad")]
    assert limited([0.0, 2.25, -1.5, 0.0]) == [
        ("limit", "turn", 2, 2.0, pytest.approx(0.5), "rad")
    ]  # the worse
    assert limited([0.0, 2.5, -1.25, 0.0]) == [("limit", "turn", 1, 1.0, pytest.approx(0.5), "rad")]
    assert limited([0.0, 0.0, 1.9, 0.0], bulge=(2, 0.3)) == [
        ("limit", "turn", 2, 2.0, pytest.approx(0.2), "rad")
    ]
    assert limited([0.0, 0.0, 0.5, 1.9], bulge=(2, 0.3)) == [
        ("limit", "turn", 3, 3.0, pytest.approx(0.2), "rad")
    ]
    assert limited([0.0, -0.9, 0.0, 1.0], bulge=(0, -0.3)) == [
        ("limit", "turn", 1, 1.0, pytest.approx(0.2), "rad")
    ]


@pytest.mark.parametrize("side", [1, -1])
def test_a_hundredth_of_a_millimetre_is_all_right(side: int) -> None:
    edge = {1: 2.0, -1: -1.0}[side]
    assert limited([0.0, edge + side * 0.9e-5, 0.0]) == []
    assert len(limited([0.0, edge + side * 1.2e-5, 0.0])) == 1


@pytest.mark.parametrize("side", [1, -1])
def test_where_it_begins_it_may_be_a_little_outside(side: int) -> None:
    """In its first step, and no further out than it begins; what begins far out may not."""
    edge = {1: 2.0, -1: -1.0}[side]
    out = edge + side * 0.009
    assert limited([out, 0.0, 0.0]) == []
    assert limited([out, out, 0.0]) == [
        ("limit", "turn", 1, 1.0, pytest.approx(0.009), "rad")
    ]  # it stays outside after that
    assert limited([out, edge + side * 0.0095, 0.0]) != []
    assert limited([edge + side * 0.015, 0.0, 0.0]) == [
        ("limit", "turn", 0, 0.0, pytest.approx(0.015), "rad")
    ]
    assert limited([0.5, edge + side * 0.6, 0.5]) == [
        ("limit", "turn", 1, 1.0, pytest.approx(0.6), "rad")
    ]


@pytest.mark.parametrize(
    ("off", "told_of"), [(0.9e-9, False), (1.5e-9, True), (-1.5e-9, True), (np.nan, True)]
)
def test_where_it_starts(off: float, told_of: bool) -> None:
    """What the world does not know, a hand's choice, may start anywhere."""
    made = check()
    world = SimpleNamespace(start=[1.0, 2.0], coordinates=SimpleNamespace(names=["x", "turn"]))
    made.samples.world = world
    made.trajectory.names, made.trajectory.positions = (
        ("choice", "x", "turn"),
        np.array([[7.0, 1.0, 2.0 + off]]),
    )
    made._check_start()
    details = [one.detail for one in made.violations]
    rows = told(made)
    assert [row[:4] for row in rows] == [("start", "turn", 0, 0.0)] * told_of
    if told_of and off == off:
        assert rows[0][4:] == (pytest.approx(abs(off)), "rad")
        assert details == ["2 rad instead of 2 rad"]


# --- what moves and must not
# ------------------------------------------------------------------------------------------


def stilled(
    way: list[float], phase: PhaseSpan, bulge: tuple[int, float] | None = None
) -> list[tuple[Any, ...]]:
    column = np.array(way)
    low, high = np.minimum(column[:-1], column[1:]), np.maximum(column[:-1], column[1:])
    if bulge is not None:
        (high if bulge[1] > 0.0 else low)[bulge[0]] += bulge[1]
    made = check(times=np.arange(float(len(way))), _ranges=(low[:, None], high[:, None]))
    made.trajectory.names, made.trajectory.column = ("turn",), lambda name: column
    made._check_stationary(phase, "slide", "turn", "it moves by ", " there")
    details = [one.detail for one in made.violations]
    rows = told(made)
    assert details == [f"it moves by {row[4]:.4f} rad there" for row in rows]
    return [(*row[:4], pytest.approx(row[4]), row[5]) for row in rows]


def test_what_must_not_move_in_a_phase() -> None:
    middle = PhaseSpan("p", 1, 3)
    assert stilled([5.0, 1.0, 1.0, 1.0, 9.0], middle) == []
    assert stilled([5.0, 1.0, 1.25, 1.0, 9.0], middle) == [("slide", "turn", 2, 2.0, 0.25, "rad")]
    assert stilled([5.0, 1.0, 1.0, 0.5, 9.0], middle) == [("slide", "turn", 3, 3.0, 0.5, "rad")]
    assert stilled([5.0, 1.0, 1.25, 0.5, 9.0], middle) == [("slide", "turn", 3, 3.0, 0.5, "rad")]
    assert stilled([5.0, 1.0, 1.0, 1.0, 9.0], middle, (2, -0.2)) == [
        ("slide", "turn", 3, 3.0, 0.2, "rad")
    ]
    assert stilled([1.0, 1.0, 1.0 + 0.9e-5, 1.0, 1.0], middle) == []
    assert stilled([1.0, 1.0, 1.0 + 1.2e-5, 1.0, 1.0], middle) != []


def test_what_nobody_holds_and_what_a_hand_does_not_drive() -> None:
    """Of the robot, of what the hand drives, and of what it chooses nothing is said."""
    hold = Hold("door", "handle")
    made = check(phases=[PhaseSpan("p", 0, 1), PhaseSpan("q", 1, 3, (hold,))])
    made.trajectory.names, made.trajectory.robot_size = (
        ("base", "wrist", "door.hinge", "door.knob", "cup.lid", "door.choice"),
        2,
    )
    made.samples.find_driven_coordinates = lambda holds: {"door.hinge"} if holds else set()
    made.samples.grasp_freedoms = {"door.choice"}
    noted: list[tuple[Any, ...]] = []
    made._check_stationary = lambda phase, *what: noted.append((phase.name, *what))
    made._check_undriven_joints()
    nobody, driven = " while {} is not grasped", " while no hold drives it"
    assert noted == [
        ("p", "unheld", "door.hinge", "moves by ", nobody.format("door")),
        ("p", "unheld", "door.knob", "moves by ", nobody.format("door")),
        ("p", "unheld", "cup.lid", "moves by ", nobody.format("cup")),
        ("q", "unheld", "door.knob", "moves by ", driven),
        ("q", "unheld", "cup.lid", "moves by ", nobody.format("cup")),
    ]


def test_only_a_hand_that_clamps_must_not_slide() -> None:
    """In the phases in which it holds, of all that it could choose."""
    clamps = SimpleNamespace(firm=True, coordinates=("grip_slide", "grip_turn"))
    leaves = SimpleNamespace(firm=False, coordinates=("handle_turn",))
    objects = {
        "stick": SimpleNamespace(object=SimpleNamespace(attachments={"grip": clamps})),
        "door": SimpleNamespace(object=SimpleNamespace(attachments={"handle": leaves})),
    }
    both = (Hold("stick", "grip"), Hold("door", "handle"))
    made = check(
        phases=[PhaseSpan("p", 0, 1), PhaseSpan("q", 1, 3, both)],
        scene=SimpleNamespace(objects=objects),
    )
    noted: list[tuple[Any, ...]] = []
    made._check_stationary = lambda phase, *what: noted.append((phase.name, *what))
    made._check_firm_grasps()
    said = "the hand moves on 'stick' by ", " while it clamps it"
    assert noted == [("q", "slide", f"stick.{name}", *said) for name in clamps.coordinates]


@pytest.mark.parametrize(("angle", "tips"), [(0.9 * MAX_TILT, False), (1.1 * MAX_TILT, True)])
def test_what_something_stands_on_stays_level(angle: float, tips: bool) -> None:
    """As it was at the phase's begin, whichever way it turns about the vertical."""
    made = check(phases=[PhaseSpan("p", 0, 1), PhaseSpan("q", 1, 3)])
    made.samples.free_objects = SimpleNamespace(supports=[{}, {"cup": "tray.plate"}])
    start = pin.utils.rotate("x", 0.3)
    little = pin.utils.rotate("z", 1.0) @ pin.utils.rotate("y", -0.2 * MAX_TILT) @ start
    turns = [start, little, pin.utils.rotate("y", angle) @ start, start, start]
    made.samples.compute_placements = lambda rows, label: [
        pin.SE3(turn, np.zeros(3)) for turn in turns
    ]
    made._check_tilt()
    assert told(made) == (
        [("tips", "cup", 2, 2.0, pytest.approx(angle - MAX_TILT), "rad")] if tips else []
    )


# --- clearance
# --------------------------------------------------------------------------------------------------------


class Near(ClearanceExemption):
    """An allowance of two links that holds at some samples."""

    def __init__(self, first: str, second: str, rows: set[int], margin: float = -np.inf) -> None:
        super().__init__(first, second, margin, margin)
        object.__setattr__(self, "rows", rows)

    def is_active(self, names: Any, state: np.ndarray) -> np.ndarray:
        return np.array([int(state[0, 0]) in vars(self)["rows"]])


def close(
    monkeypatch: pytest.MonkeyPatch, *hits: Hit, allowed: tuple[Near, ...] = ()
) -> tuple[list[float], list[tuple[Any, ...]]]:
    """Return each phase's smallest distance, and what is said of these hits."""
    made = check(phases=[PhaseSpan("p", 0, 1), PhaseSpan("q", 1, 3)], scene=None)
    shapes: Any = {"collision_labels": ["a", "b"], "collision_keys": ["a", "b"]}
    made.samples.world = SimpleNamespace(coordinates=SimpleNamespace(names=()), **shapes)
    made.samples.z = np.arange(7.0)[:, None]
    monkeypatch.setattr(module, "CollisionShapes", lambda world: None)
    monkeypatch.setattr(module, "find_contact_windows", lambda *_: [])
    monkeypatch.setattr(module, "PairTable", lambda *_, **__: None)
    monkeypatch.setattr(module, "find_clearance_exemptions", lambda scene, safe: allowed)
    monkeypatch.setattr(module, "sweep", lambda table, z, waypoints: iter(hits))
    nearest = made._check_clearance()
    return nearest.tolist(), [(*row[:4], pytest.approx(row[4]), row[5]) for row in told(made)]


def hit(
    row: int, distance: float, *, margin: float = 0.02, contact: float = 0.0, at: bool | None = None
) -> Hit:
    return Hit(
        row, "a", "b", distance, margin, contact, row % 2 == 0 if at is None else at, shapes=(0, 1)
    )


def test_what_overlaps_and_what_is_too_close(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too close it can be only at waypoints, and not at the start."""
    assert close(monkeypatch, hit(2, 0.015)) == (
        [0.015, np.inf],
        [("clearance", "a – b", 1, 1.0, 0.004, "m")],
    )
    assert close(monkeypatch, hit(2, 0.0191)) == ([0.0191, np.inf], [])
    assert close(monkeypatch, hit(2, 0.0189))[1] != []
    assert close(monkeypatch, hit(3, 0.015)) == ([0.015, np.inf], [])
    assert close(monkeypatch, hit(0, 0.015)) == ([0.015, np.inf], [])
    assert close(monkeypatch, hit(0, -0.015)) == (
        [-0.015, np.inf],
        [("penetration", "a – b", 0, 0.0, 0.015, "m")],
    )
    assert close(monkeypatch, hit(5, -0.015)) == (
        [np.inf, -0.015],
        [("penetration", "a – b", 2, 2.5, 0.015, "m")],
    )
    assert close(monkeypatch, hit(6, -0.015)) == (
        [np.inf, -0.015],
        [("penetration", "a – b", 3, 3.0, 0.015, "m")],
    )
    assert close(monkeypatch, hit(4, 0.3), hit(4, 0.1), hit(2, 0.2)) == ([0.2, 0.1], [])


def test_contact_is_no_overlap_and_what_moves_as_one_has_no_distance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert close(monkeypatch, hit(2, -0.009, margin=0.0, contact=0.01)) == (
        [-0.009, np.inf],
        [("clearance", "a – b", 1, 1.0, 0.008, "m")],
    )
    assert close(monkeypatch, hit(2, -0.011, margin=0.0, contact=0.01))[1][0][0] == "penetration"
    assert close(monkeypatch, hit(3, -0.009, contact=0.01))[1] == []
    assert close(monkeypatch, hit(2, -0.009, margin=-np.inf, contact=0.01)) == (
        [np.inf, np.inf],
        [],
    )
    assert close(monkeypatch, hit(2, -0.02, margin=-np.inf, contact=0.01))[1] != []


def test_neighbours_are_none_of_it_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever of them is named first; those that keep a margin are."""
    nothing = [np.inf, np.inf]
    for pair in (("a", "b"), ("b", "a")):
        assert close(monkeypatch, hit(2, -0.1), allowed=(Near(*pair, {2}),)) == (nothing, [])
        assert close(monkeypatch, hit(2, -0.1), allowed=(Near(*pair, {3}), Near(*pair, {2}))) == (
            nothing,
            [],
        )
        assert close(monkeypatch, hit(2, -0.1), allowed=(Near(*pair, {3}),))[1] != []
        assert close(monkeypatch, hit(2, -0.1), allowed=(Near(*pair, {2}, 0.001),))[1] != []
    assert close(monkeypatch, hit(2, -0.1), allowed=(Near("a", "c", {2}),))[1] != []
