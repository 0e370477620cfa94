"""Tests of distances to measured points, against coal's distance to a sphere at every point."""

from __future__ import annotations

import pickle

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.distances import Clearances, Margins, Shapes, find_near_points
from vkc_pin.world.collision.point_cloud import PointCloud, divide_points
from vkc_pin.world.collision.solids import convert_solid, flatten_placements
from vkc_pin.world.files.meshes import make_bvh, make_convex_hull
from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box

KINDS = ("hull", "capsule", "box", "sphere", "cylinder", "cone", "ellipsoid", "mesh", "swept")


def make_shape(kind: str, rng: np.random.Generator) -> coal.CollisionGeometry:
    size = rng.uniform(0.03, 0.2, 3)
    match kind:
        case "hull":
            return make_convex_hull(rng.normal(size=(40, 3)) * size)
        case "swept":
            hull = make_convex_hull(rng.normal(size=(12, 3)) * size)
            hull.setSweptSphereRadius(0.01)
            return hull
        case "capsule":
            return coal.Capsule(size[0], 2.0 * size[1])
        case "box":
            return coal.Box(*size)
        case "sphere":
            return coal.Sphere(size[0])
        case "cylinder":
            return coal.Cylinder(size[0], 2.0 * size[1])
        case "cone":
            return coal.Cone(size[0], 2.0 * size[1])
        case "ellipsoid":
            return coal.Ellipsoid(*size)
    hull = make_convex_hull(rng.normal(size=(15, 3)) * size)
    import trimesh

    points = np.asarray(hull.points())
    return make_bvh(trimesh.convex.convex_hull(points))


def make_placement(rng: np.random.Generator, spread: float) -> pin.SE3:
    quaternion = pin.Quaternion(*rng.normal(size=4)).normalized()
    return pin.SE3(quaternion.matrix(), rng.uniform(-spread, spread, 3))


def compute_brute_force(
    shape: coal.CollisionGeometry, where: pin.SE3, points: np.ndarray, radius: float
) -> float:
    """Return the smallest distance to spheres, by coal, or by the support of a hull inside."""
    request = coal.DistanceRequest()
    request.gjk_tolerance = 1e-8
    smallest = np.inf
    inverse = where.inverse()
    for point in points:
        local = inverse.act(point)
        value = coal.distance(
            shape,
            coal.Transform3s(),
            coal.Sphere(radius),
            coal.Transform3s(np.eye(3), local),
            request,
            coal.DistanceResult(),
        )
        if isinstance(shape, coal.Cylinder):
            # coal considers the lateral surface only, of a sphere whose centre is inside.
            radial = np.hypot(local[0], local[1]) - shape.radius
            axial = abs(local[2]) - shape.halfLength
            if radial < 0.0 and axial < 0.0:
                value = max(radial, axial) - radius
        smallest = min(smallest, value)
    return smallest


def make_points(rng: np.random.Generator, count: int = 60) -> np.ndarray:
    return np.asarray(rng.uniform(-0.25, 0.25, (count, 3)))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 10_000), far=st.booleans())
def test_distance_is_the_smallest_distance_to_a_sphere(kind: str, seed: int, far: bool) -> None:
    rng = np.random.default_rng(seed)
    shape = make_shape(kind, rng)
    points = make_points(rng)
    where = make_placement(rng, 0.3)
    if far:
        where.translation += np.array([0.9, 0.0, 0.0])
    there = make_placement(rng, 1.0)
    radius = float(rng.uniform(0.002, 0.03))
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    cloud = PointCloud(points - center, radius)
    placement = there * pin.SE3(np.eye(3), center)
    found = compute_shape_distance(shape, there * where, cloud, placement)
    expected = compute_brute_force(shape, where, points, radius)
    # GJK stops within 1e-6; EPA, in the reference inside a shape, is less exact than closed forms.
    tolerance = 5e-6 if expected > 0.0 else 2e-4
    assert found == pytest.approx(expected, abs=tolerance)
    swapped = compute_shape_distance(cloud, placement, shape, there * where)
    assert swapped == found


@settings(max_examples=30, deadline=None, derandomize=True)
@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 10_000))
def test_witnesses_are_on_both_surfaces(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = make_shape(kind, rng)
    where = make_placement(rng, 0.4)
    points = make_points(rng, 30)
    radius = 0.01
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    placement = pin.SE3(np.eye(3), center)
    shapes = Shapes([shape, PointCloud(points - center, radius)], [placement])
    moving = flatten_placements([where])[None]
    found = shapes.compute_witnesses(moving, np.array([0]), np.array([[0, 1]]))
    distance = found.distance[0]
    normal = found.normal[0]
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)
    between = found.second[0] - found.first[0]
    assert between @ normal == pytest.approx(distance, abs=1e-5)
    from_centers = np.linalg.norm(points - found.second[0], axis=1)
    assert np.abs(from_centers - radius).min() < 1e-5
    # The derivative of the distance along the normal is -1.
    step = 1e-4
    moved = pin.SE3(where.rotation, where.translation - step * normal)
    rows = flatten_placements([moved])[None]
    other = shapes.compute_distances(rows, np.array([0]), np.array([[0, 1]]))[0]
    if distance > 0.0:
        assert (other - distance) / step == pytest.approx(1.0, abs=0.05)


def test_blocks_contain_every_point_once() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-2.0, 2.0, (5000, 3))
    divided = divide_points(points, 0.02)
    assert len(divided) > 100
    restored = np.concatenate([cloud.points + center for cloud, center in divided])
    np.testing.assert_allclose(
        restored[np.lexsort(restored.T)], points[np.lexsort(points.T)], atol=1e-12
    )
    for cloud, center in divided:
        lower, upper = compute_world_box(cloud, pin.SE3(np.eye(3), center))
        own = cloud.points + center
        np.testing.assert_allclose(lower, own.min(axis=0) - 0.02)
        np.testing.assert_allclose(upper, own.max(axis=0) + 0.02)


def test_selection_of_closest_pairs_equals_all_distances() -> None:
    """Bounds that exclude points change neither the selected pairs nor their distances."""
    rng = np.random.default_rng(5)
    divided = divide_points(rng.uniform(-0.6, 0.6, (2000, 3)), 0.01)
    clouds = [cloud for cloud, _ in divided]
    fixed = [pin.SE3(np.eye(3), center) for _, center in divided]
    links = [make_shape("hull", rng), make_shape("capsule", rng)]
    geometry = pin.GeometryModel()
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "base")
    for k, link in enumerate(links):
        placement = make_placement(rng, 0.2)
        geometry.addGeometryObject(pin.GeometryObject(f"l{k}", joint, 0, placement, link))
    all_shapes = [*links, *clouds]
    shapes = Shapes(all_shapes, fixed, threads=1)
    pairs = np.array([(i, 2 + j) for i in range(2) for j in range(len(clouds))])
    halves = []
    centers = []
    for shape in all_shapes:
        shape.computeLocalAABB()
        box = shape.aabb_local
        halves.append(np.array([box.width(), box.height(), box.depth()]) / 2)
        centers.append(np.asarray(box.center()))
    placements = [g.placement for g in geometry.geometryObjects] + fixed
    boxes = Boxes(
        np.array([1, 1, *[0] * len(clouds)]),
        np.array([p.rotation for p in placements]),
        np.array([p.act(c) for p, c in zip(placements, centers, strict=True)]),
        np.array(halves),
        pairs,
    )
    margins = Margins(np.full(len(pairs), 0.02), {})
    bodies = BatchedModel.of_shapes(model, geometry)
    clearances = Clearances(bodies, boxes, shapes, margins)
    q = np.column_stack([rng.uniform(-0.7, 0.7, (20, 2)), np.ones(20), np.zeros(20)])
    z = np.zeros((20, 1))
    waypoints = np.zeros(20, np.int64)
    reach = 0.15
    few = clearances.find_closest_pairs(q, z, waypoints, reach=reach, max_pairs=3)
    moving = bodies.compute_placements(q)
    for row in range(20):
        every = shapes.compute_distances(moving, np.full(len(pairs), row), pairs)
        expected = np.sort(every[every < reach])[:3]
        np.testing.assert_allclose(few.distance[few.row == row], expected, atol=1e-9)
    edges = np.arange(21)
    free = clearances.count_free(q, z, edges, 0, reach=reach, allowed=0.0)
    for row in range(20):
        every = shapes.compute_distances(moving, np.full(len(pairs), row), pairs)
        assert free[row] == (every.min() >= 0.02)


def test_near_points_are_those_within_reach() -> None:
    rng = np.random.default_rng(8)
    shape = make_shape("hull", rng)
    where = make_placement(rng, 0.1)
    points = make_points(rng, 200)
    row = flatten_placements([where])[0]
    near = find_near_points(convert_solid(shape), row, points, 0.05)
    ball = coal.Sphere(1e-9)
    distances = np.array(
        [compute_shape_distance(shape, where, ball, pin.SE3(np.eye(3), p)) for p in points]
    )
    assert 0 < near.sum() < 200
    np.testing.assert_array_equal(near, distances < 0.05 - 1e-9)


def test_points_survive_pickling_in_a_shape() -> None:
    cloud = PointCloud(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]), 0.02)
    placement = pin.SE3(np.eye(3), np.array([1.0, 2.0, 3.0]))
    shape = pin.GeometryObject("cloud", 0, 0, placement, cloud)
    copy = pickle.loads(pickle.dumps(shape))
    assert isinstance(copy.geometry, PointCloud)
    np.testing.assert_array_equal(copy.geometry.points, cloud.points)
    assert copy.geometry.radius == 0.02
    assert copy.placement == placement
    assert copy.name == "cloud"


def test_distances_of_points_and_points_are_refused() -> None:
    cloud = PointCloud(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]), 0.02)
    with pytest.raises((ValueError, InputError), match="points and points"):
        compute_shape_distance(cloud, pin.SE3.Identity(), cloud, pin.SE3.Identity())
