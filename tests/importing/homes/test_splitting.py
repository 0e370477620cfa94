from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.importing.homes.splitting import add_floor, split_home
from vkc_pin.importing.objects.description import Description, Joint, Link, Part


def _box(name: str, size: tuple[float, float, float] = (0.2, 0.2, 0.2), z: float = 0.5) -> Link:
    part = Part(
        name=name, placement=pin.SE3(np.eye(3), np.array([0.0, 0.0, z])), kind="box", size=size
    )
    return Link(name, (), (part,))


def _hung(
    parent: str, child: str, kind: str, limits: tuple[float, float] | None = (0.0, 1.0)
) -> Joint:
    up = pin.SE3(np.eye(3), np.array([0.3, 0.0, 0.0]))
    return Joint(
        name=f"to_{child}",
        kind=kind,
        parent=parent,
        child=child,
        placement=up,
        limits=limits if kind != "fixed" else None,
    )


def _home(links: list[Link], joints: list[Joint]) -> Description:
    return Description(
        Path("home.urdf"),
        {link.name: link for link in links},
        {joint.child: joint for joint in joints},
    )


def test_each_joint_of_the_building_is_an_object() -> None:
    links = [
        Link("world"),
        _box("walls", (8.0, 0.1, 2.5)),
        _box("left"),
        _box("right"),
        _box("knob"),
        _box("cabinet"),
        _box("leaf"),
    ]
    joints = [
        _hung("world", "walls", "fixed"),
        _hung("walls", "left", "revolute"),
        _hung("walls", "right", "prismatic"),
        _hung("right", "knob", "revolute"),
        _hung("world", "cabinet", "fixed"),
        _hung("cabinet", "leaf", "revolute"),
    ]
    home = split_home(_home(links, joints))
    assert [link.name for link in home.building] == ["walls"]
    assert not home.furniture
    found = {thing.name: set(thing.description.links) for thing in home.objects}
    assert found == {
        "left": {"left", "left_base"},
        "right": {"right", "right_base", "knob"},
        "cabinet": {"cabinet", "leaf"},
    }


def test_immovable_joints_are_fixed() -> None:
    links = [_box("room"), _box("stuck"), Link("dead"), _box("leaf")]
    joints = [
        _hung("room", "stuck", "prismatic", (0.4, 0.4)),
        _hung("room", "dead", "revolute"),
        _hung("room", "leaf", "revolute"),
    ]
    home = split_home(_home(links, joints))
    assert [thing.name for thing in home.objects] == ["leaf"]
    assert [link.name for link in home.furniture] == ["stuck"]
    assert home.furniture[0].collision[0].placement.translation == pytest.approx([0.7, 0.0, 0.5])
    assert any("to_stuck" in note and "single value" in note for note in home.notes)
    assert any("to_dead" in note and "moves no shape" in note for note in home.notes)


def test_free_object_is_rigid_and_separate() -> None:
    links = [
        Link("world"),
        _box("case"),
        _box("drawer"),
        _box("laptop"),
        _box("lid"),
        Link("ghost"),
    ]
    joints = [
        _hung("world", "case", "fixed"),
        _hung("case", "drawer", "prismatic", (0.1, 0.5)),
        _hung("drawer", "laptop", "floating", None),
        _hung("laptop", "lid", "revolute"),
        _hung("world", "ghost", "floating", None),
    ]
    home = split_home(_home(links, joints))
    case, laptop = home.objects
    assert set(case.description.links) == {"case", "drawer"}
    assert case.position[2] == 0.0  # on the floor, above which it hangs
    assert laptop.free
    assert laptop.position == pytest.approx(
        (1.15, 0.0, 0.4)
    )  # with the drawer at its lower limit: as the scene has it
    assert [joint.kind for joint in laptop.description.joints.values()] == ["fixed"]
    assert any("'to_lid'" in note for note in home.notes)


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_no_shape_is_lost_whatever_the_tree(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    links = [_box("link_0", z=data.draw(st.sampled_from([0.5, -0.1])))]
    joints = []
    for number in range(1, count):
        name, parent = f"link_{number}", f"link_{data.draw(st.integers(0, number - 1))}"
        size = data.draw(st.sampled_from([(0.2, 0.2, 0.2), (5.0, 0.1, 2.0)]))
        links.append(data.draw(st.sampled_from([_box(name, size), Link(name)])))
        kind = data.draw(
            st.sampled_from(["fixed", "revolute", "prismatic", "continuous", "floating"])
        )
        limits = (
            data.draw(st.sampled_from([None, (0.0, 1.0), (0.2, 0.2), (0.1, 0.4)]))
            if kind in ("revolute", "prismatic")
            else None
        )
        joints.append(_hung(parent, name, kind, limits))
    home = split_home(_home(links, joints))
    kept = [part.name for link in (*home.building, *home.furniture) for part in link.solid] + list(
        home.floor
    )
    kept += [
        part.name
        for thing in home.objects
        for link in thing.description.links.values()
        for part in link.solid
    ]
    assert sorted(kept) == sorted(part.name for link in links for part in link.solid)
    assert home.shapes == len(kept)
    names = [thing.name for thing in home.objects]
    assert len(set(names)) == len(names)


NORTH, SOUTH, EAST, WEST = (
    ((6.0, 0.1, 2.4), (0.0, 1.95, 1.2)),
    ((6.0, 0.1, 2.4), (0.0, -1.95, 1.2)),
    ((0.1, 4.0, 2.4), (2.95, 0.0, 1.2)),
    ((0.1, 4.0, 2.4), (-2.95, 0.0, 1.2)),
)
BAR = ((6.0, 4.0, 0.1), (0.0, 0.0, 2.35))  # a ceiling, no wall


@pytest.mark.parametrize(
    ("walls", "open_sides"),
    [
        ([NORTH, SOUTH, EAST, WEST], ""),
        ([NORTH, SOUTH, EAST, BAR], "w"),
        ([NORTH, BAR], "swe"),
        ([BAR], "nswe"),
        # a door of 1 m, and one that leaves less than half of a wall
        ([NORTH, SOUTH, EAST, ((0.1, 3.0, 2.4), (-2.95, 0.5, 1.2))], ""),
        ([NORTH, SOUTH, EAST, ((0.1, 1.5, 2.4), (-2.95, 1.0, 1.2))], "w"),
        # two halves that overlap, and a wall in the middle of the room
        ([NORTH, SOUTH, WEST, *[((0.1, 1.5, 2.4), (2.95, y, 1.2)) for y in (-1.2, 0.2)]], ""),
        ([NORTH, SOUTH, WEST, BAR, ((0.1, 4.0, 2.4), (1.0, 0.0, 1.2))], "e"),
        # a threshold, a lintel, and a wall with a large window
        ([NORTH, SOUTH, WEST, BAR, ((0.1, 4.0, 0.2), (2.95, 0.0, 0.1))], "e"),
        ([NORTH, SOUTH, WEST, BAR, ((0.1, 4.0, 0.9), (2.95, 0.0, 0.45))], ""),
    ],
)
def test_floor_lies_beyond_sides_without_walls(
    walls: list[tuple[tuple[float, float, float], tuple[float, float, float]]], open_sides: str
) -> None:
    parts = tuple(
        Part(name="", placement=pin.SE3(np.eye(3), np.array(at)), kind="box", size=size)
        for size, at in walls
    )
    joint = _hung("rooms", "lid", "revolute")
    home = split_home(_home([Link("rooms", (), parts), _box("lid")], [joint]))
    low, high = add_floor(home, np.array([-3.0, -2.0, 0.0]), np.array([3.0, 2.0, 2.4]))
    beyond = {side: 2.0 * (side in open_sides) for side in "nswe"}
    assert low == pytest.approx([-3.0 - beyond["w"], -2.0 - beyond["s"], 0.0])
    assert high == pytest.approx([3.0 + beyond["e"], 2.0 + beyond["n"], 2.4])


def test_floor_lies_around_a_home_without_building() -> None:
    home = split_home(
        _home(
            [Link("w"), _box("a"), _box("b")],
            [_hung("w", "a", "fixed"), _hung("a", "b", "revolute")],
        )
    )
    low, high = add_floor(home, np.zeros(3), np.ones(3))
    assert (low.tolist(), high.tolist()) == ([-2.0, -2.0, 0.0], [3.0, 3.0, 1.0])
