from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.homes.splitting import add_floor, split_home
from vkc_pin.importing.objects.description import Description, Joint, Link, Part


def _make_link(
    name: str, size: tuple[float, float, float] = (0.2, 0.2, 0.2), z: float = 0.5
) -> Link:
    part = Part(
        name=name, placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, z])), kind="box", size=size
    )
    return Link(name, (), (part,))


def _make_joint(
    parent: str, child: str, kind: str, limits: tuple[float, float] | None = (0.0, 1.0)
) -> Joint:
    placement = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.0]))
    return Joint(
        name=f"to_{child}",
        kind=kind,
        parent=parent,
        child=child,
        placement=placement,
        limits=limits if kind != "fixed" else None,
    )


def _make_description(links: list[Link], joints: list[Joint]) -> Description:
    return Description(
        Path("home.urdf"),
        {link.name: link for link in links},
        {joint.child: joint for joint in joints},
    )


def test_each_movable_part_of_the_building_is_an_object() -> None:
    links = [
        Link("world"),
        _make_link("walls", (8.0, 0.1, 2.5)),
        _make_link("left"),
        _make_link("right"),
        _make_link("knob"),
        _make_link("cabinet"),
        _make_link("leaf"),
    ]
    joints = [
        _make_joint("world", "walls", "fixed"),
        _make_joint("walls", "left", "revolute"),
        _make_joint("walls", "right", "prismatic"),
        _make_joint("right", "knob", "revolute"),
        _make_joint("world", "cabinet", "fixed"),
        _make_joint("cabinet", "leaf", "revolute"),
    ]
    home = split_home(_make_description(links, joints))
    assert [link.name for link in home.building] == ["walls"]
    assert not home.furniture
    found = {item.name: set(item.description.links) for item in home.objects}
    assert found == {
        "left": {"left", "left_base"},
        "right": {"right", "right_base", "knob"},
        "cabinet": {"cabinet", "leaf"},
    }


def test_immovable_joints_are_fixed() -> None:
    links = [_make_link("room"), _make_link("stuck"), Link("dead"), _make_link("leaf")]
    joints = [
        _make_joint("room", "stuck", "prismatic", (0.4, 0.4)),
        _make_joint("room", "dead", "revolute"),
        _make_joint("room", "leaf", "revolute"),
    ]
    home = split_home(_make_description(links, joints))
    assert [item.name for item in home.objects] == ["leaf"]
    assert [link.name for link in home.furniture] == ["stuck"]
    assert home.furniture[0].collision[0].placement.translation == pytest.approx([0.7, 0.0, 0.5])
    assert any("to_stuck" in note and "single value" in note for note in home.notes)
    assert any("to_dead" in note and "moves no shape" in note for note in home.notes)


def test_free_object_is_rigid_and_separate() -> None:
    links = [
        Link("world"),
        _make_link("case"),
        _make_link("drawer"),
        _make_link("laptop"),
        _make_link("lid"),
        Link("ghost"),
    ]
    joints = [
        _make_joint("world", "case", "fixed"),
        _make_joint("case", "drawer", "prismatic", (0.1, 0.5)),
        _make_joint("drawer", "laptop", "floating", None),
        _make_joint("laptop", "lid", "revolute"),
        _make_joint("world", "ghost", "floating", None),
    ]
    home = split_home(_make_description(links, joints))
    case, laptop = home.objects
    assert set(case.description.links) == {"case", "drawer"}
    assert case.position[2] == 0.0  # the floor, below its shapes
    assert laptop.free
    assert laptop.position == pytest.approx(
        (1.15, 0.0, 0.4)
    )  # with the drawer at its lower limit, as in the scene
    assert [joint.kind for joint in laptop.description.joints.values()] == ["fixed"]
    assert any("'to_lid'" in note for note in home.notes)


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_every_shape_of_a_tree_is_assigned_once(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    links = [_make_link("link_0", z=data.draw(st.sampled_from([0.5, -0.1])))]
    joints = []
    for number in range(1, count):
        name, parent = f"link_{number}", f"link_{data.draw(st.integers(0, number - 1))}"
        size = data.draw(st.sampled_from([(0.2, 0.2, 0.2), (5.0, 0.1, 2.0)]))
        links.append(data.draw(st.sampled_from([_make_link(name, size), Link(name)])))
        kind = data.draw(
            st.sampled_from(["fixed", "revolute", "prismatic", "continuous", "floating"])
        )
        limits = (
            data.draw(st.sampled_from([None, (0.0, 1.0), (0.2, 0.2), (0.1, 0.4)]))
            if kind in ("revolute", "prismatic")
            else None
        )
        joints.append(_make_joint(parent, name, kind, limits))
    home = split_home(_make_description(links, joints))
    assigned = [
        part.name for link in (*home.building, *home.furniture) for part in link.solid
    ] + list(home.floor)
    assigned += [
        part.name
        for item in home.objects
        for link in item.description.links.values()
        for part in link.solid
    ]
    assert sorted(assigned) == sorted(part.name for link in links for part in link.solid)
    assert home.shapes == len(assigned)
    names = [item.name for item in home.objects]
    assert len(set(names)) == len(names)


NORTH, SOUTH, EAST, WEST = (
    ((6.0, 0.1, 2.4), (0.0, 1.95, 1.2)),
    ((6.0, 0.1, 2.4), (0.0, -1.95, 1.2)),
    ((0.1, 4.0, 2.4), (2.95, 0.0, 1.2)),
    ((0.1, 4.0, 2.4), (-2.95, 0.0, 1.2)),
)
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
    walls: list[tuple[tuple[float, float, float], tuple[float, float, float]]], open_sides: str
) -> None:
    parts = tuple(
        Part(name="", placement=pin.SE3(np.eye(3), np.array(at)), kind="box", size=size)
        for size, at in walls
    )
    joint = _make_joint("rooms", "lid", "revolute")
    home = split_home(_make_description([Link("rooms", (), parts), _make_link("lid")], [joint]))
    low, high = add_floor(home, np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4]))
    beyond = {side: 2.0 * (side in open_sides) for side in "nswe"}
    assert low == pytest.approx([-3.0 - beyond["w"], -2.0 - beyond["s"], 0.0])
    assert high == pytest.approx([3.0 + beyond["e"], 2.0 + beyond["n"], 2.4])


def test_floor_surrounds_a_home_without_building() -> None:
    home = split_home(
        _make_description(
            [Link("w"), _make_link("a"), _make_link("b")],
            [_make_joint("w", "a", "fixed"), _make_joint("a", "b", "revolute")],
        )
    )
    low, high = add_floor(home, np.zeros(3), np.ones(3))
    assert (low.tolist(), high.tolist()) == ([-2.0, -2.0, 0.0], [3.0, 3.0, 1.0])
