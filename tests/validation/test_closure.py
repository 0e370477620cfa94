"""Grasps are bounded at every moment of a motion, between samples as well."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.options import Options
from vkc_pin.planning.plan import Plan
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation.closure import (
    RESOLUTION,
    _bound_position_acceleration,
    _bound_rates,
    _bound_rotation_acceleration,
    _find_grasp_levers,
    _find_hand_levers,
    _maximize,
    find_drift,
)
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory

LIMITS = (Options().closure_position, Options().closure_angle)


@pytest.fixture(scope="module")
def plan() -> Plan:
    found = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    assert found.success, found.report()
    return found


def bent(trajectory: Trajectory, column: int, by: float) -> Trajectory:
    """Return a motion with two more knots in a held phase, between which it bends aside by so much.

    All knots are where the motion is, so that nothing shows there.
    """
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


def held_phase(samples: Samples) -> tuple[vkc.PhaseSpan, vkc.Hold]:
    phase = next(phase for phase in samples.trajectory.phases if phase.held)
    return phase, phase.holds[0]


@pytest.mark.parametrize(("by", "right"), [(9e-4, True), (1.1e-3, False), (3e-3, False)])
def test_a_drift_between_two_samples_is_found(plan: Plan, by: float, right: bool) -> None:
    trajectory = bent(plan.trajectory, 0, by)  # base x, which moves the hand by as much
    report = validate(plan.scene, plan.steps, trajectory)
    found = [one for one in report.violations if one.constraint == "closure"]
    assert (not found) == right, report
    assert report.closure_error == pytest.approx(
        by, abs=3e-4
    )  # what the motion drifts by there already
    for one in found:
        assert one.subject.startswith("drawer.")
        assert one.amount == pytest.approx(by - LIMITS[0], abs=3e-4)
        moments = np.linspace(
            plan.trajectory.times[one.waypoint], plan.trajectory.times[one.waypoint + 1], 2001
        )
        samples = Samples(plan.scene, trajectory)
        _, hold = held_phase(samples)
        assert (
            one.amount + LIMITS[0]
            <= samples.compute_grasp_errors_at(hold.object, hold.attachment, moments)[:, 0].max()
            + RESOLUTION
        )


def test_the_largest_drift_is_that_of_a_fine_grid(plan: Plan) -> None:
    for by in (7e-4, 8e-4, 9e-4):
        samples = Samples(plan.scene, bent(plan.trajectory, 1, by))
        phase, hold = held_phase(samples)
        drift = find_drift(samples, phase, hold, LIMITS)
        moments = np.linspace(*samples.trajectory.times[[phase.first, phase.last]], 40_001)
        fine = samples.compute_grasp_errors_at(hold.object, hold.attachment, moments).max(axis=0)
        assert drift.measured[0] == pytest.approx(fine[0], abs=2e-6)
        assert np.all(fine <= np.maximum(drift.bound + RESOLUTION, 0.5 * np.array(LIMITS)))


@given(seed=st.integers(0, 2**32 - 1), speed=st.floats(0.05, 2.0))
@settings(max_examples=25, deadline=None)
def test_second_derivatives_stay_below_their_bounds(plan: Plan, seed: int, speed: float) -> None:
    """Of random cubics of all coordinates, by finite differences of numeric Pinocchio's placements."""
    rng, names = np.random.default_rng(seed), plan.trajectory.names
    times = np.array([0.0, 0.7])
    positions, rates = rng.uniform(-1.0, 1.0, (2, 2, len(names)))
    slide = names.index("drawer.slide")
    positions[:, slide] = rng.uniform(0.0, 0.3, 2)
    curve = Curve(times, positions * speed, rates * speed)
    phase, hold = next((phase, phase.holds[0]) for phase in plan.trajectory.phases if phase.held)
    span = dataclasses.replace(phase, first=0, last=1)
    trajectory = Trajectory(
        names, times, positions * speed, (span,), plan.trajectory.robot_size, curve
    )
    samples = Samples(plan.scene, trajectory)
    chains = _find_hand_levers(samples, span, hold), _find_grasp_levers(samples, hold)
    velocity, acceleration = _bound_rates(trajectory, times[:1], times[1:])
    h = 1e-3
    moments = np.linspace(0.01, 0.69, 60)
    values = [placements(samples, hold, moments + k * h) for k in (-1.0, 0.0, 1.0)]
    second = (values[0] - 2.0 * values[1] + values[2]) / h**2
    position = sum(
        _bound_position_acceleration(chain, velocity, acceleration)[0] for chain in chains
    )
    assert np.linalg.norm(second[:, :3], axis=1).max() <= position * 1.001 + 1e-3
    rotation = _bound_rotation_acceleration([*chains[0], *chains[1]], velocity, acceleration)[0]
    assert np.linalg.norm(second[:, 3:], axis=1).max() <= rotation * 1.001 + 1e-3


def placements(samples: Samples, hold: vkc.Hold, times: Floats) -> Floats:
    """Return the offset of the tool from the handle and the axial vector of their relative rotation, shape (K, 6)."""
    z = samples.world.compute_positions(samples.trajectory, times, samples.free_objects)
    attachment = samples.scene.objects[hold.object].object.attachments[hold.attachment]
    turns, origins = samples._compute_frames(
        z, samples.scene.robot.tool_frame, f"{hold.object}.{attachment.link}"
    )
    own = [
        samples.trajectory.names.index(f"{hold.object}.{name}") for name in attachment.coordinates
    ]
    rows = samples.trajectory.at(times)[:, own]
    found = []
    for turn, origin, row in zip(turns, origins, rows, strict=True):
        tool = attachment.tool(row)
        relative = (turn[1] @ tool.rotation).T @ turn[0]
        skew = 0.5 * (relative - relative.T)
        found.append(
            [
                *(origin[0] - origin[1] - turn[1] @ tool.translation),
                skew[2, 1],
                skew[0, 2],
                skew[1, 0],
            ]
        )
    return np.array(found)


@given(at=st.floats(0.05, 0.95), width=st.floats(0.02, 0.5), height=st.floats(0.6e-3, 0.99e-3))
@settings(max_examples=50, deadline=None)
def test_a_peak_between_samples_is_found_from_the_bound_of_its_curvature(
    at: float, width: float, height: float
) -> None:
    def evaluate(times: Floats) -> Floats:
        bump = height * np.exp(-(((times - at) / width) ** 2))
        return np.column_stack([bump, 0.0 * bump])

    def bound_curvature(begin: Floats, end: Floats) -> Floats:
        return np.column_stack([np.full(len(begin), 2.0 * height / width**2), np.zeros(len(end))])

    times = np.array([0.0, 1.0])
    drift = _maximize(times, evaluate(times), evaluate, bound_curvature, np.array(LIMITS))
    assert drift.measured[0] == pytest.approx(height, abs=2 * RESOLUTION)
    assert drift.bound[0] <= LIMITS[0]
    assert drift.times[0] == pytest.approx(at, abs=width * 0.1)


def test_an_error_that_is_not_proven_small_is_refused() -> None:
    """A bound that bisection never brings below the limit, as of a curve with an infinite acceleration."""
    times = np.linspace(0.0, 1.0, 3)
    drift = _maximize(
        times,
        np.full((3, 2), 1e-4),
        lambda moments: np.full((len(moments), 2), 1e-4),
        lambda begin, end: np.full((len(begin), 2), np.inf),
        np.array(LIMITS),
    )
    assert np.all(drift.measured == 1e-4)
    assert np.all(drift.bound > LIMITS)


def test_differential_bases_do_not_drift_where_a_held_phase_begins() -> None:
    scene, steps = vkc.random_task(50027)
    document = scene.document
    given_robot = document["robot"]
    robot = {"name": given_robot} if isinstance(given_robot, str) else dict(given_robot)
    scene = Scene.from_document(
        {**document, "robot": {**robot, "base": "differential"}}, scene.folder
    )
    plan = vkc.plan(scene, list(steps), seed=27)
    assert plan.success, plan.report()
    samples = Samples(scene, plan.trajectory)
    for phase in plan.trajectory.phases:
        moments = np.linspace(*plan.trajectory.times[[phase.first, phase.last]], 4001)
        for hold in phase.holds:
            errors = samples.compute_grasp_errors_at(
                hold.object, hold.attachment, moments, hold.frame
            )
            assert np.all(errors.max(axis=0) <= LIMITS)
