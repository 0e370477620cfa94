"""Compares re-rooted kinematic trees with Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.objects import SHAPES, format_joint, load_object_text
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.chain.chain import invert
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.object_file import load_object

KINDS = ("revolute", "continuous", "prismatic", "fixed")
AXES = ("1 0 0", "0 1 0", "0 0 1", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 -2 3")


@st.composite
def trees(draw: st.DrawFn) -> tuple[str, int]:
    """Draw a URDF tree of 1 to 8 links and the index of one of its links."""
    number = draw(st.integers(1, 8))
    length = st.floats(-1.0, 1.0).map(lambda x: round(x, 4))
    parts = []
    for i in range(number):
        xyz, rpy = (f"{draw(length)} {draw(length)} {draw(length)}" for _ in range(2))
        origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
        shape = f"{origin}<geometry>{draw(st.sampled_from(SHAPES))}</geometry>"
        inertia = '<mass value="1.5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
        shapes = f"<collision>{shape}</collision><visual>{shape}</visual>"
        bodies = f"<inertial>{origin}{inertia}</inertial>{shapes}"
        parts.append(f'<link name="l{i}">{bodies}</link>')
    for i in range(1, number):
        xyz, rpy = (f"{draw(length)} {draw(length)} {draw(length)}" for _ in range(2))
        origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
        parent, kind, axis = (
            draw(st.integers(0, i - 1)),
            draw(st.sampled_from(KINDS)),
            draw(st.sampled_from(AXES)),
        )
        limit = f'<limit lower="-2" upper="{1 + i}" velocity="{i}" effort="{10 * i}"/>'
        links = f'<parent link="l{parent}"/><child link="l{i}"/>'
        parts.append(
            f'<joint name="j{i}" type="{kind}">{links}{origin}<axis xyz="{axis}"/>{limit}</joint>'
        )
    return f'<robot name="t">{"".join(parts)}</robot>', draw(st.integers(0, number - 1))


def compute_placements(
    model: pin.Model, geometry: pin.GeometryModel, q: np.ndarray
) -> tuple[dict[str, pin.SE3], dict[str, pin.SE3]]:
    """Return the world placements of all body frames and of all shapes, by name."""
    data, shapes = model.createData(), geometry.createData()
    pin.framesForwardKinematics(model, data, q)
    pin.updateGeometryPlacements(model, data, geometry, shapes)
    bodies = {
        frame.name: data.oMf[i].copy()
        for i, frame in enumerate(model.frames)
        if frame.type == pin.FrameType.BODY
    }
    return bodies, {
        shape.name: shapes.oMg[i].copy() for i, shape in enumerate(geometry.geometryObjects)
    }


@settings(max_examples=50, deadline=None)
@given(trees(), st.integers(0, 2**32 - 1))
def test_inverted_trees_keep_all_frames_and_shapes(tree: tuple[str, int], seed: int) -> None:
    urdf, root = tree
    item = load_object_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: l0}]")
    link, z = f"l{root}", np.random.default_rng(seed).uniform(-3.0, 3.0, item.coordinates.size)
    model, collision = invert(item, link, z)
    coordinates = Coordinates(model)
    moving = coordinates.names
    assert set(moving) <= set(item.coordinates.names)
    q = coordinates.q(np.array([z[item.coordinates.index(name)] for name in moving]))
    bodies, shapes = compute_placements(item.model, item.collision, item.coordinates.q(z))
    new_bodies, new_shapes = compute_placements(model, collision, q)
    assert new_bodies.keys() == bodies.keys()
    assert new_shapes.keys() == shapes.keys()
    to_root = bodies[link].inverse()
    for old, new in ((bodies, new_bodies), (shapes, new_shapes)):
        for name in old:
            np.testing.assert_allclose(
                new[name].homogeneous, (to_root * old[name]).homogeneous, atol=1e-12, rtol=0.0
            )
    for name in moving:
        old, new = item.coordinates.index(name), coordinates.index(name)
        for attribute in ("lower", "upper", "velocity"):
            assert getattr(coordinates, attribute)[new] == getattr(item.coordinates, attribute)[old]
    assert sum(i.mass for i in model.inertias) == pytest.approx(
        sum(i.mass for i in item.model.inertias)
    )
    for shape in collision.geometryObjects:
        frame = model.frames[shape.parentFrame]
        assert frame.parentJoint == shape.parentJoint
        assert shape.name.startswith(frame.name)


def test_only_joints_on_the_path_to_the_base_move() -> None:
    links = "".join(f'<link name="{name}"/>' for name in ("base", "arm", "hand", "side", "back"))
    joints = (
        format_joint("shoulder", "revolute", "base", "arm", "0 0 1")
        + format_joint("wrist", "prismatic", "arm", "hand", "1 0 0")
        + format_joint("flap", "revolute", "arm", "side", "0 1 0")
        + format_joint("lid", "revolute", "base", "back", "1 0 0")
    )
    urdf = f'<robot name="t">{links}{joints}</robot>'
    item = load_object_text(urdf, "urdf: thing.urdf\nattachments: [{name: a, link: hand}]")
    assert [*invert(item, "hand", np.zeros(4))[0].names[1:]] == ["wrist", "shoulder"]
    assert invert(item, "base", np.zeros(4))[0].nq == 0


def test_inverting_aligned_joints_leaves_exact_zeros_and_ones() -> None:
    model, _ = invert(load_object("door"), "lever", [0.0, 0.0])
    for placement in model.jointPlacements:
        assert set(np.abs(placement.rotation).ravel()) <= {0.0, 1.0}
    assert [joint.shortname() for joint in model.joints][1:] == [
        "JointModelRZ",
        "JointModelRZ",
    ]


def test_unknown_links_and_wrong_states_are_rejected() -> None:
    door = load_object("door")
    with pytest.raises(UnknownNameError) as caught:
        invert(door, "levr", [0.0, 0.0])
    assert caught.value.nearest == "lever"
    with pytest.raises(InputError, match="number of coordinates"):
        invert(door, "lever", [0.0])
