"""Tests that step durations fit a profile and that runs beyond a bound are stretched."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.nlp.timing import Timing, compute_step_times, split_at_stops


def test_runs_are_split_at_stops() -> None:
    assert list(split_at_stops([], 7)) == [(0, 7)]
    assert list(split_at_stops([2, 5], 7)) == [(0, 2), (2, 5), (5, 7)]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 30.0]))
def test_profile_keeps_the_limits_in_the_time(seed: int, size: float) -> None:
    """A motion along 3s² − 2s³ in each run keeps both limits, by finite differences."""
    rng = np.random.default_rng(seed)
    rests = sorted(rng.choice(np.arange(1, 12), 2, replace=False).tolist())
    runs, limits = split_at_stops(rests, 12), (rng.uniform(0.3, 3.0, 4), rng.uniform(0.3, 6.0, 4))
    path = np.cumsum(size * rng.normal(size=(13, 4)), axis=0)
    times = compute_step_times(path, 0.1, runs, limits)
    assert (times >= 0.1).all()
    fine = np.linspace(0.0, 1.0, 401)
    profile = fine**2 * (3.0 - 2.0 * fine)
    for first, last in runs:
        assert np.ptp(times[first:last]) == 0.0
        distance = np.abs(np.diff(path[first : last + 1], axis=0)).sum(axis=0)
        duration = times[first:last].sum()
        step = duration / 400
        speed, strength = (
            np.abs(np.diff(profile, order)).max() / step**order * distance for order in (1, 2)
        )
        assert (speed <= limits[0]).all()
        assert (strength <= limits[1]).all()
        if times[first] > 0.1:  # no longer than needed, apart from the margin
            assert (
                max((1.15 * speed / limits[0]).max(), (1.15**2 * strength / limits[1]).max()) > 0.98
            )


def compute_differences(
    path: np.ndarray, runs: list[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return steps and their differences, from and to rest in every run."""
    steps = np.diff(path, axis=0)
    zero = np.zeros((1, path.shape[1]))
    return steps, np.vstack([np.diff(np.vstack([zero, steps[a:b], zero]), axis=0) for a, b in runs])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1.8))
def test_runs_are_stretched_as_needed_up_to_a_limit(seed: int, size: float) -> None:
    rng, runs = np.random.default_rng(seed), [(0, 5), (5, 6), (6, 12)]
    limits, dt = (np.full(3, 1.0), np.full(3, 4.0)), np.repeat([0.5, 1.0, 0.8], [5, 1, 6])
    timing = Timing(dt, dt, runs, limits, np.zeros((2, 3)))
    first, second = compute_differences(
        np.cumsum(0.5 * size * rng.uniform(-0.5, 0.5, (13, 3)), axis=0), runs
    )
    assert timing.velocity.shape == first.shape
    assert timing.acceleration.shape == second.shape
    longer, violations = timing.stretch(first, second), []
    for number, (a, b) in enumerate(runs):
        part, strong = first[a:b], second[a + number : b + number + 1]
        speed, strength = np.abs(part).max() / dt[a], np.abs(strong).max() / 4.0 / dt[a] ** 2
        violations.append(max(speed, strength) - 1.0)
        excess = max(speed, np.sqrt(strength))
        assert longer.dt[a:b] == pytest.approx(dt[a] * np.clip(1.001 * excess, 1.0, 1.5))
    assert timing.compute_violation(first, second) == pytest.approx(max(violations))
    if (longer.dt < 1.5 * dt).all():
        assert longer.compute_violation(first, second) <= 0.0
    np.testing.assert_array_equal(timing.dt, dt)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_stretched_steps_keep_the_velocities_at_the_ends(seed: int) -> None:
    """Any factor from the returned one on keeps all bounds; a smaller one does not."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.uniform(-0.3, 0.3, (5, 2)), axis=0)
    velocities = rng.uniform(-0.5, 0.5, (2, 2))
    steps = np.diff(path, axis=0)

    def compute_excess(dt: float) -> float:
        timing = make_timing(dt)
        outer = np.vstack([velocities[0] * dt, steps, velocities[1] * dt])
        return timing.compute_violation(steps, np.diff(outer, axis=0))

    def make_timing(dt: float) -> Timing:
        limits = (np.full(2, 1e3), np.full(2, 2.0))
        return Timing(np.full(4, dt), np.full(4, 10.0), [(0, 4)], limits, velocities)

    outer = np.vstack([velocities[0] * 0.02, steps, velocities[1] * 0.02])
    stretched = make_timing(0.02).stretch(steps, np.diff(outer, axis=0)).dt[0] / 1.001
    for factor in (1.0, 1.1, 2.0, 8.0):
        assert compute_excess(factor * stretched) <= 1e-9
    if stretched > 0.021:
        assert compute_excess(0.999 * stretched) > 0.0


@pytest.mark.parametrize("velocity", [-0.3, 0.2])
def test_strongest_steps_at_moving_ends_are_parabolas(velocity: float) -> None:
    """From a velocity v, the acceleration a leads to v·dt + a·dt²/2 in a step."""
    dt, limit = 0.1, 2.0
    limits, velocities = (np.full(1, 1e3), np.full(1, limit)), np.full((2, 1), velocity)
    timing = Timing(np.full(2, dt), np.full(2, dt), [(0, 2)], limits, velocities)
    strongest = np.full((2, 1), velocity * dt + limit * dt**2 / 2.0)
    outer = np.vstack([velocities[:1] * dt, strongest, velocities[1:] * dt])
    assert timing.compute_violation(strongest, np.diff(outer, axis=0)) == pytest.approx(0.0)
    at_rest = Timing(np.full(2, dt), np.full(2, dt), [(0, 2)], limits, np.zeros((2, 1)))
    assert at_rest.acceleration[:, 0] == pytest.approx(np.full(3, limit * dt**2))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_cubic_with_velocities_at_its_ends_keeps_the_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path = np.cumsum(0.1 * rng.uniform(-1.0, 1.0, (2, 3)), axis=0)
    limits = (np.full(3, 1e3), rng.uniform(0.5, 4.0, 3))
    begin, end = velocities = rng.uniform(-1.0, 1.0, (2, 3))
    (T,) = compute_step_times(path, 1e-3, [(0, 1)], limits, end_velocities=velocities)
    change = path[1] - path[0]
    strongest = [6.0 * change / T**2 - (4.0 * begin + 2.0 * end) / T]
    strongest.append(-6.0 * change / T**2 + (2.0 * begin + 4.0 * end) / T)
    assert (np.abs(strongest) <= limits[1]).all()


@pytest.mark.parametrize(("needed", "violation"), [(0.1, -0.5), (0.2, 0.0), (0.5, 1.5)])
def test_steps_take_as_long_as_they_need_for_other_reasons(needed: float, violation: float) -> None:
    """Such as wheels, whose speed is limited, too."""
    dt = np.full(2, 0.2)
    limits = (np.full(1, 1e3), np.full(1, 1e3))
    timing = Timing(dt, dt, [(0, 2)], limits, np.zeros((2, 1)))
    steps = np.zeros((2, 1))
    changes = np.zeros((3, 1))
    found = timing.compute_violation(steps, changes, np.array([0.1, needed]))
    assert found == pytest.approx(violation)
    stretched = timing.stretch(steps, changes, np.array([0.1, needed]))
    assert (stretched.dt > 1.01 * dt).all() == (violation > 0.0)
