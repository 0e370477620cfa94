"""Tests the search for margin violations against Pinocchio and coal, pair by pair."""

from __future__ import annotations

import itertools

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.world.collision import distances as distances_module
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.distances import Clearances, MarginRegion, Margins, Shapes
from vkc_pin.world.models.shapes import compute_shape_distance

SEEDS = st.integers(0, 2**32 - 1)
MOVING, FIXED, STATES, WAYPOINTS = 6, 7, 10, 5


def sample_placement(rng: np.random.Generator, size: float) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))


class Room:
    """Boxes on an arm among fixed boxes; some pairs have reduced margins."""

    def __init__(self, seed: int) -> None:
        rng = self.rng = np.random.default_rng(seed)
        self.model, self.geometry, parent = pin.Model(), pin.GeometryModel(), 0
        for k, joint in enumerate((pin.JointModelPlanar, pin.JointModelRZ, pin.JointModelRX)):
            parent = self.model.addJoint(parent, joint(), sample_placement(rng, 0.3), f"j{k}")
        self.halves = rng.uniform(0.02, 0.2, (MOVING + FIXED, 3))
        self.solids = [coal.Box(*(2 * half)) for half in self.halves]
        for k, solid in enumerate(self.solids[:MOVING]):
            joint, at = 1 + int(rng.integers(3)), sample_placement(rng, 0.2)
            self.geometry.addGeometryObject(pin.GeometryObject(f"s{k}", joint, 0, at, solid))
        self.fixed = [sample_placement(rng, 0.6) for _ in range(FIXED)]
        self.pairs = np.array(
            [(a, b) for a, b in itertools.combinations(range(MOVING + FIXED), 2) if a < MOVING]
        )
        self.default_margins = rng.choice([0.0, 0.02, 0.1], len(self.pairs))
        self.q = pin.neutral(self.model) * np.ones((STATES, 1))
        for row in self.q:
            row[:] = pin.integrate(self.model, row, rng.normal(size=5))
        self.z, self.waypoints = rng.normal(size=(STATES, 2)), rng.integers(0, WAYPOINTS, STATES)
        reduced = {int(pair): [(1, 3, -0.05)] for pair in rng.permutation(len(self.pairs))[:8]}
        exempt = MarginRegion(
            rng.permutation(len(self.pairs))[:20],
            -np.inf,
            np.array([1]),
            np.zeros(1),
            np.full(1, 9.0),
        )
        self.margins = Margins(self.default_margins, reduced, [exempt])

    def make_clearances(self) -> Clearances:
        moving = self.geometry.geometryObjects
        joints = np.array([*(shape.parentJoint for shape in moving), *[0] * FIXED])
        placed = [*(shape.placement for shape in moving), *self.fixed]
        rotations = np.array([placement.rotation for placement in placed])
        centers = np.array([placement.translation for placement in placed])
        boxes = Boxes(joints, rotations, centers, self.halves, self.pairs)
        shapes = Shapes(self.solids, self.fixed, threads=4)
        return Clearances(
            BatchedModel.of_shapes(self.model, self.geometry), boxes, shapes, self.margins
        )

    def compute_distances(self) -> np.ndarray:
        """Return the distances of all pairs at all states, shape (STATES, P) [m]."""
        data, placed = self.model.createData(), pin.GeometryData(self.geometry)
        distances = np.empty((STATES, len(self.pairs)))
        for state, q in enumerate(self.q):
            pin.updateGeometryPlacements(self.model, data, self.geometry, placed, q)
            at = [*placed.oMg, *self.fixed]
            for k, (a, b) in enumerate(self.pairs.tolist()):
                distances[state, k] = compute_shape_distance(
                    self.solids[a], at[a], self.solids[b], at[b]
                )
        return distances

    def list_close_pairs(
        self, reach: float, include_fixed: bool
    ) -> list[list[tuple[float, float, int, float]]]:
        """Return (distance − margin, distance, pair, margin) of close pairs, sorted, by state."""
        found, pairs = [], np.arange(len(self.pairs))
        for state, distances in enumerate(self.compute_distances()):
            waypoints, states = (np.full(len(pairs), k) for k in (self.waypoints[state], state))
            margins = self.margins.compute_margins(pairs, waypoints, self.z, states)
            close = (distances < reach) & (margins > -np.inf)
            close &= include_fixed | (self.pairs[:, 1] < MOVING)
            rows = (distances - margins, distances, pairs, margins)
            found.append(sorted(zip(*(row[close].tolist() for row in rows), strict=True)))
        return found


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.sampled_from([None, 0, 1, 3]), st.sampled_from([0.05, 0.3, np.inf]), st.booleans())
def test_closest_shapes_match_an_exhaustive_search(
    seed: int, max_pairs: int | None, reach: float, bounded: bool
) -> None:
    room = Room(seed)
    distances, margins = room.compute_distances(), room.default_margins
    slack = room.rng.uniform(0.0, 0.2, distances.shape) if bounded else np.inf
    bounds = distances - margins - slack
    order, count = np.argsort(bounds, axis=1), len(margins)
    chosen, found = Shapes(room.solids, room.fixed, threads=3).find_closest_pairs(
        BatchedModel.of_shapes(room.model, room.geometry).compute_placements(room.q),
        count * np.arange(STATES + 1),
        room.pairs[order.ravel()],
        ranks=order.ravel(),
        margins=margins[order].ravel(),
        bounds=np.sort(bounds).ravel(),
        reach=reach,
        max_pairs=max_pairs,
        rounding=0.0,
    )
    expected: list[tuple[int, int]] = []
    for state, row in enumerate(distances):
        near = np.flatnonzero(row < reach)
        near = near[np.lexsort((near, row[near], (row - margins)[near]))][:max_pairs]
        expected += [(state, pair) for pair in near.tolist()]
    assert list(zip(chosen // count, order.ravel()[chosen], strict=True)) == expected
    np.testing.assert_array_equal(found.distance, [distances[one] for one in expected])


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([None, 0, 1, 4]), st.sampled_from([0.0, 0.1, 2.0]), st.booleans())
def test_closest_pairs_match_an_exhaustive_search(
    seed: int, max_pairs: int | None, reach: float, include_fixed: bool
) -> None:
    room = Room(seed)
    expected = [
        (state, *row)
        for state, rows in enumerate(room.list_close_pairs(reach, include_fixed))
        for row in rows[:max_pairs]
    ]
    with pytest.MonkeyPatch.context() as patch:
        for rows_per_thread in (1, 100):  # four threads, and one
            patch.setattr(distances_module, "_MIN_ROWS_PER_THREAD", rows_per_thread)
            found = room.make_clearances().find_closest_pairs(
                room.q,
                room.z,
                room.waypoints,
                reach=reach,
                max_pairs=max_pairs,
                include_fixed=include_fixed,
            )
            slack = found.distance - found.margin
            parts = found.row, slack, found.distance, found.pair, found.margin
            assert list(zip(*(part.tolist() for part in parts), strict=True)) == expected
            projections = np.einsum("ci,ci->c", found.normal, found.second - found.first)
            np.testing.assert_allclose(projections, found.distance, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([0.0, 0.1]), st.sampled_from([-0.05, 0.0, 0.02, 0.12, 0.3]))
def test_first_violation_matches_an_exhaustive_search(
    seed: int, reach: float, allowed: float
) -> None:
    room = Room(seed)
    room.waypoints[:] = waypoint = int(room.waypoints[0])
    rows, order = room.list_close_pairs(reach, include_fixed=True), room.rng.permutation(STATES)
    hit = [
        any(margin - distance > allowed for _, distance, _, margin in rows[state])
        for state in order
    ]
    cuts = np.sort(room.rng.integers(STATES + 1, size=3))
    edges = np.array([0, *cuts, STATES])
    runs = [hit[first:end] for first, end in itertools.pairwise(edges)]
    expected = [run.index(True) if True in run else len(run) for run in runs]
    clearances, limits = room.make_clearances(), {"reach": reach, "allowed": allowed}
    q, z = room.q[order], room.z[order]
    assert clearances.count_free(q, z, edges, waypoint, **limits).tolist() == expected
    assert clearances.count_free(q[:0], z[:0], np.zeros(1, int), waypoint, **limits).size == 0


def test_fixed_shapes_can_be_moved() -> None:
    room = Room(4)
    before, placement = room.make_clearances(), sample_placement(room.rng, 0.6)
    moved = np.array([MOVING + 2])
    boxes = before.boxes.move_fixed(moved, placement.rotation[None], placement.translation[None])
    after = before.move_fixed(boxes, {MOVING + 2: placement})
    room.fixed[2] = placement
    unmoved, fresh = Room(4).make_clearances(), room.make_clearances()
    for one, other in ((after, fresh), (before, unmoved)):
        found, expected = (
            clearances.find_closest_pairs(room.q, room.z, room.waypoints, reach=0.3)
            for clearances in (one, other)
        )
        np.testing.assert_equal(found._asdict(), expected._asdict())


def test_mismatched_sizes_raise() -> None:
    room = Room(0)
    clearances = room.make_clearances()
    for q, z, waypoints in (
        (room.q[:, :-1].copy(), room.z, room.waypoints),
        (room.q, room.z[:, :1].copy(), room.waypoints),
        (room.q, room.z, room.waypoints[:-1]),
    ):
        with pytest.raises(ValueError, match=r"shape|waypoints"):
            clearances.find_closest_pairs(q, z, waypoints, reach=0.1)
    clearances.margins = Margins(room.default_margins[:-1], {})
    fewer = clearances.move_fixed(clearances.boxes, {})
    with pytest.raises(ValueError, match="belong"):
        fewer.find_closest_pairs(room.q, room.z, room.waypoints, reach=0.1)


PAIRS, COORDINATES = 12, 4


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_smallest_margin_applies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    default_margins = rng.uniform(0.0, 0.05, PAIRS)
    reduced = {
        int(pair): [(int(k), int(k) + 2, float(rng.normal())) for k in rng.integers(8, size=2)]
        for pair in rng.permutation(PAIRS)[:4]
    }
    regions = []
    for margin in (-np.inf, -0.01, 0.01):
        columns = rng.permutation(COORDINATES)[: rng.integers(1, 3)]
        lower = rng.normal(size=len(columns))
        pairs = rng.permutation(PAIRS)[:5]
        regions.append(MarginRegion(pairs, margin, columns, lower, lower + 1.5))
    pairs, waypoints = (grid.ravel() for grid in np.meshgrid(np.arange(PAIRS), np.arange(10)))
    z, rows = rng.normal(size=(6, COORDINATES)), rng.integers(0, 6, len(pairs))
    expected = default_margins[pairs]
    for pair, spans in reduced.items():
        for first, last, margin in spans:
            active = (pairs == pair) & (first <= waypoints) & (waypoints <= last)
            expected[active] = np.minimum(expected[active], margin)
    for region in regions:
        values = z[rows][:, region.columns]
        active = ((region.lower <= values) & (values <= region.upper)).all(axis=1)
        active &= np.isin(pairs, region.pairs)
        expected[active] = np.minimum(expected[active], region.margin)
    assert (expected < default_margins[pairs]).any(), "no margin is reduced"
    margins = Margins(default_margins, reduced, regions)
    np.testing.assert_array_equal(margins.compute_margins(pairs, waypoints, z, rows), expected)
