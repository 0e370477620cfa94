from __future__ import annotations

import dataclasses

import coal
import numpy as np
import pinocchio as pin
import trimesh
from helpers.meshes import compute_excess
from helpers.robots import compute_placement

from vkc_pin import Robot
from vkc_pin.world.models.shapes import get_link_name


def compute_ur5e(q: np.ndarray) -> np.ndarray:
    """Compute forward kinematics with the Denavit-Hartenberg parameters of the manufacturer."""
    d, a = [0.1625, 0, 0, 0.1333, 0.0997, 0.0996], [0, -0.425, -0.3922, 0, 0, 0]
    total = np.eye(4)
    for k, twist in enumerate([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]):
        c, s, ct, st = np.cos(q[k]), np.sin(q[k]), np.cos(twist), np.sin(twist)
        total = total @ [
            [c, -s * ct, s * st, a[k] * c],
            [s, c * ct, -c * st, a[k] * s],
            [0, st, ct, d[k]],
            [0, 0, 0, 1],
        ]
    return total


def test_forward_kinematics_match_the_manufacturer(husky: Robot) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        z = np.concatenate([rng.uniform(-3, 3, 3), rng.uniform(-np.pi, np.pi, 6)])
        base = pin.SE3(pin.rpy.rpyToMatrix(0, 0, z[2]), np.array([z[0], z[1], 0.0])).homogeneous
        foot = pin.SE3(np.eye(3), np.array([0.25, 0.0, 0.39])).homogeneous
        flange = base @ foot @ compute_ur5e(z[3:])
        tool = flange @ pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.142224])).homogeneous
        for frame, expected in (("tool0", flange), (husky.tool_frame, tool)):
            np.testing.assert_allclose(compute_placement(husky, frame, z), expected, atol=1e-12)


def test_collision_shapes_enclose_the_links(husky: Robot) -> None:
    for link in husky.links:
        shapes = [s for s in husky.collision.geometryObjects if get_link_name(s.name) == link]
        assert all(isinstance(shape.geometry, coal.Convex) for shape in shapes)
        assert all(shape.geometry.num_points <= 40 for shape in shapes)
        frame = husky.model.frames[husky.model.getFrameId(link)].placement
        visual = trimesh.util.concatenate(
            [shape.make_mesh() for shape in husky.file.read_shapes("visual") if shape.link == link]
        )
        points = np.vstack(
            [visual.vertices, trimesh.sample.sample_surface(visual, 3000, seed=0)[0]]
        )
        points = points @ frame.rotation.T + frame.translation
        outside = np.full(len(points), np.inf)
        for shape in shapes:
            local = (points - shape.placement.translation) @ shape.placement.rotation
            hull = trimesh.convex.convex_hull(np.asarray(shape.geometry.points()))
            outside = np.minimum(outside, compute_excess(local, hull))
        assert outside.max() < 1e-6, link


def test_front_is_the_foremost_corner_of_the_hand(husky: Robot) -> None:
    """Covers all corners of touch links; without touch links it is the tool frame."""
    frame = husky.model.frames[husky.model.getFrameId(husky.tool_frame)]
    ahead = [
        frame.placement.actInv(shape.placement).act(point)[2]
        for k, shape in enumerate(husky.collision.geometryObjects)
        if husky.link_of(k) in husky.touch_links
        for point in shape.geometry.points()
    ]
    np.testing.assert_allclose(husky.front.translation, [0.0, 0.0, max(ahead)], rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(husky.front.rotation, np.eye(3))
    np.testing.assert_array_equal(
        dataclasses.replace(husky, touch_links=()).front.homogeneous, np.eye(4)
    )


def test_visual_geometry_is_simplified(husky: Robot) -> None:
    shapes = husky.visual.geometryObjects
    triangles = sum(
        shape.geometry.num_tris for shape in shapes if isinstance(shape.geometry, coal.BVHModelBase)
    )
    assert 10_000 < triangles < 100_000


def test_unwrapped_headings_count_turns_as_others_do(husky: Robot) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        near = rng.uniform(-9.0, 9.0, 9)
        measured = near + rng.uniform(-0.1, 0.1, 9)
        wrapped = measured.copy()
        wrapped[2] -= 2.0 * np.pi * rng.integers(-3, 4)
        np.testing.assert_allclose(husky.unwrap(wrapped, near), measured, atol=1e-12)
    # The arm's joints have limits: a whole turn more is another configuration.
    turned = husky.home + 2.0 * np.pi
    z = np.concatenate([np.zeros(3), turned])
    np.testing.assert_array_equal(husky.unwrap(z, np.zeros(9))[3:], turned)
