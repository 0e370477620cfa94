"""What reports say, word by word, and what they take back from plain data."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.drives import hall, moved, of_rows

from vkc_pin.errors import InputError
from vkc_pin.validation.report import AGREEMENT_TOLERANCE, Bound, Report, Violation
from vkc_pin.world.trajectory.phase_span import PhaseSpan

WRONG = Violation(
    "limit",
    "elbow_joint",
    waypoint=4,
    time=1.0,
    amount=0.05,
    unit="rad",
    detail="3.2 rad is outside",
)
FAST = Bound("base_x", "velocity", share=0.625, begin=1.0, end=2.5)
REST = Bound("", "rest", share=0.25, begin=0.0, end=1.0)
FULL = Report(
    (WRONG,),
    -0.01,
    closure_error=0.001,
    closure_angle=0.002,
    clearances=(0.3, -0.01),
    states=12,
    notes=("a wall is in the way",),
    torque=0.5,
    bounds=(FAST, REST),
    remarks=("no masses",),
)


def test_defaults() -> None:
    assert vars(Report()) == {
        "violations": (),
        "clearance": math.inf,
        "closure_error": 0.0,
        "closure_angle": 0.0,
        "clearances": (),
        "states": 0,
        "notes": (),
        "torque": 0.0,
        "bounds": (),
        "remarks": (),
        "exemptions": (),
    }


def test_lines_of_a_report() -> None:
    assert Report(states=3).lines() == [
        "validation  3 configurations checked: every constraint holds"
    ]
    assert FULL.lines() == [
        "validation  12 configurations checked: 1 constraint(s) violated",
        "  - limit elbow_joint: 3.2 rad is outside (waypoint 4, 1.00 s)",
        "  because a wall is in the way",
    ]
    assert Report((WRONG,) * 13).lines()[-1] == "  ... and 1 more"


def test_lines_of_what_bounds_a_motion() -> None:
    assert Report().timing() == []
    assert FULL.timing() == [
        "bounded by  base_x velocity 62 % (1.0 to 2.5 s), rest 25 % (0.0 to 1.0 s)",
        "torques     at most 50 % of the motors' limits",
        "unknown     no masses",
    ]
    assert Report(torque=0.5).timing() == ["torques     at most 50 % of the motors' limits"]
    assert FULL.measures() == {"clearance": -0.01, "closure_error": 0.001, "torque": 0.5}


def test_lines_of_phases() -> None:
    scene = hall()
    rows = np.array([moved(scene.start, x=x) for x in (0.0, 1.0, 3.0)])
    rows[1:, 5] += 0.5
    motion = of_rows(scene, rows, dt=2.0, phases=(PhaseSpan("one", 0, 1), PhaseSpan("two", 1, 2)))
    assert Report(clearances=(0.25, 0.1)).by_phase(motion) == [
        "   0.0 to    2.0 s: base  1.00 m, arm  0.50 rad,  250.0 mm, one",
        "   2.0 to    4.0 s: base  2.00 m, arm  0.00 rad,  100.0 mm, two",
    ]
    assert [
        line.endswith("inf mm, " + name)
        for line, name in zip(Report().by_phase(motion), ("one", "two"), strict=True)
    ] == [True] * 2
    with pytest.raises(ValueError, match="zip"):
        Report(clearances=(0.25,)).by_phase(motion)  # of another motion


def test_with_reasons_only_the_violations_are_others() -> None:
    other = FULL.with_reasons([WRONG, WRONG])
    assert vars(other) == {**vars(FULL), "violations": (WRONG, WRONG)}


@pytest.mark.parametrize(
    ("off", "told"),
    [(0.9 * AGREEMENT_TOLERANCE, False), (1.5 * AGREEMENT_TOLERANCE, True), (math.nan, True)],
)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("field", ["clearance", "closure_error", "closure_angle"])
def test_numbers_that_are_the_same_or_not(field: str, off: float, sign: float, told: bool) -> None:
    assert AGREEMENT_TOLERANCE == 1e-5  # [m] or [rad], as the pages say
    one = Report(clearance=0.5, closure_error=0.5, closure_angle=0.5)
    other = Report(
        **{"clearance": 0.5, "closure_error": 0.5, "closure_angle": 0.5, field: 0.5 + sign * off}
    )
    lines = one.contradictions(other)
    assert len(lines) == told
    assert all(line.startswith(f"{field} ") for line in lines)


def test_where_nothing_can_collide_two_reports_are_the_same() -> None:
    assert Report().contradictions(Report()) == []
    assert Report().contradictions(Report(clearance=0.5)) == ["clearance 0.5 m instead of inf m"]
    assert Report().contradictions(Report((WRONG,))) == ["1 constraint(s) violated"]
    assert Report((WRONG,)).contradictions(Report()) == ["every constraint holds"]


def test_plain_data_and_back() -> None:
    assert Report.from_dict(FULL.to_dict()) == FULL
    early = Report(
        (Violation("start", "base_x", amount=1.0, unit="m", detail="off"),), states=0, torque=0.0
    )
    assert Report.from_dict(early.to_dict()) == early


def test_old_data_lack_what_reports_did_not_say_then() -> None:
    data = FULL.to_dict()
    for name in ("clearances", "states", "torque", "bounds", "remarks", "closure_angle"):
        del data[name]
    found = Report.from_dict(data)
    assert found == Report((WRONG,), -0.01, closure_error=0.001, notes=("a wall is in the way",))


def test_numpy_and_whole_numbers_are_numbers() -> None:
    data = {
        **FULL.to_dict(),
        "clearance": 1,
        "clearances": [1, 2.0],
        "torque": 1,
        "closure_error": np.float64(0.5),
    }
    found = Report.from_dict(data)
    assert (found.clearance, found.clearances, found.torque, found.closure_error) == (
        1.0,
        (1.0, 2.0),
        1.0,
        0.5,
    )


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"clearances": ["near"]}, "clearances[0]"),
        ({"clearances": 3}, "clearances"),
        ({"states": -1}, "states"),
        ({"notes": [3]}, "notes[0]"),
        ({"notes": 3}, "notes"),
        ({"remarks": [3]}, "remarks[0]"),
        ({"remarks": 3}, "remarks"),
        ({"torque": -0.1}, "torque"),
        ({"torque": "much"}, "torque"),
        ({"bounds": 3}, "bounds"),
        ({"bounds": [3]}, "bounds[0]"),
        ({"bounds": [{**vars(FAST), "share": "half"}]}, "bounds[0].share"),
        ({"bounds": [vars(FAST), {**vars(FAST), "end": math.inf}]}, "bounds[1].end"),
        ({"bounds": [{**vars(FAST), "begin": None}]}, "bounds[0].begin"),
        ({"bounds": [{**vars(FAST), "subject": 3}]}, "bounds[0].subject"),
        ({"bounds": [{**vars(FAST), "kind": None}]}, "bounds[0].kind"),
        ({"bounds": [{**vars(FAST), "more": 1}]}, "bounds[0]"),
        ({"violations": [{**vars(WRONG), "waypoint": -1}]}, "violations[0].waypoint"),
        ({"violations": [{**vars(WRONG), "time": "soon"}]}, "violations[0].time"),
        ({"violations": [{**vars(WRONG), "detail": None}]}, "violations[0].detail"),
        ({"closure_angle": "none"}, "closure_angle"),
    ],
)
def test_what_is_of_another_kind_is_named(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError) as caught:
        Report.from_dict({**FULL.to_dict(), **change})
    assert caught.value.field == field


def test_a_report_must_be_a_mapping() -> None:
    with pytest.raises(InputError) as caught:
        Report.from_dict(SimpleNamespace())  # type: ignore[arg-type]
    assert caught.value.field == "report"
