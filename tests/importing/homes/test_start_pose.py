from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.importing.homes.home_import import _find_start
from vkc_pin.importing.homes.start_pose import find_free_start
from vkc_pin.world.scene.scene import START_CLEARANCE


def make_divided_room(drawer_x: float, **more: object) -> vkc.Scene:
    """Return a floor of 10 m × 4 m, divided by a wall, with a drawer in one part."""
    return vkc.Scene.from_document(
        {
            "robot": "husky_ur5e",
            "start": {"base": [0.0, 0.0, 0.0]},
            "arena": {"x": [-6, 4], "y": [-2, 2]},
            "obstacles": [
                {
                    "name": "wall",
                    "type": "box",
                    "size": [0.1, 4.0, 2.0],
                    "position": [0.0, 0.0, 1.0],
                }
            ],
            "objects": [{"name": "drawer", "type": "drawer", "position": [drawer_x, 0.0, 0.0]}],
            **more,
        }
    )


@pytest.mark.parametrize(("drawer_x", "side"), [(3.0, 1.0), (-2.0, -1.0)])
def test_start_is_where_objects_are_reachable(drawer_x: float, side: float) -> None:
    for seed in range(3):
        scene, reached = find_free_start(make_divided_room(drawer_x), np.random.default_rng(seed))
        assert np.sign(scene.start[0]) == side
        assert reached == 1
        assert scene.start_clearance() >= START_CLEARANCE


def test_missing_start_pose_is_reported() -> None:
    full = [
        {"name": "block", "type": "box", "size": [10.0, 4.0, 2.0], "position": [-1.0, 0.0, 1.0]}
    ]
    with pytest.raises(vkc.InputError, match="floor"):
        find_free_start(make_divided_room(3.0, obstacles=full), np.random.default_rng(0))
    with pytest.raises(vkc.InputError, match=r"home\.xml: robot, floor: no start pose") as caught:
        _find_start(
            make_divided_room(3.0, obstacles=full), Path("home.xml"), np.random.default_rng(0)
        )
    assert caught.value.field == "robot, floor"
