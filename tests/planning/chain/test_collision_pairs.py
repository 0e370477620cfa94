"""Tests margins of single pairs: hand and grasped object, exemptions, and the floor."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from vkc_pin.options import Options
from vkc_pin.planning.chain import collision_pairs as module
from vkc_pin.planning.chain.collision_pairs import _compute_boxes, _PairBuilder
from vkc_pin.planning.chain.contacts import Contacts, make_empty_contacts
from vkc_pin.world.scene.clearance_exemptions import ClearanceExemption
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH
from vkc_pin.world.scene.obstacles import FLOOR


def pairing(*find_clearance_exemptions: ClearanceExemption, **fields: Any) -> Any:
    made = object.__new__(_PairBuilder)
    made._allowances = find_clearance_exemptions
    made.options = Options(dist_safe=0.02)
    for name, value in fields.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize(
    ("one", "link", "as_one", "clearance", "expected"),
    [
        ("arm", "lever", True, 0.005, 0.02),  # does not take hold
        ("arm", "panel", False, 0.0, 0.02),
        ("hand", "panel", True, 0.005, 0.005),
        ("hand", "panel", True, 0.0, 0.0),
        ("hand", "lever", True, 0.005, -np.inf),
        ("hand", "lever", False, 0.005, 0.005),
        ("hand", "lever", False, 0.0, -CONTACT_DEPTH),  # it touches it
    ],
)
def test_margin_from_grasped_object(
    one: str,
    link: str,
    as_one: bool,
    clearance: float,
    expected: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "find_touch_links", lambda scene, hold: ("hand",))
    monkeypatch.setattr(module, "find_grasped_link", lambda scene, hold: "lever")
    monkeypatch.setattr(module, "is_rigid_grasp", lambda scene, hold: as_one)
    monkeypatch.setattr(
        module, "compute_hand_clearance", lambda scene, hold, link, options: clearance
    )
    assert pairing(scene=None)._find_attached_margin(None, one, link) == expected


LABELS = ["arm", "tray", "side", "tray", "lid"]  # a link may have several shapes
TABLE = [(0, 1, 0.02), (1, 2, 0.02), (2, 3, 0.01), (0, 4, 0.02), (3, 4, 0.02), (2, 4, 0.02)]
SLIDE = {"drawer.slide": (-0.1, 0.4)}


WITHIN = np.array([5]), np.array([-0.1]), np.array([0.4])


def allowed(*find_clearance_exemptions: ClearanceExemption, within: Any = WITHIN) -> Any:
    """Return the pairs with their margins, and where some may be close: (pairs, margin) each."""
    made = pairing(*find_clearance_exemptions)
    made._resolve_ranges = lambda phase, ranges: (
        within if ranges else (np.zeros(0, int), np.zeros(0), np.zeros(0))
    )
    table, near = made._apply_exemptions(None, np.array(TABLE), LABELS, LABELS)
    for place in near:
        assert place[2:] == within
    return table.tolist(), [(place[0].tolist(), place[1]) for place in near]


def test_exemptions_reduce_margins() -> None:
    """An exemption applies to all shapes of both links in any order, if it reduces their margin."""
    rows = [list(row) for row in TABLE]
    assert allowed() == (rows, [])
    for pair in (("side", "tray"), ("tray", "side")):
        kept, near = allowed(ClearanceExemption(*pair, 0.003, 0.003))
        assert near == []
        assert kept == [
            [
                *row[:2],
                0.003 if sorted(LABELS[int(k)] for k in row[:2]) == ["side", "tray"] else row[2],
            ]
            for row in rows
        ]
        kept, _ = allowed(ClearanceExemption(*pair, 0.015, 0.015))
        assert [row[2] for row in kept] == [0.02, 0.015, 0.01, 0.02, 0.02, 0.02]
    assert allowed(
        ClearanceExemption("side", "cup", 0.0, 0.0), ClearanceExemption("cup", "tray", 0.0, 0.0)
    ) == (
        rows,
        [],
    )


def test_pairs_allowed_to_overlap_are_removed() -> None:
    kept, near = allowed(ClearanceExemption("tray", "side", -np.inf, -np.inf))
    assert kept == [[0.0, 1.0, 0.02], [0.0, 4.0, 0.02], [3.0, 4.0, 0.02], [2.0, 4.0, 0.02]]
    assert near == []


@pytest.mark.parametrize(
    ("margin", "distance", "expected"),
    [(0.0, 0.008, 0.004), (0.0, -0.003, 0.0), (-0.003, -0.002, -0.003), (-np.inf, 0.01, -np.inf)],
)
def test_neighbours_keep_half_their_initial_distance(
    margin: float, distance: float, expected: float
) -> None:
    """Rows are those of the table without what is no pair."""
    gone = ClearanceExemption("tray", "side", -np.inf, -np.inf)
    kept, near = allowed(gone, ClearanceExemption("tray", "lid", margin, distance, SLIDE))
    assert len(kept) == 4
    assert near == [([2], expected)]
    assert allowed(ClearanceExemption("side", "tray", margin, distance, SLIDE))[1] == [
        ([1, 2], expected)
    ]
    assert (
        allowed(ClearanceExemption("arm", "side", margin, distance, SLIDE))[1] == []
    )  # they are no pair
    assert allowed(gone, ClearanceExemption("tray", "side", margin, distance, SLIDE))[1] == []
    assert (
        allowed(ClearanceExemption("tray", "lid", margin, distance, SLIDE), within=None)[1] == []
    )  # never where that holds


def within(ranges: dict[str, tuple[float, float]], before: dict[str, float]) -> Any:
    chain = SimpleNamespace(
        names=("base_x", "door.hinge", "drawer.slide"),
        index=("base_x", "door.hinge", "drawer.slide").index,
    )
    placed = SimpleNamespace(
        state=[0.25, 0.5],
        object=SimpleNamespace(coordinates=SimpleNamespace(index=("left", "right").index)),
    )
    made = pairing(chain=chain, scene=SimpleNamespace(objects={"cupboard": placed}))
    return made._resolve_ranges(SimpleNamespace(initial_values=before), ranges)


def test_joint_ranges_of_exemptions() -> None:
    """Moving coordinates get limits; fixed ones must be in range at the start of the phase."""
    columns, low, high = within({"drawer.slide": (0.0, 0.1), "door.hinge": (-1.0, 1.0)}, {})
    assert (columns.tolist(), low.tolist(), high.tolist()) == ([2, 1], [0.0, -1.0], [0.1, 1.0])
    for limits, inside in (
        ((0.4, 0.6), True),
        ((0.5, 0.6), True),
        ((0.4, 0.5), True),
        ((0.51, 0.6), False),
        ((0.4, 0.49), False),
    ):
        found = within({"cupboard.right": limits, "drawer.slide": (0.0, 0.1)}, {})
        assert (found is not None) == inside
        if inside:
            assert [part.tolist() for part in found] == [[2], [0.0], [0.1]]
    left = {"cupboard.right": 0.0}
    assert within({"cupboard.right": (-0.1, 0.1)}, left) is not None
    assert within({"cupboard.left": (0.2, 0.3)}, left) is not None
    assert within({"cupboard.right": (0.4, 0.6)}, left) is None


def test_only_floor_movers_are_paired_with_the_floor() -> None:
    scene = SimpleNamespace(obstacle_labels=("wall", FLOOR, "box"))
    made = pairing(scene=scene, _obstacles=[None] * 3)
    found = made._pair_with_obstacles(10, [0, 3, 5], [3])
    assert found.tolist() == [
        [0.0, 10.0, 0.02],
        [3.0, 10.0, 0.02],
        [5.0, 10.0, 0.02],
        [3.0, 11.0, 0.02],
        [0.0, 12.0, 0.02],
        [3.0, 12.0, 0.02],
        [5.0, 12.0, 0.02],
    ]
    assert made._pair_with_obstacles(10, [0], []).tolist() == [[0.0, 10.0, 0.02], [0.0, 12.0, 0.02]]
    none = pairing(scene=SimpleNamespace(obstacle_labels=()), _obstacles=[])
    assert none._pair_with_obstacles(10, [0, 1], [0]).shape == (0, 3)


def test_links_of_an_object_that_can_collide() -> None:
    own = {frozenset(("door", "rack"))}
    made = pairing(
        scene=SimpleNamespace(
            objects={"washer": SimpleNamespace(object=SimpleNamespace(own_pairs=own))}
        )
    )
    assert made._can_self_collide("washer", "washer.rack", "washer.door")
    assert not made._can_self_collide("washer", "washer.rack", "washer.case")


def test_bounding_boxes_and_placements() -> None:
    place = pin.SE3(pin.utils.rotate("z", 0.5), np.array([1.0, 2.0, 3.0]))
    shapes = [
        pin.GeometryObject("a", 0, place, coal.Box(0.2, 0.4, 0.6)),
        pin.GeometryObject("b", 0, pin.SE3.Identity(), coal.Sphere(0.1)),
    ]
    center, half, rotation, translation = _compute_boxes(shapes)
    np.testing.assert_allclose(center, np.zeros((2, 3)), atol=1e-12)
    np.testing.assert_allclose(half, [[0.1, 0.2, 0.3], [0.1, 0.1, 0.1]])
    np.testing.assert_array_equal(rotation, [place.rotation, np.eye(3)])
    np.testing.assert_array_equal(translation, [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    assert [part.shape for part in _compute_boxes([])] == [(0, 3), (0, 3), (0, 3, 3), (0, 3)]


def test_contact_statistics() -> None:
    distance, margin = np.array([0.01, 0.03, -0.02, 0.5]), np.array([0.02, 0.02, 0.005, 0.0])
    vectors = np.zeros((4, 3))
    found = Contacts(
        np.array([0, 2, 2, 3]), np.array([[0, 1]] * 4), distance, margin, vectors, vectors, vectors
    )
    assert found.compute_violation() == pytest.approx(0.025)
    assert found.compute_shortfall(5).tolist() == pytest.approx([0.01, 0.0, 0.025, 0.0, 0.0])
    assert found.compute_clearance() == -0.02
    assert found.slot.tolist() == [0, 0, 1, 0]
    free = found.select(np.array([3]))
    assert (free.compute_violation(), free.compute_clearance()) == (0.0, 0.5)
    none = make_empty_contacts()
    assert (
        none.compute_violation(),
        none.compute_clearance(),
        none.compute_shortfall(2).tolist(),
    ) == (
        0.0,
        np.inf,
        [0.0, 0.0],
    )
    assert [array.shape for array in none.arrays()] == [
        (0,),
        (0, 2),
        (0,),
        (0,),
        (0, 3),
        (0, 3),
        (0, 3),
    ]
    assert {array.dtype.kind for array in none.arrays()[:2]} == {"i"}
