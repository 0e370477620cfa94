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
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.distances import Clearances, MarginRegion, Margins, Shapes
from vkc_pin.world.collision.solids import ShapePlacements

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
        self.shapes = [coal.Box(*(2 * half)) for half in self.halves]
        for k in range(MOVING):
            joint = 1 + int(rng.integers(3))
            self.geometry.addGeometryObject(
                pin.GeometryObject(f"s{k}", joint, 0, sample_placement(rng, 0.2), self.shapes[k])
            )
        self.joints = np.array(
            [*(s.parentJoint for s in self.geometry.geometryObjects), *[0] * FIXED]
        )
        self.fixed = [sample_placement(rng, 0.6) for _ in range(FIXED)]
        self.pairs = np.array(
            [(a, b) for a, b in itertools.combinations(range(MOVING + FIXED), 2) if a < MOVING]
        )
        self.default_margins = rng.choice([0.0, 0.02, 0.1], len(self.pairs))
        self.q = np.array(
            [
                pin.integrate(self.model, pin.neutral(self.model), rng.normal(size=5))
                for _ in range(STATES)
            ]
        )
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
        placed = [*(shape.placement for shape in self.geometry.geometryObjects), *self.fixed]
        rotations = np.array([placement.rotation for placement in placed])
        centers = np.array([placement.translation for placement in placed])
        shapes = Shapes(self.shapes, self.fixed, threads=4)
        boxes = Boxes(self.joints, rotations, centers, self.halves, self.pairs)
        return Clearances(ShapePlacements(self.model, self.geometry), boxes, shapes, self.margins)

    def list_close_pairs(
        self, reach: float, include_fixed: bool
    ) -> list[list[tuple[float, float, int, float]]]:
        """Return (distance − margin, distance, pair, margin) of close pairs, sorted, by state."""
        data, placed, found = self.model.createData(), pin.GeometryData(self.geometry), []
        pairs = np.arange(len(self.pairs))
        for state, q in enumerate(self.q):
            pin.updateGeometryPlacements(self.model, data, self.geometry, placed, q)
            placements, rows = [*placed.oMg, *self.fixed], []
            margins = self.margins.compute_margins(
                pairs,
                np.full(len(pairs), self.waypoints[state]),
                self.z,
                np.full(len(pairs), state),
            )
            for k, (a, b) in enumerate(self.pairs.tolist()):
                request, result = coal.DistanceRequest(), coal.DistanceResult()
                transforms = [
                    coal.Transform3s(placements[i].rotation, placements[i].translation)
                    for i in (a, b)
                ]
                distance = coal.distance(
                    self.shapes[a], transforms[0], self.shapes[b], transforms[1], request, result
                )
                if distance < reach and margins[k] > -np.inf and (include_fixed or b < MOVING):
                    rows.append(
                        (float(distance - margins[k]), float(distance), k, float(margins[k]))
                    )
            found.append(sorted(rows))
        return found


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
            actual = zip(
                *(
                    part.tolist()
                    for part in (found.row, slack, found.distance, found.pair, found.margin)
                ),
                strict=True,
            )
            assert [*actual] == expected
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
    expected = hit.index(True) if True in hit else STATES
    actual = room.make_clearances().find_first_violation(
        room.q[order], room.z[order], waypoint, reach=reach, allowed=allowed
    )
    assert actual == expected
    assert (
        room.make_clearances().find_first_violation(
            room.q[:0], room.z[:0], waypoint, reach=reach, allowed=allowed
        )
        == 0
    )


def test_fixed_shapes_can_be_moved() -> None:
    room = Room(4)
    before, placement = room.make_clearances(), sample_placement(room.rng, 0.6)
    moved = np.array([MOVING + 2])
    boxes = before.boxes.move_fixed(moved, placement.rotation[None], placement.translation[None])
    after = before.move_fixed(boxes, {MOVING + 2: placement})
    room.fixed[2] = placement
    for actual, expected in zip(
        *(
            c.find_closest_pairs(room.q, room.z, room.waypoints, reach=0.3)
            for c in (after, room.make_clearances())
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(actual, expected)
    unmoved = (
        Room(4).make_clearances().find_closest_pairs(room.q, room.z, room.waypoints, reach=0.3)
    )
    np.testing.assert_array_equal(
        before.find_closest_pairs(room.q, room.z, room.waypoints, reach=0.3).distance,
        unmoved.distance,
    )


def test_mismatched_sizes_raise() -> None:
    room = Room(0)
    clearances = room.make_clearances()
    for q, z, waypoints in (
        (room.q[:, :-1].copy(), room.z, room.waypoints),
        (room.q, room.z[:-1], room.waypoints),
        (room.q, room.z[:, :1].copy(), room.waypoints),
        (room.q, room.z, room.waypoints[:-1]),
    ):
        with pytest.raises(ValueError, match=r"shape|waypoints"):
            clearances.find_closest_pairs(q, z, waypoints, reach=0.1)
    fewer = Margins(room.default_margins[:-1], {})
    with pytest.raises(ValueError, match="belong"):
        Clearances(
            clearances.placements, clearances.boxes, clearances.shapes, fewer
        ).find_closest_pairs(room.q, room.z, room.waypoints, reach=0.1)


PAIRS, COORDINATES = 12, 4


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_smallest_margin_applies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    default_margins = rng.uniform(0.0, 0.05, PAIRS)
    reduced = {
        int(pair): [
            (int(first), int(first + rng.integers(4)), float(rng.normal()))
            for first in rng.integers(0, 8, 2)
        ]
        for pair in rng.permutation(PAIRS)[:4]
    }
    regions = []
    for _ in range(3):
        columns, low = rng.permutation(COORDINATES)[: rng.integers(1, 3)], rng.normal(size=4)
        lower = low[: len(columns)]
        margin = float(rng.choice([-np.inf, -0.01, 0.01]))
        regions.append(
            MarginRegion(rng.permutation(PAIRS)[:5], margin, columns, lower, lower + 1.5)
        )
    pairs, waypoints = (grid.ravel() for grid in np.meshgrid(np.arange(PAIRS), np.arange(10)))
    z, rows = rng.normal(size=(6, COORDINATES)), rng.integers(0, 6, len(pairs))
    expected = []
    for pair, waypoint, row in zip(pairs.tolist(), waypoints.tolist(), rows.tolist(), strict=True):
        margins = [
            default_margins[pair],
            *(margin for first, last, margin in reduced.get(pair, ()) if first <= waypoint <= last),
        ]
        for region in regions:
            values = z[row, region.columns]
            if pair in region.pairs and np.all((region.lower <= values) & (values <= region.upper)):
                margins.append(region.margin)
        expected.append(min(margins))
    assert expected != default_margins[pairs].tolist(), "no margin is reduced"
    np.testing.assert_array_equal(
        Margins(default_margins, reduced, regions).compute_margins(pairs, waypoints, z, rows),
        expected,
    )
