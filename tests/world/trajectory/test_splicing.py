"""Tests the concatenation and division of trajectories."""

from __future__ import annotations

import dataclasses

import numpy as np
from helpers.expected_errors import expect_error
from helpers.trajectory_files import NAMES, ROWS

from vkc_pin import Hold, PhaseSpan, Trajectory
from vkc_pin.world.scene.hold import make_holds
from vkc_pin.world.trajectory.splicing import (
    concatenate_trajectories,
    extract_phases,
    fill_missing_values,
)


def test_coordinates_without_values_keep_none() -> None:
    table = np.array([[np.nan, 1.0], [np.nan, np.nan]])
    np.testing.assert_array_equal(fill_missing_values(table), [[np.nan, 1.0]] * 2)


def make_parts() -> tuple[Trajectory, Trajectory, Trajectory]:
    """Return motions that reach the door, open it and leave; only the second has a hinge column."""
    robot, held = NAMES[:5], (Hold("door", "handle"),)
    phases = (PhaseSpan("a", 0, 1), PhaseSpan("b", 1, 2))
    reach = Trajectory(robot, np.array([0.0, 1.0, 3.0]), ROWS[:3, :5], phases, 5)
    opens, after = (
        Trajectory(names, times, rows, (PhaseSpan(name, 0, 1, held),), 5)
        for name, names, times, rows in (
            ("c", NAMES, np.array([7.0, 8.0]), ROWS[2:]),
            ("d", robot, np.array([0.0, 0.5]), ROWS[[3, 0], :5]),
        )
    )
    return reach, opens, after


def test_concatenation_pauses_at_new_grasps() -> None:
    whole = concatenate_trajectories(make_parts(), pause=0.25)
    assert whole.names == NAMES
    np.testing.assert_allclose(whole.times, [0.0, 1.0, 3.0, 3.25, 4.25, 4.75])
    np.testing.assert_array_equal(whole.positions[:, :5], ROWS[[0, 1, 2, 2, 3, 0], :5])
    hinge = [0.0, 0.0, 0.0, 0.0, 1.2, 1.2]  # filled from the nearest motion that has it
    np.testing.assert_array_equal(whole.positions[:, 5], hinge)
    # The pause belongs to the next phase.
    held = {"door": "handle"}
    assert [(p.name, p.first, p.last, p.held) for p in whole.phases] == [
        ("a", 0, 1, {}),
        ("b", 1, 2, {}),
        ("c", 2, 4, held),
        ("d", 4, 5, held),
    ]
    assert whole.robot_size == 5


def test_concatenation_without_pauses_adds_no_segments() -> None:
    whole = concatenate_trajectories(make_parts(), pause=0.0)
    np.testing.assert_allclose(whole.times, [0.0, 1.0, 3.0, 4.0, 4.5])
    assert [(p.first, p.last) for p in whole.phases] == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_indirect_grasps_pause_too() -> None:
    both = {"stick": "grip", "ball": "pull"}
    holds = make_holds(both, {"ball": "stick.tip"}), make_holds(both), make_holds({"stick": "grip"})
    motions = [
        Trajectory(NAMES, np.array([0.0, 1.0]), ROWS[[1, 2]], (PhaseSpan("a", 0, 1, held),), 5)
        for held in holds
    ]
    whole = concatenate_trajectories(motions, pause=0.5)
    np.testing.assert_allclose(whole.times, [0.0, 1.0, 1.5, 2.5, 3.0, 4.0])


def test_motions_must_follow_one_another() -> None:
    reach, opens, _ = make_parts()
    with expect_error(field="parts[1]"):
        concatenate_trajectories([reach, reach], pause=0.1)
    moved, closer = (
        dataclasses.replace(opens, positions=opens.positions + shift) for shift in (2e-6, 5e-7)
    )
    with expect_error(field="parts[1]"):
        concatenate_trajectories([reach, moved], pause=0.1)
    assert len(concatenate_trajectories([reach, closer], pause=0.1).times) == 5
    with expect_error("nothing to concatenate"):
        concatenate_trajectories([], pause=0.1)


def test_concatenated_motions_can_be_divided() -> None:
    first, whole = 0, concatenate_trajectories(make_parts(), pause=0.25)
    for part in make_parts():
        found = extract_phases(whole, part.names, first, first + len(part.phases))
        count = len(part.times)
        np.testing.assert_array_equal(found.positions[-count:], part.positions)
        np.testing.assert_allclose(np.diff(found.times[-count:]), np.diff(part.times))
        assert [phase.name for phase in found.phases] == [phase.name for phase in part.phases]
        assert (found.phases[0].first, found.phases[-1].last) == (0, len(found.times) - 1)
        first += len(part.phases)
