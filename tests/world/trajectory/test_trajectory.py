"""Tests trajectories: path lengths, derivatives, interpolation, data and invalid input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error
from helpers.trajectory_files import NAMES, PHASES, ROWS, TIMES, make_example_trajectory

from vkc_pin import PhaseSpan, Trajectory
from vkc_pin.world.scene.hold import make_holds


def test_path_lengths() -> None:
    motion = make_example_trajectory()
    assert motion.base_path_length() == pytest.approx(5.0 + 1.0)
    assert motion.base_path_length_l1() == pytest.approx(3.0 + 4.0 + 1.0)
    # Neither the heading nor the door counts.
    assert motion.arm_path_length() == pytest.approx(0.1 + 0.2 + 0.4 + 0.1)


def test_samples_and_velocities_of_linear_motions() -> None:
    motion = make_example_trajectory()
    times, rows = motion.sample(2.0)
    np.testing.assert_allclose(times, np.arange(14) / 2.0)
    np.testing.assert_array_equal(rows, motion(times))
    rates = motion.velocity([-1.0, 1.0, 7.0])
    np.testing.assert_allclose(rates[1], [1.5, 2.0, 0.25, 0.05, -0.1, 0.0])
    assert not rates[[0, 2]].any()
    assert not motion.acceleration(times).any()
    with expect_error("too many samples"):
        motion.sample(1e6)
    assert [part.times.tolist() for part in motion.parts()] == [[0.0, 2.0, 2.5], [2.5, 6.5]]


def test_accelerations_at_waypoints() -> None:
    """A velocity step is divided by the shorter adjacent duration; both ends are at rest."""
    x, hinge = [1.5 / 2.0, -1.5 / 0.5, -0.25 / 0.5, 0.25 / 4.0], [0.0, 0.0, 0.3 / 0.5, -0.3 / 4.0]
    found = make_example_trajectory().accelerations()
    np.testing.assert_allclose(found[:, [0, 5]], np.transpose([x, hinge]))


def test_positions_are_interpolated_linearly() -> None:
    motion = make_example_trajectory()
    expected = [(ROWS[0] + ROWS[1]) / 2, 0.75 * ROWS[2] + 0.25 * ROWS[3]]
    np.testing.assert_allclose(motion.at([1.0, 3.5]), expected, atol=1e-15)
    np.testing.assert_array_equal(motion.at(TIMES), ROWS)
    np.testing.assert_array_equal(motion.at([-1.0, 7.0]), ROWS[[0, -1]])
    assert motion.at(np.zeros((2, 3))).shape == (2, 3, 6)


@pytest.mark.parametrize("time", ["soon", float("nan"), [0.0, float("inf")]])
def test_invalid_times_are_rejected(time: Any) -> None:
    motion = make_example_trajectory()
    for evaluate in (motion.at, motion.velocity, motion.acceleration):
        with expect_error("time"):
            evaluate(time)


def test_holds_of_older_files_are_direct() -> None:
    held = {"stick": "grip", "ball": "pull"}
    phases = (PhaseSpan("reach", 0, 2), PhaseSpan("carry", 2, 3, make_holds(held)))
    data = make_example_trajectory(phases=phases).to_dict()
    for phase in data["phases"]:
        del phase["by"]
    assert Trajectory.from_dict(data).phases == phases


@pytest.mark.parametrize("key", ["names", "times", "positions", "phases", "robot_size"])
def test_missing_fields_are_rejected(key: str) -> None:
    data = make_example_trajectory().to_dict()
    del data[key]
    with expect_error(field=key):
        Trajectory.from_dict(data)


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("times", {"times": [0.0, 1.0, 1.0, 2.0]}),
        ("times", {"times": [[0.0, 1.0, 2.0, 3.0]]}),
        ("times", {"times": [0.0], "positions": ROWS[:1], "phases": ()}),
        ("times", {"times": "soon"}),
        ("times[3]", {"times": [0.0, 1.0, 2.0, np.inf]}),
        ("positions", {"positions": ROWS[:3]}),
        ("positions", {"positions": ROWS[:, :5]}),
        ("positions", {"positions": [[0.0], [1.0, 2.0]]}),
        (
            "positions[2, 1]",
            {"positions": np.where(np.arange(24).reshape(4, 6) == 13, np.nan, ROWS)},
        ),
        ("names", {"names": (*NAMES[:5], "elbow")}),
        ("robot_size", {"robot_size": 7}),
        ("robot_size", {"robot_size": 2}),
        *(
            ("phases", {"phases": phases})
            for phases in (
                (),
                PHASES[:1],
                PHASES[1:],
                (PHASES[0], PhaseSpan("gap", 1, 3)),
                (PHASES[0], PhaseSpan("nothing", 2, 2), PHASES[1]),
                (PHASES[0], PhaseSpan("beyond", 2, 4)),
            )
        ),
    ],
)
def test_invalid_fields_are_rejected(field: str, changes: dict[str, Any]) -> None:
    with expect_error(field=f"Trajectory.{field}"):
        make_example_trajectory(**changes)


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"first": -1}, "first"),
        ({"name": 3}, "name"),
        ({"opening": -0.1}, "opening"),
        ({"opening": "wide"}, "opening"),
        ({"deviation": {"stick": [0.01, 0.0]}}, "deviation.stick"),
        ({"more": 1}, "more"),
    ],
)
def test_invalid_phases_in_data_are_rejected(wrong: dict[str, Any], field: str) -> None:
    data = make_example_trajectory().to_dict()
    data["phases"][1] |= wrong
    with expect_error(field=f"phases[1].{field}"):
        Trajectory.from_dict(data)


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"first": -1}, "PhaseSpan.first"),
        ({"name": 3}, "PhaseSpan.name"),
        ({"opening": -0.1}, "PhaseSpan.opening"),
        ({"opening": "wide"}, "PhaseSpan.opening"),
    ],
)
def test_invalid_phases_are_rejected(wrong: dict[str, Any], field: str) -> None:
    with expect_error(field=field):
        PhaseSpan(**{"name": "go", "first": 0, "last": 4, **wrong})


def test_missing_fields_of_phases_are_named() -> None:
    data = make_example_trajectory().to_dict()
    del data["phases"][0]["held"]
    with expect_error(r"phases\[0\]\.held: missing"):
        Trajectory.from_dict(data)
    with expect_error(field="phases[1]"):
        Trajectory.from_dict({**data, "phases": [data["phases"][1], "go"]})
