"""Tests the attachments of handles: bars over their length, low bars, and knobs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vkc_pin.procedural.furniture.building import (
    LinkBuilder,
    ObjectBuilder,
    add_knob,
    add_level_bar,
    add_upright_bar,
)
from vkc_pin.world.models.object_file import load_object

FACE = (-0.01, 0.2, 0.3)


def make_builder(kind: str, height: float = 0.9) -> ObjectBuilder:
    builder = ObjectBuilder("thing", LinkBuilder("base"))
    builder.base.add_box((0, -0.3, 0), (0.4, 0.3, 0.6), "oak")
    leaf = builder.add_joint(
        "hinge", "revolute", (0, 0, height - FACE[2]), (0, 0, 1), 1.0, link="leaf"
    )
    leaf.add_box((-0.01, 0.0, 0.0), (0.01, 0.4, 0.6), "oak")
    if kind == "upright":
        add_upright_bar(builder, leaf, FACE, 0.3, 0.06)
    elif kind == "level":
        add_level_bar(builder, leaf, FACE, 0.3, 0.06, height=height)
    else:
        add_knob(builder, leaf, FACE, 0.05)
    return builder


@pytest.mark.parametrize(("kind", "axis"), [("upright", 2), ("level", 1)])
def test_bar_can_be_grasped_anywhere_between_its_posts(kind: str, axis: int) -> None:
    bar = load_object(make_builder(kind).description)
    fixed, free = bar.attachment("handle"), bar.attachment("handle_free")
    centre = np.array(FACE) - [0.06, 0.0, 0.0]
    np.testing.assert_allclose(fixed.placement.translation, centre, atol=1e-9)
    for slide, turn in itertools.product(*((f.lower, f.upper) for f in free.freedoms)):
        tool = free.tool([slide, turn])
        offset = np.delete(tool.translation - centre, axis)
        np.testing.assert_allclose(offset, 0.0, atol=1e-9)
        assert abs(tool.translation[axis] - FACE[axis]) == pytest.approx(
            0.1
        )  # 0.03 m from a post at 0.13 m
        assert abs(tool.rotation[axis, 0]) < 1e-9  # the fingers close across the bar
    rotation = fixed.placement.rotation
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-9)


@pytest.mark.parametrize(("height", "pitch"), [(0.9, 0.0), (0.55, 0.0), (0.3, 0.65), (0.1, 0.65)])
def test_low_bars_are_grasped_from_above(height: float, pitch: float) -> None:
    approach = (
        load_object(make_builder("level", height).description)
        .attachment("handle")
        .placement.rotation[:, 2]
    )
    np.testing.assert_allclose(approach, [np.cos(pitch), 0.0, -np.sin(pitch)], atol=1e-6)


def test_knob_can_be_grasped_from_any_direction_in_front() -> None:
    free = load_object(make_builder("knob").description).attachment("handle_free")
    rng = np.random.default_rng(0)
    for _ in range(20):
        tool = free.tool(
            rng.uniform([f.lower for f in free.freedoms], [f.upper for f in free.freedoms])
        )
        np.testing.assert_allclose(tool.translation, np.array(FACE) - [0.05, 0.0, 0.0], atol=1e-9)
        assert tool.rotation[0, 2] > 0.4  # approach direction
