"""Tests the scene with a gap of 0.85 m between a pillar and a wall, and a table beyond it."""

from __future__ import annotations

from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.scene import START_CLEARANCE, Scene, load_scene

GAP = 0.85  # [m]
PARTS = ("table_top", *(f"table_leg_{k}" for k in range(1, 5)))
WALLS = tuple(f"wall_{side}" for side in ("west", "east", "south", "north"))


@cache
def scene() -> Scene:
    return load_scene("gap_table")


def distance(first: str, second: str) -> float:
    """Return coal's distance between two obstacles [m], without functions of the package."""
    one, two = (
        next(shape for shape in scene().obstacles if shape.name == name) for name in (first, second)
    )
    places = [
        coal.Transform3s(shape.placement.rotation, shape.placement.translation)
        for shape in (one, two)
    ]
    return coal.distance(
        one.geometry,
        places[0],
        two.geometry,
        places[1],
        coal.DistanceRequest(),
        coal.DistanceResult(),
    )


def test_the_gap_is_as_wide_as_the_scene_says() -> None:
    assert distance("pillar", "wall_south") == pytest.approx(GAP, abs=1e-6)


def test_gap_is_the_only_passage() -> None:
    for first, second in (("pillar", "sideboard"), ("sideboard", "wall_north")):
        assert abs(distance(first, second)) < 1e-6
    low, high, south, north = scene().arena
    assert (low, high, south, north) == (-3.5, 3.5, -2.0, 2.0), "walls are where the arena ends"
    assert {*scene().obstacle_names} == {"pillar", "sideboard", *PARTS, *WALLS}


def test_robot_clearance_in_the_gap() -> None:
    robot = scene().robot
    data, shapes = robot.model.createData(), robot.collision.createData()
    home = np.concatenate([np.zeros(3), scene().start[3:]])
    pin.updateGeometryPlacements(
        robot.model, data, robot.collision, shapes, robot.coordinates.q(home)
    )
    boxes = [
        compute_world_box(shape.geometry, at)
        for shape, at in zip(robot.collision.geometryObjects, shapes.oMg, strict=True)
    ]
    body = [
        box
        for shape, box in zip(robot.collision.geometryObjects, boxes, strict=True)
        if shape.name.startswith("base_link")
    ]
    width, whole = (
        np.max([box[1][1] for box in own]) - np.min([box[0][1] for box in own])
        for own in (body, boxes)
    )
    assert width == pytest.approx(0.67, abs=0.005)
    assert 0.0 < (GAP - width) / 2.0 < 0.1
    assert width < whole < GAP - 2 * 0.02, (
        "with its arm at home it fits, too, with the least distance that is kept"
    )


def test_starts_are_west_of_the_gap_and_free() -> None:
    here, rng = scene(), np.random.default_rng(0)
    assert here.start_clearance() >= START_CLEARANCE
    bases = np.array([here.sample_start(rng).start[:3] for _ in range(30)])
    assert (bases[:, 0] < -1.0).all()
    assert np.ptp(bases[:, 1]) > 2.0
    assert np.ptp(bases[:, 2]) > 5.0, "any heading"
