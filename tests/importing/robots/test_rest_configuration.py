from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from helpers.arm_urdf import HEIGHT, write_arms
from helpers.telescopes import write_telescope

import vkc_pin as vkc
from vkc_pin.importing.robots.rest_configuration import (
    HOME_ROOM,
    Clearances,
    find_home,
    find_inseparable_pairs,
    find_nested_pairs,
    measure_floor_heights,
)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> vkc.Robot:
    return vkc.load_robot(write_arms(tmp_path_factory.mktemp("robot")))


def test_first_state_with_clearance_is_home(robot: vkc.Robot) -> None:
    folded, up = np.array([0.0, 1.9, 1.9, 0.0, 0.0]), np.zeros(5)
    home = find_home(robot, [("folded", folded), ("up", up)])
    assert home.how == "up"
    np.testing.assert_array_equal(home.positions, up)
    assert home.clearance >= HOME_ROOM


def test_home_is_found_by_search(robot: vkc.Robot) -> None:
    home = find_home(robot, [("folded", np.array([0.0, 1.9, 1.9, 0.0, 0.0]))], seed=1)
    again = find_home(robot, [], seed=1)
    assert home.how == "found by search"
    np.testing.assert_array_equal(home.positions, again.positions)
    clearances = Clearances(robot)
    clearances.place(home.positions)
    assert clearances.least() == pytest.approx(home.clearance)
    assert home.clearance >= HOME_ROOM
    assert ((home.positions >= robot.lower[3:]) & (home.positions <= robot.upper[3:])).all()


def test_inseparable_pairs_are_found(tmp_path: Path) -> None:
    robot = vkc.load_robot(write_arms(tmp_path), pairs="all")
    # The first link turns about the vertical, 30 mm above the body.
    pairs = find_inseparable_pairs(robot, 0.035, samples=50)
    assert pairs[("body", "arm_1")] == pytest.approx(0.03)
    assert ("body", "arm_5") not in pairs
    assert ("arm_1", "arm_2") not in pairs
    assert find_inseparable_pairs(robot, 0.025, samples=50) == {}
    # Links arm_2 and arm_3 are 40 mm apart in line and closer where they turn.
    assert ("arm_2", "arm_3") not in pairs
    assert ("arm_2", "arm_3") in find_inseparable_pairs(robot, 0.035, samples=50, share=0.5)


def test_segments_of_a_telescope_are_nested(tmp_path: Path, robot: vkc.Robot) -> None:
    """Wrist links also overlap the retracted segments, but are not nested."""
    telescope = vkc.load_robot(write_telescope(tmp_path), pairs="all")
    segments = [f"segment_{k}" for k in range(1, 5)]
    nested = [("carriage", "segment_1"), *itertools.combinations(segments, 2)]
    assert find_nested_pairs(telescope, 0.025) == nested
    assert find_nested_pairs(robot, 0.025) == []


def test_floor_heights_are_measured_for_fixed_and_moving_links(robot: vkc.Robot) -> None:
    low, above = measure_floor_heights(robot)
    assert low == pytest.approx(-HEIGHT)
    assert above == pytest.approx(0.16 + 0.02, abs=0.01)  # its first link turns about the vertical
