"""Pauses keep the robot at rest and leave the remaining motion unchanged."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.executions import drawer_plan
from helpers.fake_plan import fake_plan

import vkc_pin as vkc
from vkc_pin.simulation.friction.pauses import insert_pauses
from vkc_pin.world.trajectory.trajectory import Trajectory


@pytest.mark.parametrize("make", [drawer_plan, fake_plan])
def test_pause_is_inserted_at_waypoint(make: object) -> None:
    motion: Trajectory = make().trajectory  # type: ignore[operator]
    at = motion.phases[1].first
    time = float(motion.times[at])
    longer = insert_pauses(motion, [at, at], 0.5)
    assert len(longer.times) == len(motion.times) + 1
    assert longer.times[-1] == pytest.approx(motion.times[-1] + 0.5)
    before, after = (
        np.linspace(0.0, time - 1e-6, 50),
        np.linspace(time + 1e-6, motion.times[-1], 50),
    )
    for read in ("at", "velocity", "acceleration"):
        one, other = getattr(longer, read), getattr(motion, read)
        np.testing.assert_allclose(one(before), other(before), atol=1e-9)
        np.testing.assert_allclose(one(after + 0.5), other(after), atol=1e-6)
    inside = time + np.linspace(1e-6, 0.5 - 1e-6, 20)
    np.testing.assert_allclose(longer.at(inside), np.tile(motion.at(time), (20, 1)), atol=1e-12)
    assert np.abs(longer.velocity(inside)).max() < 1e-9
    # The pause belongs to the phase that begins there.
    assert [(p.first, p.last) for p in longer.phases][:2] == [
        (0, at),
        (at, motion.phases[1].last + 1),
    ]
    assert [p.holds for p in longer.phases] == [p.holds for p in motion.phases]


def test_several_pauses_are_inserted() -> None:
    motion = fake_plan().trajectory
    longer = insert_pauses(motion, [3, 6], 0.25)
    assert longer.times[-1] == pytest.approx(motion.times[-1] + 0.5)
    assert [(p.first, p.last) for p in longer.phases] == [(0, 7), (7, len(motion.times) + 1)]
    assert insert_pauses(motion, [], 0.25) is motion


def test_pause_of_a_moving_curve_is_refused() -> None:
    motion = drawer_plan().trajectory
    with pytest.raises(vkc.InputError, match="while the robot moves"):
        insert_pauses(motion, [motion.phases[0].last // 2], 0.5)
