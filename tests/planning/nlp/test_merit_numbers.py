"""Tests violations and penalties with made-up numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.planning.nlp.merit import (
    Infeasibility,
    Merit,
    compute_shortfalls,
    measure_infeasibility,
)


def contacts(*rows: tuple[int, float, float]) -> Contacts:
    """Return contacts of (waypoint, distance, margin)."""
    table = np.array(rows, float).reshape(-1, 3)
    vectors = np.zeros((len(table), 3))
    return Contacts(
        table[:, 0].astype(int),
        np.zeros((len(table), 2), int),
        table[:, 1],
        table[:, 2],
        vectors,
        vectors,
        vectors,
    )


NEAR = contacts((0, 0.01, 0.03), (0, 0.5, 0.02), (0, 0.0, 0.5), (2, -0.25, 0.25), (2, 0.02, 0.02))


def test_shortfalls_of_pairs_with_planes() -> None:
    np.testing.assert_allclose(
        compute_shortfalls(NEAR, 3, 2), [[0.02, 0.0], [0.0, 0.0], [0.5, 0.0]]
    )
    np.testing.assert_allclose(
        compute_shortfalls(NEAR, 3, 3), [[0.02, 0.0, 0.5], [0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]
    )
    np.testing.assert_allclose(compute_shortfalls(NEAR, 4, 1)[:, 0], [0.02, 0.0, 0.5, 0.0])


def goal(kind: str, waypoints: tuple[int, ...]) -> Any:
    """Return a goal at the origin for the second of three joints."""
    return SimpleNamespace(
        row=PoseRow(1, pin.SE3.Identity(), waypoints, kind), target=pin.SE3.Identity()
    )


def measure_example(*, rates: bool = False, goals: Any = None) -> Infeasibility:
    """Return what is missing along three waypoints of one coordinate.

    The second joint is at (3, 4, 12) · waypoint, turned about z by a tenth of it.
    """
    turns = np.array(
        [[pin.utils.rotate("z", 0.1 * k * (j == 1)) for j in range(3)] for k in (1, 2, 3)]
    )
    places = np.array(
        [[np.array([3.0, 4.0, 12.0]) * k * (j == 1) for j in range(3)] for k in (1, 2, 3)]
    )
    z = np.array([[1.0], [2.0], [3.0]])
    given: list[Any] = []
    problem: Any = SimpleNamespace(
        transcription=SimpleNamespace(
            slots=2, row_waypoints=np.array([0, 0, 2, 1]), rate_waypoints=np.array([0, 1, 2, 0, 2])
        ),
        pose_goals=[goal("pose", (1, 3)), goal("point", (2,)), goal("pose", ())]
        if goals is None
        else goals,
        chain=SimpleNamespace(joint_placements=lambda at: (turns, places)),
        excess=lambda at, timing, rates: (
            given.append((timing, rates)) or np.array([1.0, -2.0, 0.5, -0.25])
        ),
        row_kinds={
            "rolling": np.array([1.0, 0.0, 0.0, 0.0]),
            "clamped": np.array([0.0, 1.0, 0.0, 0.0]),
            "terms": np.array([0.0, 0.0, 0.5, 2.0]),
        },
        rates=lambda at: (np.array([[5.0], [-3.0], [1.0]]), np.array([[-9.0], [2.0]])),
    )
    timing: Any = SimpleNamespace(velocity=np.full((3, 1), 2.0), acceleration=np.full((2, 1), 4.0))
    found = measure_infeasibility(problem, z, timing, NEAR, rates=rates)
    assert given == [(timing, rates)]
    return found


def test_violation_of_each_kind_at_each_waypoint() -> None:
    found = measure_example()
    assert {kind: amount.tolist() for kind, amount in found.amounts.items()} == {
        "poses": pytest.approx([13.0 + 0.1, 26.0, 39.0 + 0.3]),
        "rolling": [1.0, 0.0, 0.0],
        "clamped": [2.0, 0.0, 0.0],
        "terms": [0.0, 0.5, 0.25],
        "rates": [0.0, 0.0, 0.0],
        "clearance": pytest.approx([0.02, 0.0, 0.5]),
    }
    assert found.excess.tolist() == [1.0, -2.0, 0.5, -0.25]
    assert found.rate_excess.shape == (0,)
    assert found.pose_offsets.shape == (3, 3, 7)
    assert np.flatnonzero(found.pose_offsets.any(axis=2).ravel()).tolist() == [
        0,
        4,
        6,
    ]  # waypoint by waypoint
    assert found.total == pytest.approx(78.4 + 1.0 + 2.0 + 0.75 + 0.52)
    assert found.max_violation == pytest.approx(39.3)


def test_rates_beyond_their_limits_count_if_they_are_rows() -> None:
    found = measure_example(rates=True)
    assert found.rate_excess.tolist() == [3.0, -1.0, 0.0, -5.0, 0.0]
    assert found.amounts["rates"].tolist() == [8.0, 1.0, 0.0]


def amounts(**given: list[float]) -> Infeasibility:
    rows = {kind: np.zeros(2) for kind in Merit(1.0).weights}
    return Infeasibility(
        {**rows, **{kind: np.array(row) for kind, row in given.items()}},
        np.zeros(0),
        np.zeros(0),
        np.zeros(0),
    )


def test_max_violation_excludes_clearance() -> None:
    assert amounts(clearance=[9.0, 9.0], poses=[0.25, 0.5], terms=[0.75, 0.0]).max_violation == 0.75
    assert amounts(clearance=[9.0, 9.0]).max_violation == 0.0


def test_penalty() -> None:
    merit, found = Merit(2.0), amounts(clearance=[1.0, 3.0], poses=[0.25, 0.0], rates=[0.0, 0.5])
    merit.weights["poses"] = 8.0
    assert merit.compute_penalty(found, clearance=True).tolist() == [4.0, 7.0]
    assert merit.compute_penalty(found, clearance=False).tolist() == [2.0, 1.0]


def test_weights_of_violated_kinds_increase() -> None:
    merit = Merit(2.0)
    found = amounts(clearance=[0.0, 0.2], poses=[0.09, 0.0], terms=[0.11, 0.0])
    assert merit.increase_weights(found, 0.1)
    assert {kind for kind, weight in merit.weights.items() if weight == 8.0} == {
        "clearance",
        "terms",
    }
    assert set(merit.weights.values()) == {2.0, 8.0}
    assert not merit.increase_weights(amounts(poses=[0.09, 0.0]), 0.1)
    assert not merit.increase_weights(amounts(), 0.0)
