"""Distances of many pairs at once are coal's, to the last bit, and do not depend on threads."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.world.collision import shapes as asking
from vkc_pin.world.collision.placements import flatten_placements
from vkc_pin.world.collision.shapes import Shapes, Witnesses, count_distance_queries
from vkc_pin.world.files.meshes import convex_hull

MOVING = 4
SEEDS = st.integers(0, 2**32 - 1)


def anywhere(rng: np.random.Generator, size: float = 0.6) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))


def mesh(rng: np.random.Generator) -> coal.BVHModelBase:
    shape, corners = coal.BVHModelOBBRSS(), rng.uniform(-0.3, 0.3, (12, 3))
    shape.beginModel(4, 12)
    shape.addVertices(corners)
    shape.addTriangles(np.arange(12).reshape(4, 3))
    shape.endModel()
    return shape


def normal(rng: np.random.Generator) -> np.ndarray:
    n = rng.normal(size=3)
    return np.asarray(n / np.linalg.norm(n))


def solid(kind: str, rng: np.random.Generator) -> coal.CollisionGeometry:
    a, b, c = rng.uniform(0.05, 0.4, 3)
    corners = rng.uniform(-0.3, 0.3, (3, 3))
    made = {
        "Box": lambda: coal.Box(a, b, c),
        "Sphere": lambda: coal.Sphere(a),
        "Capsule": lambda: coal.Capsule(a, b),
        "Cylinder": lambda: coal.Cylinder(a, b),
        "Cone": lambda: coal.Cone(a, b),
        "Ellipsoid": lambda: coal.Ellipsoid(a, b, c),
        "Convex": lambda: convex_hull(rng.normal(scale=0.2, size=(12, 3))),
        "large Convex": lambda: convex_hull(
            rng.normal(scale=0.2, size=(400, 3))
        ),  # whose corners coal climbs along
        "TriangleP": lambda: coal.TriangleP(*corners),
        "Halfspace": lambda: coal.Halfspace(normal(rng), a),
        "Plane": lambda: coal.Plane(normal(rng), a),
        "BVHModelOBBRSS": lambda: mesh(rng),
    }
    return made[kind]()


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


def by_coal(
    first: coal.CollisionGeometry,
    here: pin.SE3,
    second: coal.CollisionGeometry,
    there: pin.SE3,
    tolerance: float = 1e-6,
) -> np.ndarray:
    """Return distance, normal and witness points, as coal's bindings give them when asked for nothing else."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    request.gjk_tolerance = tolerance
    one, other = (coal.Transform3s(place.rotation, place.translation) for place in (here, there))
    coal.distance(first, one, second, other, request, result)
    return np.array(
        [
            result.min_distance,
            *result.normal,
            *result.getNearestPoint1(),
            *result.getNearestPoint2(),
        ]
    )


def table(found: Witnesses) -> np.ndarray:
    return np.column_stack([found.distance, found.normal, found.first, found.second])


@settings(max_examples=400, deadline=None)
@given(
    st.sampled_from(CONVEX),
    st.sampled_from(KINDS),
    SEEDS,
    st.sampled_from([0.0, 0.0, 0.03]),
    st.sampled_from([1e-6, 1e-8]),
)
def test_distances_are_those_of_the_bindings(
    one: str, other: str, seed: int, swept: float, tolerance: float
) -> None:
    rng = np.random.default_rng(seed)
    first, second = solid(one, rng), solid(other, rng)
    if one != "TriangleP":
        first.setSweptSphereRadius(swept)
    here, there = anywhere(rng), anywhere(rng)
    where, pair = flatten_placements([here, there])[None], (np.zeros(1, int), np.array([[0, 1]]))
    both = Shapes([first, second], tolerance=tolerance)
    try:
        expected = by_coal(first, here, second, there, tolerance)
    except (
        RuntimeError,
        ValueError,
    ) as error:  # triangles and boxes, meshes and what has a radius swept around it
        with pytest.raises(type(error), match="not yet supported"):
            both.distances(where, *pair)
        return
    np.testing.assert_array_equal(table(both.witnesses(where, *pair))[0], expected)
    np.testing.assert_array_equal(both.distances(where, *pair), expected[:1])
    stands = Shapes([first, second], [there], tolerance=tolerance)
    np.testing.assert_array_equal(table(stands.witnesses(where[:, :1], *pair))[0], expected)


def test_meshes() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        first, second, here, there = mesh(rng), mesh(rng), anywhere(rng), anywhere(rng)
        both = Shapes([first, second]).witnesses(
            flatten_placements([here, there])[None], np.zeros(1, int), np.array([[0, 1]])
        )
        told = [0, *range(4, 10)]  # coal writes no normal for two meshes
        np.testing.assert_array_equal(
            table(both)[0, told], by_coal(first, here, second, there)[told]
        )


class Room:
    """Some shapes at many states."""

    def __init__(self, seed: int, states: int = 20) -> None:
        rng = np.random.default_rng(seed)
        self.solids = [
            solid(kind, rng)
            for kind in ("Box", "Convex", "Cylinder", "Capsule", "Box", "Sphere", "large Convex")
        ]
        self.standing = [anywhere(rng) for _ in self.solids[MOVING:]]
        self.places = [[anywhere(rng) for _ in range(MOVING)] for _ in range(states)]
        self.where = np.array([flatten_placements(row) for row in self.places])
        pairs = [
            pair for pair in itertools.combinations(range(len(self.solids)), 2) if pair[0] < MOVING
        ]
        self.states, which = np.divmod(rng.permutation(states * len(pairs)), len(pairs))
        self.pairs = np.array(pairs)[which]

    def shapes(self, threads: int | None = None) -> Shapes:
        return Shapes(self.solids, self.standing, threads=threads)

    def expected(self, standing: Sequence[pin.SE3] | None = None) -> np.ndarray:
        rows = []
        for state, (first, second) in zip(self.states, self.pairs.tolist(), strict=True):
            at = [*self.places[state], *(self.standing if standing is None else standing)]
            rows.append(by_coal(self.solids[first], at[first], self.solids[second], at[second]))
        return np.array(rows)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_many_pairs_in_any_order_and_by_any_number_of_threads(seed: int) -> None:
    room = Room(seed)
    expected = room.expected()
    assert 0 < (expected[:, 0] < 0).sum() < len(expected)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asking, "_WORTH", 1)
        for threads in (1, 2, 5):
            shapes = room.shapes(threads)
            np.testing.assert_array_equal(
                table(shapes.witnesses(room.where, room.states, room.pairs)), expected
            )
            np.testing.assert_array_equal(
                shapes.distances(room.where, room.states, room.pairs), expected[:, 0]
            )


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([None, 0, 1, 3]), st.sampled_from([0.05, 0.3, np.inf]), st.booleans())
def test_those_that_fall_shortest_of_their_margins(
    seed: int, most: int | None, reach: float, bounded: bool
) -> None:
    """With lower bounds that tell nothing, or as much as bounds can."""
    room, rng = Room(seed, states=8), np.random.default_rng(seed)
    distances, margins = room.expected()[:, 0], rng.choice([0.0, 0.02, 0.1], len(room.pairs))
    bounds = (
        distances - margins - rng.uniform(0.0, 0.2, len(margins))
        if bounded
        else np.full(len(margins), -np.inf)
    )
    order, numbers = np.lexsort((bounds, room.states)), rng.permutation(len(room.pairs))
    edges = np.searchsorted(room.states[order], np.arange(9))
    wanted = []
    for state in range(8):
        near = np.flatnonzero((room.states == state) & (distances < reach))
        near = near[np.lexsort((numbers[near], distances[near], (distances - margins)[near]))]
        wanted += near[:most].tolist()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asking, "_WORTH", 1)
        for threads in (1, 3):
            chosen, found = room.shapes(threads).shortest(
                room.where,
                edges,
                room.pairs[order],
                numbers=numbers[order],
                margins=margins[order],
                bounds=bounds[order],
                reach=reach,
                most=most,
                rounding=0.0,
            )
            assert order[chosen].tolist() == wanted
            np.testing.assert_array_equal(table(found), room.expected()[order[chosen]])


def test_of_equal_ones_the_lower_number_comes_first() -> None:
    balls = [coal.Sphere(0.1)] * 4
    where = flatten_placements(
        [pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0, -1.0, 1.0)]
    )[None]
    pairs = np.array([[0, 1], [0, 2], [0, 3]])
    for numbers, expected in (([3, 2, 1], [2, 0]), ([1, 2, 3], [0, 2])):
        pick = np.array([0, 2])
        known = {"margins": np.zeros(2), "bounds": np.zeros(2), "reach": np.inf, "rounding": 0.0}
        chosen, _ = Shapes(balls).shortest(
            where,
            np.array([0, 2]),
            pairs[pick],
            numbers=np.array(numbers)[pick],
            most=None,
            **known,
        )
        assert pick[chosen].tolist() == expected


def test_only_what_may_be_among_the_shortest_is_asked_for() -> None:
    """A pair whose bound says that it is further is left out, even where the bound is wrong."""
    balls = [coal.Sphere(0.1)] * 3
    where = flatten_placements(
        [pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0, 0.5)]
    )[None]
    pairs, bounds = np.array([[0, 1], [0, 2]]), np.array([0.5, 5.0])
    known = {
        "numbers": np.arange(2),
        "margins": np.zeros(2),
        "bounds": bounds,
        "reach": np.inf,
        "rounding": 1e-6,
    }
    assert Shapes(balls).shortest(where, np.array([0, 2]), pairs, most=1, **known)[0].tolist() == [
        0
    ]
    assert Shapes(balls).shortest(where, np.array([0, 2]), pairs, most=None, **known)[
        0
    ].tolist() == [1, 0]


def test_what_stands_elsewhere() -> None:
    room, place = Room(1), anywhere(np.random.default_rng(2))
    shapes = room.shapes()
    other = shapes.placed({MOVING + 1: place})
    standing = [room.standing[0], place, *room.standing[2:]]
    np.testing.assert_array_equal(
        table(other.witnesses(room.where, room.states, room.pairs)), room.expected(standing)
    )
    np.testing.assert_array_equal(
        table(shapes.witnesses(room.where, room.states, room.pairs)), room.expected()
    )
    with pytest.raises(IndexError, match="stands"):
        shapes.placed({0: place})


@settings(max_examples=50, deadline=None)
@given(st.sampled_from(CONVEX[:-1]), st.sampled_from(CONVEX[:-1]), SEEDS)
def test_who_is_first_makes_no_difference_but_of_sign(one: str, other: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    both = Shapes([solid(one, rng), solid(other, rng)], tolerance=1e-8)
    where = flatten_placements([anywhere(rng, 1.5), anywhere(rng, 1.5)])[None]
    there, back = table(both.witnesses(where, np.zeros(2, int), np.array([[0, 1], [1, 0]])))
    if min(there[0], back[0]) > 1e-3:
        assert there[0] == pytest.approx(back[0], abs=1e-5)
        np.testing.assert_allclose(there[1:4], -back[1:4], atol=1e-2)


def test_a_million_pairs() -> None:
    balls = Shapes(
        [coal.Sphere(0.1), coal.Sphere(0.2)], [pin.SE3(np.eye(3), np.array([0.0, 0.0, 3.0]))]
    )
    where = np.tile(flatten_placements([pin.SE3.Identity()]), (1000, 1, 1))
    where[:, 0, 11] = np.linspace(-1.0, 1.0, 1000)
    states = np.random.default_rng(0).integers(0, 1000, 1_000_000)
    found = balls.distances(where, states, np.tile([[0, 1]], (1_000_000, 1)))
    np.testing.assert_allclose(found, 2.7 - where[states, 0, 11], atol=1e-6)


def test_nothing_asked_nothing_found() -> None:
    room = Room(0)
    none = np.zeros(0, int), np.zeros((0, 2), int)
    for where in (room.where, room.where[:0]):
        assert room.shapes().distances(where, *none).shape == (0,)
        assert table(room.shapes().witnesses(where, *none)).shape == (0, 10)
    chosen, found = room.shapes().shortest(
        room.where,
        np.zeros(21, int),
        none[1],
        numbers=none[0],
        margins=np.zeros(0),
        bounds=np.zeros(0),
        reach=1.0,
        most=3,
        rounding=0.0,
    )
    assert len(chosen) == len(found.distance) == 0
    assert Shapes([]).distances(np.zeros((1, 0, 12)), *none).shape == (0,)


def test_wrong_numbers_are_refused() -> None:
    room = Room(0)
    shapes, one = room.shapes(), np.zeros(1, int)
    for states, pairs in (
        (one, [[0, 7]]),
        (one, [[-1, 0]]),
        (one + 20, [[0, 1]]),
        (one - 1, [[0, 1]]),
    ):
        with pytest.raises(IndexError):
            shapes.distances(room.where, states, np.array(pairs))
    with pytest.raises(ValueError, match="shape"):
        shapes.distances(room.where[:, :2], one, np.array([[0, 1]]))
    with pytest.raises(ValueError, match="states"):
        shapes.distances(room.where, np.zeros(2, int), np.array([[0, 1]]))
    known = {
        "numbers": one,
        "margins": np.zeros(1),
        "bounds": np.zeros(1),
        "reach": 1.0,
        "most": 1,
        "rounding": 0.0,
    }
    for edges in ([0, 2, 1], [0, 1], [1] * 21, [0] * 21):
        with pytest.raises(ValueError, match="edges"):
            shapes.shortest(room.where, np.array(edges), np.array([[0, 1]]), **known)
    with pytest.raises(InputError, match="HeightField"):
        Shapes([coal.HeightFieldAABB(1.0, 1.0, np.zeros((3, 3)), 0.0)])


def test_what_coal_cannot_do_is_an_error_in_threads_too() -> None:
    rng = np.random.default_rng(0)
    both = Shapes([solid("Box", rng), solid("TriangleP", rng)], threads=2)
    where = flatten_placements([anywhere(rng), anywhere(rng)])[None]
    with pytest.raises(ValueError, match="not yet supported"):
        both.distances(where, np.zeros(1000, int), np.tile([[0, 1]], (1000, 1)))


def test_how_many_were_asked_for() -> None:
    room = Room(0)
    before = count_distance_queries()
    room.shapes().distances(room.where, room.states, room.pairs)
    assert count_distance_queries() - before == len(room.pairs)
