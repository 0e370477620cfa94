"""Tests that clutter rests or hangs on surfaces without collisions."""

from __future__ import annotations

import itertools
from functools import cache

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.procedural.rooms.clutter import add_clutter
from vkc_pin.world.models.shapes import compute_clearance, compute_shape_distance
from vkc_pin.world.scene.placed_object import make_world_shapes

CLEAR_SPHERE = ((-3.0, 1.3, 1.051), 0.2)


@cache
def load_home() -> vkc.Scene:
    return vkc.load_scene("household")


def split_shapes(scene: vkc.Scene) -> tuple[list, list]:
    """Return the original shapes and the clutter."""
    new = [shape for shape in scene.obstacles if shape.name.startswith("clutter_")]
    old = [shape for shape in scene.obstacles if not shape.name.startswith("clutter_")]
    return old + [
        shape for placed in scene.objects.values() for shape in make_world_shapes(placed)
    ], new


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 25))
def test_clutter_rests_or_hangs_without_collisions(seed: int, count: int) -> None:
    scene = add_clutter(load_home(), count, seed=seed, clear=[CLEAR_SPHERE])
    assert (
        add_clutter(load_home(), count, seed=seed, clear=[CLEAR_SPHERE]).document == scene.document
    )
    old, new = split_shapes(scene)
    assert len(new) == count
    for shape in new:
        is_picture = (
            isinstance(shape.geometry, coal.Box) and 2 * min(shape.geometry.halfSide) == 0.025
        )
        gaps = sorted(
            compute_shape_distance(shape.geometry, shape.placement, other.geometry, other.placement)
            for other in old
        )
        if is_picture:  # penetrates one wall, away from all other shapes
            assert gaps[0] == pytest.approx(-0.005, abs=1e-4)
        else:
            assert abs(gaps[0]) < 1e-4
        assert gaps[1] > -1e-4  # two adjacent boards may support it
    for one, other in itertools.combinations(new, 2):
        assert (
            compute_shape_distance(one.geometry, one.placement, other.geometry, other.placement)
            > 0.0
        )


def test_clutter_stays_out_of_clear_spheres() -> None:
    _, new = split_shapes(add_clutter(load_home(), 100, seed=2, clear=[CLEAR_SPHERE]))
    shapes = [(shape.geometry, shape.placement) for shape in new]
    placement = vkc.load_scene("household").objects["cup"].placement.copy()
    for centre, radius in [
        CLEAR_SPHERE,
        *((p.placement.translation, 0.15) for p in load_home().objects.values() if p.object.free),
    ]:
        placement.translation = np.array(centre)
        assert compute_clearance(shapes, [(coal.Sphere(radius), placement)]) > -1e-6


def test_too_much_clutter_is_rejected() -> None:
    shelf = {"name": "shelf", "type": "box", "size": [0.4, 0.4, 0.5], "position": [2, 0, 0.25]}
    empty = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}}
    for obstacles, count in (([shelf], 30), ([], 1)):
        with pytest.raises(InputError, match="no space"):
            add_clutter(vkc.Scene.from_document({**empty, "obstacles": obstacles}), count)
    with pytest.raises(InputError, match="count"):
        add_clutter(load_home(), -1)
