"""Placements as numbers are Pinocchio's, to the last bit."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import door_scene, random_configurations

from vkc_pin.distances import placements
from vkc_pin.distances.placements import ShapePlacements, columns_of
from vkc_pin.motion.world import World


def test_numbers_of_a_placement() -> None:
    rotation = pin.exp3(np.array([0.1, 0.2, 0.3]))
    (numbers,) = columns_of([pin.SE3(rotation, np.array([4.0, 5.0, 6.0]))])
    np.testing.assert_array_equal(numbers, [*rotation[:, 0], *rotation[:, 1], *rotation[:, 2], 4.0, 5.0, 6.0])
    assert columns_of([]).shape == (0, 12)


@pytest.mark.parametrize("known", [True, False])
def test_shapes_are_where_pinocchio_says(known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the memory of its placements is not what it is now."""
    if not known:
        monkeypatch.setattr(placements, "_memory", lambda _: None)
    world = World(door_scene())
    mine = ShapePlacements(world.model, world.bodies)
    assert (mine._numbers is not None) == known
    limits = (np.full(world.coordinates.size, limit) for limit in (-1.0, 1.0))
    q = world.coordinates.q(random_configurations(*limits, 5, np.random.default_rng(0)))
    found = mine.at(q)
    assert found.shape == (5, len(world.bodies.geometryObjects), 12)
    data, placed = world.model.createData(), pin.GeometryData(world.bodies)
    for row, configuration in zip(found, q, strict=True):
        pin.updateGeometryPlacements(world.model, data, world.bodies, placed, configuration)
        for numbers, placement in zip(row, placed.oMg, strict=True):
            np.testing.assert_array_equal(numbers[:9].reshape(3, 3).T, placement.rotation)
            np.testing.assert_array_equal(numbers[9:], placement.translation)
    np.testing.assert_array_equal(mine.at(q[:1]), found[:1])  # what was handed out before has not changed


def test_no_states_and_no_shapes() -> None:
    world = World(door_scene())
    q = world.coordinates.q(np.zeros((2, world.coordinates.size)))
    assert ShapePlacements(world.model, world.bodies).at(q[:0]).shape == (0, len(world.bodies.geometryObjects), 12)
    assert ShapePlacements(world.model, pin.GeometryModel()).at(q).shape == (2, 0, 12)
