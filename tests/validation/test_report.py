"""Tests reports as text and as plain data."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error

import vkc_pin as vkc
from vkc_pin import InputError, Report, Violation, validate
from vkc_pin.validation.report import Bound, Exemption
from vkc_pin.visualization.plots.plots import compute_clearance_curves

LIMIT = Violation(
    "limit",
    "elbow_joint",
    waypoint=4,
    time=1.0,
    amount=0.05,
    unit="rad",
    detail="3.2 rad is outside",
)
PENETRATION = Violation("penetration", "forearm_link – sofa", amount=0.01, unit="m", detail="deep")
FAST = Bound("base_x", "velocity", share=0.625, begin=1.0, end=2.5)
REST = Bound("", "rest", share=0.25, begin=0.0, end=1.0)
FULL = Report(
    (LIMIT, PENETRATION),
    -0.01,
    closure_error=0.001,
    closure_angle=0.002,
    clearances=(0.3, -0.01),
    states=12,
    notes=("a wall is in the way",),
    torque=0.5,
    bounds=(FAST, REST),
    remarks=("no masses",),
    exemptions=(Exemption("door.leaf – wall", -0.001, "the scene allows it"),),
)


def test_lines_describe_the_violations() -> None:
    head = "validation  3 configurations checked: "
    assert Report(states=3).lines() == [head + "every constraint holds"]
    assert FULL.lines() == [
        "validation  12 configurations checked: 2 constraint(s) violated",
        "  - limit elbow_joint: 3.2 rad is outside (waypoint 4, 1.00 s)",
        "  - penetration forearm_link – sofa: deep (waypoint 0, 0.00 s)",
        "  because a wall is in the way",
    ]
    assert len(Report((LIMIT,) * 12).lines()) == 13
    assert Report((LIMIT,) * 14).lines()[-1] == "  ... and 2 more"


def test_timing_describes_the_limiting_constraints() -> None:
    assert Report().timing() == []
    assert FULL.timing() == [
        "bounded by  base_x velocity 62 % (1.0 to 2.5 s), pauses 25 % (0.0 to 1.0 s)",
        "torques     at most 50 % of the motors' limits",
        "unknown     no masses",
        "exempt      door.leaf – wall: overlap by 1.0 mm; the scene allows it",
    ]
    (listed,) = Report(bounds=(REST,) * 6).timing()
    assert listed.count("pauses") == 4
    assert FULL.measures() == {"clearance": -0.01, "closure_error": 0.001, "torque": 0.5}


@pytest.mark.parametrize("field", ["clearance", "closure_error", "closure_angle"])
def test_contradictions_list_different_numbers(field: str) -> None:
    numbers = dict.fromkeys(("clearance", "closure_error", "closure_angle"), 0.5)
    for difference, differs in ((0.9e-5, False), (1.5e-5, True), (-1.5e-5, True), (math.nan, True)):
        other = Report(**{**numbers, field: 0.5 + difference})  # type: ignore[arg-type]
        lines = Report(**numbers).contradictions(other)  # type: ignore[arg-type]
        assert [line.partition(" ")[0] for line in lines] == [field] * differs


def test_contradictions_list_different_verdicts() -> None:
    assert FULL.contradictions(FULL) == Report().contradictions(Report()) == []
    assert Report().contradictions(Report(clearance=0.5)) == ["clearance 0.5 m instead of inf m"]
    assert Report().contradictions(Report((LIMIT,))) == ["1 constraint(s) violated"]
    assert Report((LIMIT,)).contradictions(Report()) == ["every constraint holds"]


def test_round_trip() -> None:
    for report in (FULL, Report()):
        assert Report.from_dict(json.loads(json.dumps(report.to_dict()))) == report
    only = FULL.with_reasons([LIMIT])
    assert vars(only) == {**vars(FULL), "violations": (LIMIT,)}


def test_fields_that_older_files_lack_have_defaults() -> None:
    data = FULL.to_dict()
    for name in ("clearances", "torque", "bounds", "remarks", "allowed"):
        del data[name]
    found = Report.from_dict({**data, "clearance": 1, "closure_error": np.float64(0.5)})
    assert found == Report(
        FULL.violations,
        1.0,
        closure_error=0.5,
        closure_angle=FULL.closure_angle,
        states=FULL.states,
        notes=FULL.notes,
        exemptions=FULL.exemptions,
    )
    for name in ("violations", "clearance", "closure_error", "closure_angle", "states", "notes"):
        with expect_error(field=name):
            Report.from_dict({key: value for key, value in data.items() if key != name})


def test_null_is_an_infinite_distance() -> None:
    """JSON without infinite numbers, as in datasets, has null instead."""
    data = FULL.to_dict()
    data["violations"][0]["amount"] = None
    found = Report.from_dict({**data, "clearance": None, "clearances": [0.3, None]})
    assert (found.clearance, found.clearances) == (math.inf, (0.3, math.inf))
    assert found.violations[0].amount == math.inf


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        (("violations",), 3, "violations"),
        (("violations", 0), 3, "violations[0]"),
        (("violations", 0, "time"), "soon", "violations[0].time"),
        (("violations", 0, "amount"), math.nan, "violations[0].amount"),
        (("violations", 1, "subject"), 3, "violations[1].subject"),
        (("violations", 1, "waypoint"), -1, "violations[1].waypoint"),
        (("violations", 1, "more"), 1, "violations[1].more"),
        (("notes",), 3, "notes"),
        (("notes", 0), 3, "notes[0]"),
        (("remarks", 0), 3, "remarks[0]"),
        (("clearance",), "near", "clearance"),
        (("clearances", 0), "near", "clearances[0]"),
        (("closure_error",), 10**500, "closure_error"),
        (("states",), 1.5, "states"),
        (("torque",), -0.1, "torque"),
        (("bounds", 0, "share"), "half", "bounds[0].share"),
        (("bounds", 1, "end"), math.inf, "bounds[1].end"),
        (("bounds", 0, "kind"), None, "bounds[0].kind"),
        (("bounds", 0, "more"), 1, "bounds[0].more"),
        (("exemptions", 0, "distance"), "far", "exemptions[0].distance"),
        (("exemptions", 0, "more"), 1, "exemptions[0].more"),
        (("more",), 1.5, "more"),
    ],
)
def test_invalid_data_raise(path: tuple[str | int, ...], value: object, field: str) -> None:
    data: Any = json.loads(json.dumps(FULL.to_dict()))
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(InputError) as caught:
        Report.from_dict(data)
    assert caught.value.field == field


def test_phases_are_described_by_times_lengths_and_clearance(door_plan: vkc.Plan) -> None:
    report, motion = door_plan.report, door_plan.trajectory
    parts = motion.parts()
    for line, part, close in zip(report.by_phase(motion), parts, report.clearances, strict=True):
        numbers = map(float, re.findall(r"-?[\d.]+(?= (?:to|s|m|rad|mm)\b)", line))
        base, arm = part.base_path_length(), part.arm_path_length()
        expected = [part.times[0], part.times[-1], base, arm, 1e3 * close]
        np.testing.assert_allclose(list(numbers), expected, atol=0.06)
        assert line.endswith(part.phases[0].name)
    assert Report().by_phase(motion)[0].count("inf mm") == 1


def test_clearance_of_a_phase_is_at_most_that_of_its_waypoints(door_plan: vkc.Plan) -> None:
    fine, report = door_plan.trajectory, door_plan.report
    assert min(report.clearances) == report.clearance
    for phase, close in zip(fine.phases, report.clearances, strict=True):
        times = fine.times[phase.first + 1 : phase.last + 1]
        curves = compute_clearance_curves(door_plan.scene, fine, times)
        others = [curve for curve in curves if not curve.name.startswith("gripper")]
        assert close <= min(float(curve.distances.min()) for curve in others) + 1e-6


@pytest.mark.parametrize(("angle", "ok"), [(0.049, False), (0.051, True)])
def test_goals_within_the_tolerance_are_accepted(
    door_plan: vkc.Plan, angle: float, ok: bool
) -> None:
    report = validate(
        door_plan.scene,
        [vkc.Actuate("door", {"hinge": 1.25})],
        door_plan.trajectory,
        tolerances=vkc.Tolerances(goal_angle=angle),
    )
    assert report.ok is ok


@pytest.mark.parametrize(
    "name", ["closure_position", "closure_angle", "goal_position", "goal_angle"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, 11.0, "1", None])
def test_invalid_tolerances_raise(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=name):
        vkc.Tolerances(**{name: value})


def test_reports_and_motions_print_in_words(door_plan: vkc.Plan) -> None:
    assert str(door_plan.report) == "\n".join(door_plan.report.lines())
    assert "every constraint holds" in str(door_plan.report)
    motion = door_plan.trajectory
    assert repr(motion).startswith(f"<Trajectory {motion.times[-1]:.1f} s, {len(motion.times)} way")
    assert all(phase.name in repr(motion) for phase in motion.phases)
    with pytest.raises(InputError, match=r"got 99\.5\)$"):
        door_plan.pose(None, np.float64(99.5))
