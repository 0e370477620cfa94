from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.validation.validate import validate


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
