"""Reports: as text, and as plain data and back."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.validation.report import Bound, Report, Violation
from vkc_pin.visualization.plots.clearance import compute_clearance_curves

ONE = Violation(
    "limit",
    "elbow_joint",
    waypoint=4,
    time=1.0,
    amount=0.05,
    unit="rad",
    detail="3.2 rad is outside",
)
TWO = Violation(
    "penetration",
    "forearm_link – sofa",
    waypoint=7,
    time=1.9,
    amount=0.01,
    unit="m",
    detail="overlap by 10.0 mm",
)


def test_text() -> None:
    assert Report(states=12).ok
    assert "every constraint holds" in "\n".join(Report(states=12).lines())
    text = "\n".join(Report((ONE, TWO), states=12).lines())
    assert "2 constraint(s) violated" in text
    assert "limit elbow_joint: 3.2 rad is outside (waypoint 4, 1.00 s)" in text
    assert "penetration forearm_link – sofa: overlap by 10.0 mm (waypoint 7, 1.90 s)" in text


def test_what_nobody_says_is_nothing() -> None:
    assert (Report().states, Report().torque, Report().clearance) == (0, 0.0, np.inf)
    plain = Violation("goal", "base", amount=1.0, unit="m", detail="far")
    assert (plain.waypoint, plain.time) == (0, 0.0)


def test_text_names_four_bounds_and_twelve_violations() -> None:
    every = tuple(
        Bound(f"joint_{k}", "velocity", share=0.1, begin=k, end=k + 1.0) for k in range(6)
    )
    (told,) = Report(bounds=every).timing()
    assert [f"joint_{k}" in told for k in range(6)] == [True] * 4 + [False] * 2
    lines = Report((ONE,) * 14).lines()
    assert sum("limit elbow_joint" in line for line in lines) == 12
    assert "... and 2 more" in lines[-1]
    assert len(Report((ONE,) * 12).lines()) == 13  # and nothing of "0 more"


def test_reports_that_say_otherwise() -> None:
    one = Report((ONE,), 0.01, closure_error=1e-4, closure_angle=0.0)
    assert one.contradictions(one) == []
    assert one.contradictions(Report((ONE,), 0.010005, closure_error=1e-4)) == []
    assert one.contradictions(Report((ONE,), 0.02, closure_error=1e-4)) == [
        "clearance 0.02 m instead of 0.01 m"
    ]
    assert one.contradictions(Report((ONE,), 0.01, closure_error=1e-4, closure_angle=0.5)) == [
        "closure_angle 0.5 rad instead of 0 rad"
    ]
    assert one.contradictions(Report((), 0.01, closure_error=1e-4)) == ["every constraint holds"]


def test_round_trip() -> None:
    for report in (
        Report(
            (ONE, TWO),
            -0.01,
            closure_error=0.001,
            closure_angle=0.002,
            states=12,
            notes=("a wall is in the way",),
        ),
        Report(),
    ):
        assert Report.from_dict(json.loads(json.dumps(report.to_dict()))) == report
    assert not Report((ONE,)).ok


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        (("violations", 0, "time"), "soon", "violations[0].time"),
        (("violations", 0, "amount"), None, "violations[0].amount"),
        (("violations", 1, "subject"), 3, "violations[1].subject"),
        (("violations", 1, "waypoint"), -1, "violations[1].waypoint"),
        (("violations", 1, "more"), 1, "violations[1]"),
        (("violations",), 3, "violations"),
        (("violations",), [3], "violations[0]"),
        (("notes",), [3], "notes[0]"),
        (("clearance",), "near", "clearance"),
        (("closure_error",), 10**500, "closure_error"),
        (("states",), 1.5, "states"),
        (("more",), 1.5, None),
    ],
)
def test_what_is_no_report(path: tuple[str | int, ...], value: object, field: str | None) -> None:
    data: Any = Report((ONE, TWO), states=12).to_dict()
    data["violations"] = list(data["violations"])
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(InputError) as caught:
        Report.from_dict(data)
    assert caught.value.field == field


def test_a_line_for_each_phase_says_when_how_far_and_how_close(door_plan: vkc.Plan) -> None:
    report, motion = door_plan.validation, door_plan.trajectory
    assert min(report.clearances) == report.clearance
    assert len(report.clearances) == len(motion.phases)
    parts = motion.parts()
    assert sum(part.base_effort() for part in parts) == pytest.approx(motion.base_effort())
    assert sum(part.arm_effort() for part in parts) == pytest.approx(motion.arm_effort())
    for line, part, phase, close in zip(
        report.by_phase(motion), parts, motion.phases, report.clearances, strict=True
    ):
        numbers = [
            float(number) for number in re.findall(r"-?[\d.]+(?= (?:to|s|m|rad|mm)\b)", line)
        ]
        first, last = motion.times[[phase.first, phase.last]]
        np.testing.assert_allclose(
            numbers, [first, last, part.base_effort(), part.arm_effort(), 1e3 * close], atol=0.06
        )
        assert line.endswith(phase.name)
    assert Report.from_dict(json.loads(json.dumps(report.to_dict()))) == report


def test_each_phase_has_the_clearance_of_its_own_motion(door_plan: vkc.Plan) -> None:
    """The curves that are plotted are asked of coal in another way."""
    fine = door_plan.trajectory
    for phase, close in zip(fine.phases, door_plan.validation.clearances, strict=True):
        times = fine.times[phase.first + 1 : phase.last + 1]
        curves = compute_clearance_curves(door_plan.scene, fine, times)
        least = min(
            float(curve.distances.min()) for curve in curves if not curve.name.startswith("gripper")
        )
        assert close <= least + 1e-6
