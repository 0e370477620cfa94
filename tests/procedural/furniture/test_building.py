"""Tests the object builder: masses, inertias, shapes of a case, and handles."""

from __future__ import annotations

import itertools

import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.procedural.furniture.building import (
    LinkBuilder,
    ObjectBuilder,
    add_knob,
    add_level_bar,
    add_upright_bar,
)
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object


def build_object() -> ObjectBuilder:
    builder = ObjectBuilder("thing", LinkBuilder("base"))
    builder.base.add_box((0.0, -0.2, 0.0), (0.3, 0.2, 0.5), "oak")
    tray = builder.add_joint(
        "slide",
        "prismatic",
        (0.0, 0.0, 0.6),
        (-1, 0, 0),
        0.3,
        lower=-0.1,
        link="tray",
        acceleration=1.5,
    )
    tray.add_box((-0.1, -0.1, -0.05), (0.1, 0.1, 0.05), "white")
    tray.add_cylinder((-0.2, 0.0, 0.0), 0.02, 0.3, "y", "steel")
    tray.add_sphere((0.0, 0.0, 0.2), 0.05, "steel")
    tray.add_rod((0.1, 0.0, 0.0), (0.3, -0.2, 0.4), 0.03, "steel")
    builder.add_attachment(
        "grip",
        tray,
        (-0.2, 0.0, 0.0),
        (1, 0, 0),
        (0, 0, 1),
        joint="revolute",
        axis=[0, 1, 0],
        limits=(-0.5, 0.5),
    )
    return builder


def test_masses_and_inertias_match_pinocchio() -> None:
    loaded = load_object(build_object().description)
    start, rod = np.array([0.1, 0.0, 0.0]), np.array([0.2, -0.2, 0.4])
    length = float(np.linalg.norm(rod))
    up = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), rod / length).matrix()
    on_side, eye, density = pin.rpy.rpyToMatrix(np.pi / 2, 0.0, 0.0), np.eye(3), 500.0
    expected = pin.Inertia.FromBox(density * 0.2 * 0.2 * 0.1, 0.2, 0.2, 0.1)
    for radius, height, rotation, place in (
        (0.02, 0.3, on_side, np.array([-0.2, 0.0, 0.0])),
        (0.03, length, up, start + rod / 2.0),
    ):
        own = pin.Inertia.FromCylinder(density * np.pi * radius**2 * height, radius, height)
        expected += pin.SE3(rotation, place).act(own)
    ball = pin.Inertia.FromSphere(density * 4 / 3 * np.pi * 0.05**3, 0.05)
    expected += pin.SE3(eye, np.array([0.0, 0.0, 0.2])).act(ball)
    found = loaded.model.inertias[1]
    assert found.mass == pytest.approx(expected.mass, abs=1e-4)
    np.testing.assert_allclose(found.lever, expected.lever, rtol=0.0, atol=1e-4)
    np.testing.assert_allclose(found.inertia, expected.inertia, rtol=0.0, atol=1e-4)


def test_case_is_open_only_in_front() -> None:
    link = LinkBuilder("case")
    link.add_case((0.0, -0.3, 0.1), (0.5, 0.3, 0.9), 0.02, "white", "oak")
    builder = ObjectBuilder("case", link)
    builder.add_attachment("grip", link, (0, 0, 0), (1, 0, 0), (0, 0, 1))
    shapes = load_object(builder.description).collision.geometryObjects
    middle, blocked = np.array([0.25, 0.0, 0.5]), []
    for direction in (sign * axis for axis in np.eye(3) for sign in (-1.0, 1.0)):
        ray = [middle + t * direction for t in np.linspace(0.0, 1.0, 401)]
        hit = any(
            (np.abs(shape.placement.actInv(point)) <= shape.geometry.halfSide + 1e-9).all()
            for shape in shapes
            for point in ray
        )
        blocked.append(hit)
    assert blocked == [False, True, True, True, True, True]  # open only towards -x


FACE = (-0.01, 0.2, 0.3)


def load_handle(kind: str, height: float = 0.9) -> ArticulatedObject:
    """Return a door with a handle."""
    builder = ObjectBuilder("thing", LinkBuilder("base"))
    builder.base.add_box((0, -0.3, 0), (0.4, 0.3, 0.6), "oak")
    place = (0, 0, height - FACE[2])
    leaf = builder.add_joint("hinge", "revolute", place, (0, 0, 1), 1.0, link="leaf")
    leaf.add_box((-0.01, 0.0, 0.0), (0.01, 0.4, 0.6), "oak")
    if kind == "upright":
        add_upright_bar(builder, leaf, FACE, 0.3, 0.06)
    elif kind == "level":
        add_level_bar(builder, leaf, FACE, 0.3, 0.06, height=height)
    else:
        add_knob(builder, leaf, FACE, 0.05)
    return load_object(builder.description)


@pytest.mark.parametrize(("kind", "axis"), [("upright", 2), ("level", 1)])
def test_bar_can_be_grasped_anywhere_between_its_posts(kind: str, axis: int) -> None:
    bar = load_handle(kind)
    fixed, free = bar.attachment("handle"), bar.attachment("handle_free")
    centre = np.array(FACE) - [0.06, 0.0, 0.0]
    np.testing.assert_allclose(fixed.placement.translation, centre, atol=1e-9)
    for slide, turn in itertools.product(*((f.lower, f.upper) for f in free.freedoms)):
        tool = free.tool([slide, turn])
        offset = np.delete(tool.translation - centre, axis)
        np.testing.assert_allclose(offset, 0.0, atol=1e-9)
        # 0.03 m from a post at 0.13 m
        assert abs(tool.translation[axis] - FACE[axis]) == pytest.approx(0.1)
        assert abs(tool.rotation[axis, 0]) < 1e-9  # the fingers close across the bar
    rotation = fixed.placement.rotation
    np.testing.assert_allclose(rotation[:, 2], [1, 0, 0], atol=1e-9)


@pytest.mark.parametrize(("height", "pitch"), [(0.9, 0.0), (0.55, 0.0), (0.3, 0.65), (0.1, 0.65)])
def test_low_bars_are_grasped_from_above(height: float, pitch: float) -> None:
    approach = load_handle("level", height).attachment("handle").placement.rotation[:, 2]
    np.testing.assert_allclose(approach, [np.cos(pitch), 0.0, -np.sin(pitch)], atol=1e-6)


def test_knob_can_be_grasped_from_any_direction_in_front() -> None:
    free = load_handle("knob").attachment("handle_free")
    rng = np.random.default_rng(0)
    for _ in range(20):
        tool = free.tool([rng.uniform(f.lower, f.upper) for f in free.freedoms])
        np.testing.assert_allclose(tool.translation, np.array(FACE) - [0.05, 0.0, 0.0], atol=1e-9)
        assert tool.rotation[0, 2] > 0.4  # approach direction
