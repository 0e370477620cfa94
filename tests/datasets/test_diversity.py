from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vkc_pin.datasets.diversity import (
    NEAR,
    DuplicateFinder,
    compute_coverage,
    compute_winding_numbers,
    sample_coarse_trajectory,
)
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory


def make_base_motion(*points: tuple[float, float]) -> Trajectory:
    positions = np.array([[x, y, 0.0] for x, y in points])
    last = len(points) - 1
    return Trajectory(
        ("x", "y", "yaw"),
        np.arange(len(points), dtype=float),
        positions,
        (PhaseSpan("go", 0, last),),
        3,
    )


@pytest.fixture(scope="module")
def scene() -> Scene:
    post = {"name": "post", "type": "cylinder", "radius": 0.1, "length": 1.0}
    lamp = {"name": "lamp", "type": "sphere", "radius": 0.1, "position": [0.0, 0.0, 2.2]}
    obstacles = [{**post, "position": [0.0, 0.0, 0.5]}, lamp]
    start = {"base": [2.0, -2.0, 0.0]}
    document = {"robot": "husky_ur5e", "start": start, "obstacles": obstacles}
    return Scene.from_document(document, load_scene("door").folder)


def test_winding_numbers_of_known_paths(scene: Scene) -> None:
    right, left = (make_base_motion((-2, -0.1), (0, y), (2, -0.1)) for y in (-1, 1))
    assert compute_winding_numbers(scene, right) == {}  # on the same side as the straight line
    assert compute_winding_numbers(scene, left) == {"post": -1}  # clockwise around the post
    loop = make_base_motion((-2, -0.1), (0, -1), (2, 0), (0, 1), (-2, 0), (0, -1), (2, -0.1))
    assert compute_winding_numbers(scene, loop) == {"post": 1}


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0.5, 3)), min_size=1, max_size=6))
def test_paths_on_one_side_have_no_winding_number(
    scene: Scene, points: list[tuple[float, float]]
) -> None:
    assert compute_winding_numbers(scene, make_base_motion((-2.0, 0.5), *points, (2.0, 0.5))) == {}


@pytest.mark.parametrize(
    ("y", "changes", "expected"),
    [
        (0.9 * NEAR, {}, 3),
        (2.0 * NEAR, {}, None),
        (0.0, {"scene": "another"}, None),
        (0.0, {"object": "another"}, None),
    ],
)
def test_near_duplicates_are_found(y: float, changes: dict[str, str], expected: int | None) -> None:
    finder, about = DuplicateFinder(), {"scene": "s", "task": "t", "object": "o", "goal": 1.0}
    for number, middle, more, found in ((3, 0.0, {}, None), (5, y, changes, expected)):
        way = sample_coarse_trajectory(make_base_motion((0, 0), (1, middle), (2, 0)))
        record = {**about, **more, "number": number, "way": way}
        assert finder.find_duplicate(record) == found


def test_coverage_of_an_interval() -> None:
    assert compute_coverage([], 0.0, 1.0) == 0.0
    assert compute_coverage([0.05, 0.06, 0.95, 1.0], 0.0, 1.0) == 0.2
    assert compute_coverage(np.linspace(0, 1, 50).tolist(), 0.0, 1.0) == 1.0
