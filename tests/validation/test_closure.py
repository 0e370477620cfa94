"""Tests that the drift of grasps is bounded, also between samples."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from helpers.executions import plan_drawer
from helpers.small_problems import make_full_scene

import vkc_pin as vkc
from vkc_pin import Plan, Trajectory, validate
from vkc_pin.validation.closure import (
    RESOLUTION,
    find_drift,
)
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.curve import Curve

LIMITS = (vkc.Tolerances().closure_position, vkc.Tolerances().closure_angle)


@pytest.fixture(scope="module")
def plan() -> Plan:
    return plan_drawer()


def bend(trajectory: Trajectory, column: int, by: float) -> Trajectory:
    """Insert two knots into a phase with a grasp; a coordinate deviates by `by` between them."""
    curve = trajectory.curve
    assert curve is not None
    held = next(phase for phase in trajectory.phases if phase.held)
    begin, end = (float(trajectory.times[k]) for k in (held.first, held.last))
    inside = (curve.times[:-1] > begin + 1e-6) & (curve.times[1:] < end - 1e-6)
    lengths = curve.compute_max_rates()[0].max(axis=1) * np.diff(curve.times)
    k = int(np.flatnonzero(inside)[np.argmin(lengths[inside])])
    span = curve.times[k + 1] - curve.times[k]
    times = curve.times[k] + span * np.array([0.25, 0.75])
    rates = curve.velocity(times)
    rates[:, column] += np.array([4.0, -4.0]) * by / (span / 2.0)
    rows = (
        np.insert(old, k + 1, new, axis=0)
        for old, new in ((curve.positions, curve.at(times)), (curve.rates, rates))
    )
    return dataclasses.replace(trajectory, curve=Curve(np.insert(curve.times, k + 1, times), *rows))


def find_grasp_phase(samples: Samples) -> tuple[vkc.PhaseSpan, vkc.Hold]:
    phase = next(phase for phase in samples.trajectory.phases if phase.held)
    return phase, phase.holds[0]


@pytest.mark.parametrize(("by", "ok"), [(9e-4, True), (1.1e-3, False), (3e-3, False)])
def test_drift_between_two_samples_is_found(plan: Plan, by: float, ok: bool) -> None:
    trajectory = bend(plan.trajectory, 0, by)  # base x moves the hand by the same amount
    samples, times = Samples(plan.scene, trajectory), plan.trajectory.times
    report = validate(plan.scene, plan.steps, trajectory)
    found = [one for one in report.violations if one.constraint == "closure"]
    assert (not found) == ok, report
    assert report.closure_error == pytest.approx(by, abs=3e-4)  # drift of the planned motion
    for one in found:
        assert one.subject.startswith("drawer.")
        assert one.amount == pytest.approx(by - LIMITS[0], abs=3e-4)
        moments = np.linspace(*times[one.waypoint : one.waypoint + 2], 2001)
        errors = samples.compute_grasp_errors_at(find_grasp_phase(samples)[1], moments)
        assert one.amount + LIMITS[0] <= errors[:, 0].max() + RESOLUTION


@pytest.mark.parametrize("seed", range(2))
def test_largest_drift_agrees_with_a_fine_grid(plan: Plan, seed: int) -> None:
    """All coordinates follow random cubics around a grasp; the tolerance is 0."""
    rng, names, times = np.random.default_rng(seed), plan.trajectory.names, np.array([0.0, 0.7])
    phase, hold = find_grasp_phase(Samples(plan.scene, plan.trajectory))
    grasp = plan.trajectory.positions[phase.first]
    changes, rates = rng.uniform(-0.2, 0.2, (2, 2, len(names)))
    positions = grasp + np.abs(changes)
    span = dataclasses.replace(phase, first=0, last=1)
    curve, size = Curve(times, positions, rates), plan.trajectory.robot_size
    samples = Samples(plan.scene, Trajectory(names, times, positions, (span,), size, curve))
    drift = find_drift(samples, span, hold, (0.0, 0.0))
    moments = np.linspace(*times, 5001)
    fine = samples.compute_grasp_errors_at(hold, moments).max(axis=0)
    np.testing.assert_allclose(drift.measured, fine, rtol=0.0, atol=5e-6)
    assert (fine <= drift.bound + RESOLUTION).all()


@pytest.mark.parametrize("attachment", ["rail", "sleeve", "socket", "wheel", "face"])
def test_drift_of_grasps_with_freedoms_agrees_with_a_fine_grid(attachment: str) -> None:
    scene = make_full_scene()
    coordinates = scene.objects["cabinet"].object.attachments[attachment].coordinates
    names = (*scene.robot.coordinates.names, "cabinet.swing", "cabinet.slide")
    names += tuple(f"cabinet.{suffix}" for suffix in coordinates)
    rng, times = np.random.default_rng(3), np.array([0.0, 0.5])
    positions, rates = rng.uniform(-0.3, 0.3, (2, 2, len(names)))
    span = vkc.PhaseSpan("all", 0, 1, (vkc.Hold("cabinet", attachment),))
    size, curve = len(scene.start), Curve(times, positions, rates)
    samples = Samples(scene, Trajectory(names, times, positions, (span,), size, curve))
    drift = find_drift(samples, span, span.holds[0], (0.0, 0.0))
    fine = samples.compute_grasp_errors_at(span.holds[0], np.linspace(*times, 5001))
    np.testing.assert_allclose(drift.measured, fine.max(axis=0), rtol=0.0, atol=5e-6)
