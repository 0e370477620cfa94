"""Tests that reports name the limits that bound the duration."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.executions import plan_door, plan_drawer

import vkc_pin as vkc
from vkc_pin.validation.limits import find_limiting_constraints
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.torques import sample_curve


@pytest.mark.parametrize("make_plan", [plan_door, plan_drawer])
def test_motion_is_at_its_limits_in_reported_intervals(make_plan: object) -> None:
    plan: vkc.Plan = make_plan()  # type: ignore[operator]
    motion, samples = plan.trajectory, Samples(plan.scene, plan.trajectory)
    found = plan.report.bounds
    assert 0.9 < sum(bound.share for bound in found) <= 1.0 + 1e-9
    assert [bound.share for bound in found] == sorted(
        (bound.share for bound in found), reverse=True
    )
    assert len({(bound.subject, bound.kind) for bound in found}) == len(found)
    for bound in found:
        assert 0.0 <= bound.begin < bound.end <= motion.times[-1] + 1e-9
        times = np.linspace(bound.begin, bound.end, 400)
        if bound.kind == "rest":
            np.testing.assert_allclose(motion.velocity(times), 0.0, atol=1e-9)
        elif bound.share > 0.1:
            evaluate, column = {
                "velocity": (motion.velocity, 2),
                "acceleration": (motion.acceleration, 3),
            }[bound.kind]
            values = np.abs(evaluate(times)[:, motion.names.index(bound.subject)])
            assert values.max() > 0.9 * samples.get_limits(bound.subject)[column]


def test_torques_bound_the_duration() -> None:
    plan = plan_door()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments = sample_curve(curve)
    torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
    torques[moments.pieces < len(curve.times) // 2, 4] = 1.5
    (first, *_) = find_limiting_constraints(samples, moments, torques, 0.0)
    assert (first.subject, first.kind) == ("shoulder_lift_joint", "torque")
    assert first.begin == 0.0


def test_longest_interval_is_reported() -> None:
    plan = plan_door()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments, pieces = sample_curve(curve), len(curve.times) - 1
    for longest in ((0, 30), (20, 50), (pieces - 30, pieces)):
        parts = [(0, 5), longest, (pieces - 5, pieces)]
        torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
        for begin, end in parts:
            torques[(moments.pieces >= begin) & (moments.pieces < end), 4] = 50.0
        first = next(
            bound
            for bound in find_limiting_constraints(samples, moments, torques, 0.0)
            if bound.kind == "torque"
        )
        lengths = {(a, b): curve.times[b] - curve.times[a] for a, b in parts}
        assert max(lengths, key=lambda part: lengths[part]) == longest, (
            "times are uneven: choose other intervals"
        )
        assert (first.begin, first.end) == (curve.times[longest[0]], curve.times[longest[1]])


def test_motion_without_curve_has_no_bounds() -> None:
    plan = plan_drawer()
    bare = dataclasses.replace(plan.trajectory, curve=None)
    assert (
        find_limiting_constraints(
            Samples(plan.scene, bare), sample_curve(plan.trajectory.curve), np.zeros((0, 0)), 0.0
        )
        == ()
    )  # type: ignore[arg-type]
