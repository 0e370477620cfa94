"""Tests that batched distances equal coal's bit for bit, for any number of threads."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.collision.distances import Shapes, Witnesses, count_distance_queries
from vkc_pin.world.collision.solids import flatten_placements
from vkc_pin.world.files.meshes import make_convex_hull

MOVING = 4
SEEDS = st.integers(0, 2**32 - 1)


def sample_placement(rng: np.random.Generator, size: float = 0.6) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))


def make_mesh(rng: np.random.Generator) -> coal.BVHModelBase:
    shape, corners = coal.BVHModelOBBRSS(), rng.uniform(-0.3, 0.3, (12, 3))
    shape.beginModel(4, 12)
    shape.addVertices(corners)
    shape.addTriangles(np.arange(12).reshape(4, 3))
    shape.endModel()
    return shape


def sample_normal(rng: np.random.Generator) -> np.ndarray:
    n = rng.normal(size=3)
    return np.asarray(n / np.linalg.norm(n))


def make_solid(kind: str, rng: np.random.Generator) -> coal.CollisionGeometry:
    a, b, c = rng.uniform(0.05, 0.4, 3)
    corners = rng.uniform(-0.3, 0.3, (3, 3))
    makers = {
        "Box": lambda: coal.Box(a, b, c),
        "Sphere": lambda: coal.Sphere(a),
        "Capsule": lambda: coal.Capsule(a, b),
        "Cylinder": lambda: coal.Cylinder(a, b),
        "Cone": lambda: coal.Cone(a, b),
        "Ellipsoid": lambda: coal.Ellipsoid(a, b, c),
        "Convex": lambda: make_convex_hull(rng.normal(scale=0.2, size=(12, 3))),
        "large Convex": lambda: make_convex_hull(
            rng.normal(scale=0.2, size=(400, 3))
        ),  # coal uses hill climbing for hulls of this size
        "TriangleP": lambda: coal.TriangleP(*corners),
        "Halfspace": lambda: coal.Halfspace(sample_normal(rng), a),
        "Plane": lambda: coal.Plane(sample_normal(rng), a),
        "BVHModelOBBRSS": lambda: make_mesh(rng),
    }
    return makers[kind]()


CONVEX = (
    "Box",
    "Sphere",
    "Capsule",
    "Cylinder",
    "Cone",
    "Ellipsoid",
    "Convex",
    "large Convex",
    "TriangleP",
)
KINDS = (*CONVEX, "Halfspace", "Plane", "BVHModelOBBRSS")


def compute_with_bindings(
    first: coal.CollisionGeometry,
    first_placement: pin.SE3,
    second: coal.CollisionGeometry,
    second_placement: pin.SE3,
    tolerance: float = 1e-6,
) -> np.ndarray:
    """Return distance, normal and witness points from a fresh query of coal's bindings."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = tolerance
    first_transform, second_transform = (
        coal.Transform3s(placement.rotation, placement.translation)
        for placement in (first_placement, second_placement)
    )
    coal.distance(first, first_transform, second, second_transform, request, result)
    return np.array(
        [
            result.min_distance,
            *result.normal,
            *result.getNearestPoint1(),
            *result.getNearestPoint2(),
        ]
    )


def stack_table(found: Witnesses) -> np.ndarray:
    return np.column_stack([found.distance, found.normal, found.first, found.second])


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(CONVEX),
    st.sampled_from(KINDS),
    SEEDS,
    st.sampled_from([0.0, 0.0, 0.03]),
    st.sampled_from([1e-6, 1e-8]),
)
def test_distances_equal_those_of_the_bindings(
    first_kind: str, second_kind: str, seed: int, swept: float, tolerance: float
) -> None:
    rng = np.random.default_rng(seed)
    first, second = make_solid(first_kind, rng), make_solid(second_kind, rng)
    if first_kind != "TriangleP":
        first.setSweptSphereRadius(swept)
    first_placement, second_placement = sample_placement(rng), sample_placement(rng)
    placements, pair = (
        flatten_placements([first_placement, second_placement])[None],
        (np.zeros(1, int), np.array([[0, 1]])),
    )
    shapes = Shapes([first, second], tolerance=tolerance)
    try:
        expected = compute_with_bindings(
            first, first_placement, second, second_placement, tolerance
        )
    except (
        RuntimeError,
        ValueError,
    ) as error:  # e.g. triangle–box, or meshes with swept spheres
        with pytest.raises(type(error), match="not yet supported"):
            shapes.compute_distances(placements, *pair)
        return
    np.testing.assert_array_equal(
        stack_table(shapes.compute_witnesses(placements, *pair))[0], expected
    )
    np.testing.assert_array_equal(shapes.compute_distances(placements, *pair), expected[:1])
    with_fixed = Shapes([first, second], [second_placement], tolerance=tolerance)
    np.testing.assert_array_equal(
        stack_table(with_fixed.compute_witnesses(placements[:, :1], *pair))[0], expected
    )


class Room:
    """Random shapes at many states."""

    def __init__(self, seed: int, states: int = 20) -> None:
        rng = np.random.default_rng(seed)
        self.solids = [
            make_solid(kind, rng)
            for kind in ("Box", "Convex", "Cylinder", "Capsule", "Box", "Sphere", "large Convex")
        ]
        self.fixed = [sample_placement(rng) for _ in self.solids[MOVING:]]
        self.placements = [[sample_placement(rng) for _ in range(MOVING)] for _ in range(states)]
        self.flat_placements = np.array([flatten_placements(row) for row in self.placements])
        pairs = [
            pair for pair in itertools.combinations(range(len(self.solids)), 2) if pair[0] < MOVING
        ]
        self.states, which = np.divmod(rng.permutation(states * len(pairs)), len(pairs))
        self.pairs = np.array(pairs)[which]

    def make_shapes(self, threads: int | None = None) -> Shapes:
        return Shapes(self.solids, self.fixed, threads=threads)

    def compute_expected(self) -> np.ndarray:
        rows = []
        for state, (first, second) in zip(self.states, self.pairs.tolist(), strict=True):
            placements = [*self.placements[state], *self.fixed]
            rows.append(
                compute_with_bindings(
                    self.solids[first], placements[first], self.solids[second], placements[second]
                )
            )
        return np.array(rows)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from([None, 0, 1, 3]), st.sampled_from([0.05, 0.3, np.inf]), st.booleans())
def test_closest_pairs_match_an_exhaustive_search(
    seed: int, max_pairs: int | None, reach: float, bounded: bool
) -> None:
    """Holds for trivial lower bounds and for tight ones."""
    room, rng = Room(seed, states=8), np.random.default_rng(seed)
    distances, margins = (
        room.compute_expected()[:, 0],
        rng.choice([0.0, 0.02, 0.1], len(room.pairs)),
    )
    slack = rng.uniform(0.0, 0.2, len(margins)) if bounded else np.inf
    bounds = distances - margins - slack
    order, ranks = np.lexsort((bounds, room.states)), rng.permutation(len(room.pairs))
    expected = []
    for state in range(8):
        near = np.flatnonzero((room.states == state) & (distances < reach))
        near = near[np.lexsort((ranks[near], distances[near], (distances - margins)[near]))]
        expected += near[:max_pairs].tolist()
    chosen, found = room.make_shapes(3).find_closest_pairs(
        room.flat_placements,
        np.searchsorted(room.states[order], np.arange(9)),
        room.pairs[order],
        ranks=ranks[order],
        margins=margins[order],
        bounds=bounds[order],
        reach=reach,
        max_pairs=max_pairs,
        rounding=0.0,
    )
    assert order[chosen].tolist() == expected
    np.testing.assert_array_equal(stack_table(found), room.compute_expected()[order[chosen]])


def test_invalid_arrays_raise() -> None:
    room = Room(0)
    shapes, one = room.make_shapes(), np.zeros(1, int)
    for states, pairs in ((one, [[0, 7]]), (one, [[-1, 0]]), (one + 20, [[0, 1]])):
        with pytest.raises(IndexError):
            shapes.compute_distances(room.flat_placements, states, np.array(pairs))
    with pytest.raises(ValueError, match="shape"):
        shapes.compute_distances(room.flat_placements[:, :2], one, np.array([[0, 1]]))
    with pytest.raises(InputError, match="HeightField"):
        Shapes([coal.HeightFieldAABB(1.0, 1.0, np.zeros((3, 3)), 0.0)])


def test_errors_of_coal_are_raised_from_threads() -> None:
    rng = np.random.default_rng(0)
    shapes = Shapes([make_solid("Box", rng), make_solid("TriangleP", rng)], threads=2)
    placements = flatten_placements([sample_placement(rng), sample_placement(rng)])[None]
    with pytest.raises(ValueError, match="not yet supported"):
        shapes.compute_distances(placements, np.zeros(1000, int), np.tile([[0, 1]], (1000, 1)))


def test_distance_queries_are_counted() -> None:
    room = Room(0)
    before = count_distance_queries()
    room.make_shapes().compute_distances(room.flat_placements, room.states, room.pairs)
    assert count_distance_queries() - before == len(room.pairs)
