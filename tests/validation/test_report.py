"""Reports: as text, and as plain data and back."""

from __future__ import annotations

import json
from typing import Any

import pytest

from vkc_pin.errors import InputError
from vkc_pin.validation.report import Report, Violation

ONE = Violation("limit", "elbow_joint", waypoint=4, time=1.0, amount=0.05, unit="rad", detail="3.2 rad is outside")
TWO = Violation("penetration", "forearm_link – sofa", waypoint=7, time=1.9, amount=0.01, unit="m", detail="overlap by 10.0 mm")


def test_text() -> None:
    assert Report(states=12).ok
    assert "every constraint holds" in "\n".join(Report(states=12).lines())
    text = "\n".join(Report((ONE, TWO), states=12).lines())
    assert "2 constraint(s) violated" in text
    assert "limit elbow_joint: 3.2 rad is outside (waypoint 4, 1.00 s)" in text
    assert "penetration forearm_link – sofa: overlap by 10.0 mm (waypoint 7, 1.90 s)" in text


def test_round_trip() -> None:
    for report in (
        Report((ONE, TWO), -0.01, closure_error=0.001, closure_angle=0.002, states=12, notes=("a wall is in the way",)),
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
