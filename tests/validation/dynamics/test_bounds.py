"""What bounds the duration of a motion."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.executions import door_plan, drawer_plan

import vkc_pin as vkc
from vkc_pin.validation.dynamics.bounds import find_limiting_constraints
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.dynamics.torques import sample_curve


@pytest.mark.parametrize("made", [door_plan, drawer_plan])
def test_bounds_share_the_duration_and_limits_are_reached_where_they_say(made: object) -> None:
    plan: vkc.Plan = made()  # type: ignore[operator]
    motion, samples = plan.trajectory, Samples(plan.scene, plan.trajectory)
    found = plan.validation.bounds
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
            read, place = {
                "velocity": (motion.velocity, 2),
                "acceleration": (motion.acceleration, 3),
            }[bound.kind]
            values = np.abs(read(times)[:, motion.names.index(bound.subject)])
            assert values.max() > 0.9 * samples.get_limits(bound.subject)[place]


def test_torques_count_as_any_other_limit() -> None:
    plan = door_plan()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments = sample_curve(curve)
    torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
    torques[moments.pieces < len(curve.times) // 2, 4] = 1.5
    (first, *_) = find_limiting_constraints(samples, moments, torques, 0.0)
    assert (first.subject, first.kind) == ("shoulder_lift_joint", "torque")
    assert first.begin == 0.0


def test_of_several_stretches_the_longest_is_named() -> None:
    """Wherever in the motion: at its begin, in between, or at its end."""
    plan = door_plan()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments, pieces = sample_curve(curve), len(curve.times) - 1
    for long in ((0, 30), (20, 50), (pieces - 30, pieces)):
        parts = [(0, 5), long, (pieces - 5, pieces)]
        torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
        for begin, end in parts:
            torques[(moments.pieces >= begin) & (moments.pieces < end), 4] = 50.0
        first = next(
            bound
            for bound in find_limiting_constraints(samples, moments, torques, 0.0)
            if bound.kind == "torque"
        )
        lengths = {(a, b): curve.times[b] - curve.times[a] for a, b in parts}
        assert max(lengths, key=lambda part: lengths[part]) == long, (
            "times are uneven: choose other stretches"
        )
        assert (first.begin, first.end) == (curve.times[long[0]], curve.times[long[1]])


def test_what_bounds_a_two_hundredth_of_the_duration_is_told_of() -> None:
    plan = door_plan()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments, shares = sample_curve(curve), np.diff(curve.times) / curve.times[-1]
    number = {
        told: int(np.argmin(np.abs(shares - share)))
        for told, share in ((True, 0.0075), (False, 0.002))
    }
    assert 0.005 < shares[number[True]] < 0.01, "no cubic takes so long: choose several"
    assert shares[number[False]] < 0.005
    for told, piece in number.items():
        torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
        torques[moments.pieces == piece, 4] = 50.0
        assert (
            "torque"
            in {bound.kind for bound in find_limiting_constraints(samples, moments, torques, 0.0)}
        ) == told


def test_without_a_curve_nothing_is_said() -> None:
    plan = drawer_plan()
    bare = dataclasses.replace(plan.trajectory, curve=None)
    assert (
        find_limiting_constraints(
            Samples(plan.scene, bare), sample_curve(plan.trajectory.curve), np.zeros((0, 0)), 0.0
        )
        == ()
    )  # type: ignore[arg-type]
