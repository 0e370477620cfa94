from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.descriptions import make_description, make_joint, make_mesh_part, make_part
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.description import Joint, Link
from vkc_pin.importing.homes.splitting import Home, add_floor, split_home


def make_link(name: str, size: tuple[float, ...] = (0.2, 0.2, 0.2), z: float = 0.5) -> Link:
    return Link(name, (), (make_part("box", size, (0.0, 0.0, z), name),))


def connect(
    parent: str, child: str, kind: str = "revolute", limits: tuple[float, float] | None = (0.0, 1.0)
) -> Joint:
    return make_joint(parent, child, kind, (0.3, 0.0, 0.0), limits)


def split(links: list[Link], *joints: Joint) -> Home:
    return split_home(make_description(links, joints))


def test_each_movable_part_of_the_building_is_an_object() -> None:
    home = split(
        [
            Link("world"),
            make_link("walls", (8.0, 0.1, 2.5)),
            *map(make_link, ("left", "right", "knob", "cabinet", "leaf")),
        ],
        connect("world", "walls", "fixed"),
        connect("walls", "left"),
        connect("walls", "right", "prismatic"),
        connect("right", "knob"),
        connect("world", "cabinet", "fixed"),
        connect("cabinet", "leaf"),
    )
    assert [link.name for link in home.building] == ["walls"]
    assert not home.furniture
    found = {item.name: set(item.description.links) for item in home.objects}
    assert found == {
        "left": {"left", "left_base"},
        "right": {"right", "right_base", "knob"},
        "cabinet": {"cabinet", "leaf"},
    }


def test_immovable_joints_are_fixed() -> None:
    home = split(
        [make_link("room"), make_link("stuck"), Link("dead"), make_link("leaf")],
        connect("room", "stuck", "prismatic", (0.4, 0.4)),
        connect("room", "dead"),
        connect("room", "leaf"),
    )
    assert [item.name for item in home.objects] == ["leaf"]
    assert [link.name for link in home.furniture] == ["stuck"]
    assert home.furniture[0].collision[0].placement.translation == pytest.approx([0.7, 0.0, 0.5])
    assert any("to_stuck" in note and "single value" in note for note in home.notes)
    assert any("to_dead" in note and "moves no shape" in note for note in home.notes)


def test_free_object_is_rigid_and_separate() -> None:
    """It is placed with the drawer at its lower limit, as in the scene."""
    home = split(
        [
            Link("world"),
            *map(make_link, ("case", "drawer", "laptop", "lid")),
            Link("ghost"),
        ],
        connect("world", "case", "fixed"),
        connect("case", "drawer", "prismatic", (0.1, 0.5)),
        connect("drawer", "laptop", "floating", None),
        connect("laptop", "lid"),
        connect("world", "ghost", "floating", None),
    )
    case, laptop = home.objects
    assert set(case.description.links) == {"case", "drawer"}
    assert case.position[2] == 0.0  # the floor, below its shapes
    assert laptop.free
    assert laptop.position == pytest.approx((1.15, 0.0, 0.4))
    assert [joint.kind for joint in laptop.description.joints.values()] == ["fixed"]
    assert any("'to_lid'" in note for note in home.notes)


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_every_shape_of_a_tree_is_assigned_once(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    links = [make_link("link_0", z=data.draw(st.sampled_from([0.5, -0.1])))]
    joints = []
    for number in range(1, count):
        name, parent = f"link_{number}", f"link_{data.draw(st.integers(0, number - 1))}"
        size = data.draw(st.sampled_from([(0.2, 0.2, 0.2), (5.0, 0.1, 2.0)]))
        links.append(data.draw(st.sampled_from([make_link(name, size), Link(name)])))
        kinds = ["fixed", "revolute", "prismatic", "continuous", "floating"]
        kind = data.draw(st.sampled_from(kinds))
        limits = None
        if kind in ("revolute", "prismatic"):
            limits = data.draw(st.sampled_from([None, (0.0, 1.0), (0.2, 0.2), (0.1, 0.4)]))
        joints.append(connect(parent, name, kind, limits))
    home = split(links, *joints)
    own = [link for item in home.objects for link in item.description.links.values()]
    assigned = [
        *(part.name for link in (*home.building, *home.furniture, *own) for part in link.solid),
        *home.floor,
    ]
    assert sorted(assigned) == sorted(part.name for link in links for part in link.solid)
    assert home.shapes == len(assigned)
    names = [item.name for item in home.objects]
    assert len(set(names)) == len(names)


NORTH = ((6.0, 0.1, 2.4), (0.0, 1.95, 1.2))
SOUTH = ((6.0, 0.1, 2.4), (0.0, -1.95, 1.2))
EAST = ((0.1, 4.0, 2.4), (2.95, 0.0, 1.2))
WEST = ((0.1, 4.0, 2.4), (-2.95, 0.0, 1.2))
CEILING = ((6.0, 4.0, 0.1), (0.0, 0.0, 2.35))  # no wall


@pytest.mark.parametrize(
    ("walls", "open_sides"),
    [
        ([NORTH, SOUTH, EAST, WEST], ""),
        ([NORTH, SOUTH, EAST, CEILING], "w"),
        ([NORTH, CEILING], "swe"),
        ([CEILING], "nswe"),
        # a doorway of 1 m, and one that takes more than half of a wall
        ([NORTH, SOUTH, EAST, ((0.1, 3.0, 2.4), (-2.95, 0.5, 1.2))], ""),
        ([NORTH, SOUTH, EAST, ((0.1, 1.5, 2.4), (-2.95, 1.0, 1.2))], "w"),
        # two halves that overlap, and a wall in the middle of the room
        ([NORTH, SOUTH, WEST, *[((0.1, 1.5, 2.4), (2.95, y, 1.2)) for y in (-1.2, 0.2)]], ""),
        ([NORTH, SOUTH, WEST, CEILING, ((0.1, 4.0, 2.4), (1.0, 0.0, 1.2))], "e"),
        # a threshold, a lintel, and a wall with a large window
        ([NORTH, SOUTH, WEST, CEILING, ((0.1, 4.0, 0.2), (2.95, 0.0, 0.1))], "e"),
        ([NORTH, SOUTH, WEST, CEILING, ((0.1, 4.0, 0.9), (2.95, 0.0, 0.45))], ""),
    ],
)
def test_floor_extends_beyond_sides_without_walls(
    walls: list[tuple[tuple[float, ...], tuple[float, ...]]], open_sides: str
) -> None:
    parts = tuple(make_part("box", size, at) for size, at in walls)
    home = split([Link("rooms", (), parts), make_link("lid")], connect("rooms", "lid"))
    low, high = add_floor(home, np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4]))
    beyond = {side: 2.0 * (side in open_sides) for side in "nswe"}
    assert low == pytest.approx([-3.0 - beyond["w"], -2.0 - beyond["s"], 0.0])
    assert high == pytest.approx([3.0 + beyond["e"], 2.0 + beyond["n"], 2.4])


def test_floor_surrounds_a_home_without_building() -> None:
    home = split(
        [Link("w"), make_link("a"), make_link("b")], connect("w", "a", "fixed"), connect("a", "b")
    )
    low, high = add_floor(home, np.zeros(3), np.ones(3))
    assert (low.tolist(), high.tolist()) == ([-2.0, -2.0, 0.0], [3.0, 3.0, 1.0])


@pytest.mark.parametrize(
    ("boxes", "open_sides"),
    [
        ([((0.8, 0.6, 0.7), (2.0, 0.0, 0.35))], "nswe"),  # a table
        ([((0.3, 0.3, 2.0), (0.0, 0.0, 1.0))], "nswe"),  # a column
        ([((4.0, 0.1, 2.4), (0.0, 0.0, 1.2))], "nswe"),  # a wall without a room
        ([((4.0, 3.0, 0.9), (0.0, 0.0, 0.45))], "nswe"),  # a platform
        # a row of shelves along the whole home, and a wall opposite to it
        ([((6.0, 0.8, 2.0), (0.0, 0.4, 1.0)), ((6.0, 0.1, 2.0), (0.0, 3.0, 1.0))], "swe"),
    ],
)
def test_solids_are_no_walls(
    boxes: list[tuple[tuple[float, ...], tuple[float, ...]]], open_sides: str
) -> None:
    """Floor lies around what fills the home from side to side."""
    parts = tuple(make_part("box", size, at) for size, at in boxes)
    corners = np.vstack([part.make_mesh().bounds for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    home = split([Link("rooms", (), parts), make_link("lid")], connect("rooms", "lid"))
    wider_low, wider_high = add_floor(home, low, high)
    beyond = {side: 2.0 * (side in open_sides) for side in "nswe"}
    assert low - wider_low == pytest.approx([beyond["w"], beyond["s"], 0.0])
    assert wider_high - high == pytest.approx([beyond["e"], beyond["n"], 0.0])


def test_walls_without_thickness_are_walls() -> None:
    """Rooms of other programs are drawn from the inside, the outside or both."""
    corners = np.array([[x, y, z] for z in (0.0, 2.4) for x in (-3.0, 3.0) for y in (-2.0, 2.0)])
    for faces in ([[0, 2, 6], [0, 6, 4]], [[0, 6, 2], [0, 4, 6]]):  # the south alone
        part = make_mesh_part(trimesh.Trimesh(corners, faces, process=False))
        home = split([Link("rooms", (), (part,)), make_link("lid")], connect("rooms", "lid"))
        low, high = add_floor(home, np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4]))
        assert low == pytest.approx([-5.0, -2.0, 0.0])
        assert high == pytest.approx([5.0, 4.0, 2.4])
