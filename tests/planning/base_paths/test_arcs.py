"""Tests that arcs and curves roll without slip."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.planning.base_paths.arcs import Curves, find_nearest_arc, interpolate_arcs, sample_path

POSES = st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.floats(-7.0, 7.0))
TURNING = 0.3


def split_steps(path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the motion of each step along and across its mean heading, and its turn."""
    step = np.diff(path, axis=0)
    local = np.exp(-1j * (path[:-1, 2] + step[:, 2] / 2)) * (step[:, 0] + 1j * step[:, 1])
    return local.real, local.imag, step[:, 2]


def equal(pose: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two poses are equal up to full turns."""
    return bool(
        np.allclose(pose[:2], other[:2], atol=1e-6) and np.cos(pose[2] - other[2]) > 1.0 - 1e-9
    )


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.3])
@settings(deadline=None)
@given(POSES, POSES, st.integers(8, 60))
def test_every_step_of_a_curve_rolls_without_slip(
    radius: float, first: tuple[float, ...], last: tuple[float, ...], steps: int
) -> None:
    """Steps up to 0.7 rad do not slip, keep the turning radius and reach the goal."""
    a, b, curves = np.array(first), np.array(last), Curves(radius, TURNING)
    corners = curves.compute_corners(a, b)
    np.testing.assert_array_equal(corners[0], a)
    path = np.vstack([a, sample_path(corners, steps, turning=TURNING)])
    assert path.shape == (steps + 1, 3)
    assert equal(path[-1], b)
    along, aside, turn = split_steps(path)
    np.testing.assert_allclose(aside, 0.0, atol=1e-6)
    assert (np.abs(along) >= radius * np.abs(turn) - 1e-6)[np.abs(turn) < 0.7].all()
    (length,), (turned,) = curves.compute_lengths(a[None], b[None])
    assert np.abs(along).sum() <= length + 1e-6
    assert np.abs(turn).sum() == pytest.approx(turned, abs=1e-6)
    if np.abs(turn).max() < 0.3:
        assert np.abs(along).sum() == pytest.approx(length, rel=0.005, abs=1e-6)


@settings(deadline=None)
@given(POSES, st.floats(-2.0, 2.0), st.floats(-1.5, 1.5), st.floats(-0.5, 0.5), st.floats(0.0, 1.0))
def test_nearest_arc_beats_random_arcs(
    first: tuple[float, ...], dx: float, dy: float, turn: float, radius: float
) -> None:
    """The arc rolls, and no random arc ends nearer to the goal."""
    a, rng = np.array(first), np.random.default_rng(0)
    b = a + np.array([dx, dy, turn])
    (found,) = find_nearest_arc(a[None], b[None], radius=radius, turning=TURNING)
    (along,), (aside,), (turned,) = split_steps(np.array([a, found]))
    assert abs(aside) < 1e-9
    assert abs(along) >= radius * abs(turned) - 1e-6

    def error(pose: np.ndarray) -> float:
        return float(np.hypot(*(pose - b)[:2]) ** 2 + (TURNING * (pose - b)[2]) ** 2)

    for other in turn + rng.uniform(-0.79, 0.79, 50):
        heading = a[2] + other / 2
        there = dx * np.cos(heading) + dy * np.sin(heading)
        if abs(there) >= radius * abs(other):
            assert (
                error(found)
                <= error(a + np.array([there * np.cos(heading), there * np.sin(heading), other]))
                + 0.03
            )


def test_nearest_arc_ends_at_a_reachable_goal() -> None:
    rng = np.random.default_rng(0)
    first = rng.uniform(-3, 3, (200, 3))
    turn = rng.uniform(-0.7, 0.7, 200)
    chord = rng.uniform(0.75, 2.0, 200) * rng.choice([-1, 1], 200)
    last = first + np.column_stack(
        [chord * np.cos(first[:, 2] + turn / 2), chord * np.sin(first[:, 2] + turn / 2), turn]
    )
    np.testing.assert_allclose(
        find_nearest_arc(first, last, radius=1.0, turning=TURNING), last, atol=1e-9
    )


@settings(deadline=None)
@given(
    POSES,
    st.floats(-2.0, 2.0),
    st.floats(-2.0, 2.0),
    st.floats(-3.0, 3.0),
    st.floats(0.0, 1.0),
    st.floats(0.0, 1.0),
)
def test_twist_between_two_poses_is_constant(
    first: tuple[float, ...], dx: float, dy: float, turn: float, one: float, two: float
) -> None:
    """The midpoint between two poses of an arc is the pose at their mean share."""
    a = np.array([first])
    b = a + np.array([dx, dy, turn])
    np.testing.assert_allclose(interpolate_arcs(a, b, np.array([1.0])), b, atol=1e-9)
    p, q = interpolate_arcs(a, b, np.array([one])), interpolate_arcs(a, b, np.array([two]))
    np.testing.assert_allclose(
        interpolate_arcs(p, q, np.array([0.5])),
        interpolate_arcs(a, b, np.array([(one + two) / 2])),
        atol=1e-6,
    )


CORNERS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.557, 1.0], [1.0, 1.557, 0.2]])


def test_sampled_paths_stop_at_corners() -> None:
    path = sample_path(CORNERS, 20, turning=TURNING)
    for corner in CORNERS[1:]:
        assert np.abs(path - corner).max(axis=1).min() < 1e-9
    lengths = np.abs(np.diff(path, axis=0)).sum(axis=1)
    assert lengths[-1] < lengths.max() / 2


def test_paths_reach_the_end_with_fewer_steps_than_corners() -> None:
    path = sample_path(CORNERS, 2, turning=TURNING)
    assert path.shape == (2, 3)
    np.testing.assert_allclose(path[-1], CORNERS[-1], atol=1e-12)
    np.testing.assert_array_equal(
        sample_path(CORNERS[:1], 3, turning=TURNING), np.tile(CORNERS[:1], (3, 1))
    )


def test_car_curves_replace_turns_in_place() -> None:
    """The path avoids the wall. Without a wall it is the shortest curve."""
    path = np.array(
        [
            [0.0, 0.0, 1.5],
            [0.0, 4.0, 1.5],
            [0.0, 4.0, 0.0],
            [4.0, 4.0, 0.0],
            [4.0, 4.0, -1.5],
            [4.0, 0.0, -1.5],
        ]
    )
    curves = Curves(0.6, TURNING)

    def is_free(pose: np.ndarray) -> bool:
        return not (1.5 < pose[0] < 2.5 and pose[1] < 3.0)

    corners = curves.fit(path, is_free)
    np.testing.assert_array_equal(corners[0], path[0])
    assert equal(corners[-1], path[-1])
    poses = np.vstack([path[:1], sample_path(corners, 150, turning=TURNING)])
    assert all(map(is_free, poses))
    along, aside, turn = split_steps(poses)
    np.testing.assert_allclose(aside, 0.0, atol=1e-6)
    assert (np.abs(along) >= 0.6 * np.abs(turn) - 1e-6).all()
    assert np.abs(along).sum() < 1.3 * 12.0
    np.testing.assert_allclose(
        curves.fit(path, lambda _: True), curves.compute_corners(path[0], path[-1]), atol=1e-9
    )
    assert equal(curves.fit(path, lambda _: False)[-1], path[-1])
