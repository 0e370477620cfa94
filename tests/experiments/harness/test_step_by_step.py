"""Tests step-by-step planning, which ends at the first failure."""

from __future__ import annotations

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.experiments.harness.step_by_step import combine_records, plan_step_by_step


def test_steps_are_planned_from_the_end_of_the_previous_one() -> None:
    steps = [vkc.GoTo(-0.4, 0.5), vkc.GoTo(0.6, 0.0), vkc.GoTo(-1.5, -1.45), vkc.GoTo(-0.7, 0.3)]
    plans = plan_step_by_step(vkc.load_scene("door"), steps, options=vkc.Options(), seed=3)
    assert [one.success for one in plans] == [True, True, False], "the third leads into the sofa"
    first, second, third = plans
    np.testing.assert_allclose(
        second.trajectory.positions[0], first.trajectory.positions[-1], atol=1e-9
    )
    assert [one.seed for one in plans] == [3, 3, 3]

    record = combine_records(plans, 4, method="step by step", seed=3, number=0)
    assert (record["success"], record["steps_done"], record["number"]) == (False, 2, 0)
    assert record["base_path_length"] == pytest.approx(
        sum(one.metrics["base_path_length"] for one in plans)
    )
    assert record["clearance"] == min(one.metrics["clearance"] for one in plans)
    assert record["status"] == third.status
    assert "steps[2]" in record["failed_constraint"]

    record = combine_records(plans[:2], 2, method="step by step", seed=3)
    assert (record["success"], record["failed_constraint"], record["steps_done"]) == (True, None, 2)
