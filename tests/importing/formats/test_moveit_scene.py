"""Tests texts of planning scenes of MoveIt, written here as its sources write them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.importing.description import Description
from vkc_pin.importing.formats.reading import read_description

TURN = "0 0 0.7071067811865476 0.7071067811865476"  # by 90 degrees about z
NO_COLOUR = "0 0 0 0"


def read(folder: Path, text: str) -> Description:
    (folder / "a.scene").write_text(text)
    return read_description(folder / "a.scene")


def place(description: Description, name: str, number: int = 0) -> pin.SE3:
    """Return the placement of a shape in the world."""
    placement = description.compute_placements()[name]
    return placement * description.links[name].collision[number].placement


def test_shapes_are_in_the_frame_of_their_object(tmp_path: Path) -> None:
    text = (
        f"room\n* box 0\n1 0 0.5\n{TURN}\n1\nbox\n0.2 0.4 0.6\n0.3 0 0\n0 0 0 1\n"
        f"{NO_COLOUR}\n1\ngrip 0 0 0.1 0 0 0 1\n.\nanything"
    )
    found = read(tmp_path, text)
    (part,) = found.links["box 0"].collision
    assert (part.kind, part.size, part.colour) == ("box", (0.2, 0.4, 0.6), None)
    placement = place(found, "box 0")
    np.testing.assert_allclose(placement.translation, [1.0, 0.3, 0.5], atol=1e-12)
    np.testing.assert_allclose(placement.rotation, pin.utils.rotate("z", np.pi / 2), atol=1e-12)
    assert found.notes == ("left out the subframes of box 0: grip",)
    assert found.format == "MoveIt .scene"


def test_older_files_have_neither_poses_nor_subframes(tmp_path: Path) -> None:
    shape = f"0.3 0 0\n0 0 0 1\n{NO_COLOUR}\n"
    text = f"room\n* a\n1\nbox\n0.2 0.4 0.6\n{shape}* b\n1\nsphere\n0.5\n{shape}.\n"
    found = read(tmp_path, text)
    np.testing.assert_allclose(place(found, "a").translation, [0.3, 0.0, 0.0])
    assert found.links["b"].collision[0].size == (0.5,)
    with expect_error(r"a\.scene:9: the next object: unknown marker .*got 0"):
        read(tmp_path, f"room\n* a\n1\nbox\n0.2 0.4 0.6\n{shape}0\n.\n")


def test_all_shapes_are_read(tmp_path: Path) -> None:
    pose = "0 0 1 0 0 0 1"
    shapes = [
        f"cylinder 0.2 1.0 {pose} 1 0 0 1",
        f"cone 0.3 0.8 {pose} {NO_COLOUR}",
        f"mesh 4 4  0 0 0  1 0 0  0 1 0  0 0 1  0 2 1  0 1 3  1 2 3  0 3 2 {pose} 0 0.5 0 1",
    ]
    text = f"\n* a\n0 0 0 0 0 0 1\n3 {' '.join(shapes)} 0\n.\n"
    found = read(tmp_path, text)
    cylinder, cone, mesh = found.links["a"].collision
    assert (cylinder.kind, cylinder.size) == ("cylinder", (0.2, 1.0))
    low, high = cone.make_mesh().bounds
    np.testing.assert_allclose([low, high], [[-0.3, -0.3, 0.6], [0.3, 0.3, 1.4]], atol=1e-9)
    tip = cone.make_mesh().vertices[:, 2].argmax()
    np.testing.assert_allclose(cone.make_mesh().vertices[tip], [0.0, 0.0, 1.4], atol=1e-9)
    assert mesh.make_mesh().volume == pytest.approx(1.0 / 6.0)
    # The last shape's colour is that of the object.
    assert {part.colour for part in found.links["a"].collision} == {(0.0, 0.5, 0.0, 1.0)}


def test_floor_is_the_only_plane(tmp_path: Path) -> None:
    def format_plane(numbers: str, pose: str) -> str:
        return f"s\n* ground\n0 0 0.5 0 0 0 1\n1\nplane\n{numbers}\n{pose}\n{NO_COLOUR}\n0\n.\n"

    found = read(tmp_path, format_plane("0 0 2 1", "0 0 0 0 0 0 1"))
    assert list(found.links) == ["world"]
    assert found.notes == ("ground, shape 1 is the plane z = 0: the floor of the scene",)
    for numbers in ("0 0 2 0", "1 0 0 0", "0 0 0 0"):
        with expect_error("ground, shape 1: a plane is no obstacle of a scene .*got plane"):
            read(tmp_path, format_plane(numbers, "0 0 0 0 0 0 1"))


finite = st.floats(-5.0, 5.0).map(lambda value: round(value, 4))
sizes = st.floats(0.01, 3.0).map(lambda value: round(value, 4))
angles = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
poses = st.tuples(st.tuples(finite, finite, finite), angles)


def format_pose(pose: Any) -> str:
    position, rpy = pose
    rotation = pin.Quaternion(pin.rpy.rpyToMatrix(*rpy)).coeffs()
    return " ".join(repr(float(value)) for value in (*position, *rotation))


@settings(max_examples=40, deadline=None)
@given(
    is_new=st.booleans(),
    objects=st.lists(
        st.tuples(poses, st.lists(st.tuples(sizes, sizes, sizes, poses), max_size=3)),
        min_size=1,
        max_size=3,
    ),
)
def test_placements_of_any_objects(
    tmp_path_factory: pytest.TempPathFactory, is_new: bool, objects: list[Any]
) -> None:
    text = "any\n"
    for number, (pose, shapes) in enumerate(objects):
        text += f"* object {number}\n" + (f"{format_pose(pose)}\n" if is_new else "")
        text += f"{len(shapes)}\n"
        for x, y, z, own in shapes:
            text += f"box\n{x} {y} {z}\n{format_pose(own)}\n0 0 0 0\n"
        text += "0\n" if is_new else ""
    found = read(tmp_path_factory.mktemp("scene"), text + ".\n")
    for number, (pose, shapes) in enumerate(objects):
        name = f"object {number}"
        if not shapes:
            assert name not in found.links
        for k, (x, y, z, own) in enumerate(shapes):
            assert found.links[name].collision[k].size == (x, y, z)
            expected = np.eye(4)
            for position, rpy in (pose, own) if is_new else (own,):
                step = np.eye(4)
                step[:3, :3] = pin.rpy.rpyToMatrix(*rpy)
                step[:3, 3] = position
                expected = expected @ step
            np.testing.assert_allclose(place(found, name, k).homogeneous, expected, atol=1e-9)


BOX = f"s\n* a\n0 0 0 0 0 0 1\n1\nbox\n1 1 1\n0 0 0 0 0 0 1\n{NO_COLOUR}\n0\n.\n"


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("box\n1 1 1", "bax\n1 1 1", r":5: a, shape 1: there is no type of shape 'bax'; did you"),
        ("box\n1 1 1", "box\n1 0 1", ":6: a, shape 1: not a size"),
        ("box\n1 1 1", "box\n1 one 1", ":6: a, shape 1: not a number .*got one"),
        ("box\n1 1 1", "box\n1 nan 1", ":6: a, shape 1: out of range .*got nan"),
        ("0 0 0 0 0 0 1\n1", "0 0 0 0 0 0 2\n1", ":3: a: not a rotation"),
        ("\n1\n", "\n-1\n", ":4: a: not a count .*got -1"),
        ("\n.\n", "\n", ":10: the next object: the text ends early"),
        ("* a", "*a", r":2: the next object: unknown marker .*got \*a"),
        ("\n.\n", "\n* a\n", ":10: a: not a new name"),
        ("box\n1 1 1", "mesh\n3 1\n0 0 0 1 0 0 0 1 0\n0 1 3", "a, shape 1: not a mesh"),
        ("box\n1 1 1", "mesh\n999999999 1\n0 0 0", "a, shape 1: the text ends early"),
    ],
)
def test_wrong_texts_are_named(tmp_path: Path, before: str, after: str, message: str) -> None:
    assert BOX.count(before) >= 1
    with expect_error(rf"a\.scene{message}|a\.scene:\d+: {message}"):
        read(tmp_path, BOX.replace(before, after, 1))


def test_planning_scenes_become_scenes(tmp_path: Path) -> None:
    tetrahedron = "mesh 4 4  0 0 0  1 0 0  0 1 0  0 0 1  0 2 1  0 1 3  1 2 3  0 3 2"
    text = (
        "room\n"
        f"* table 1\n2 0 0.4\n{TURN}\n1\nbox\n0.8 0.6 0.8\n0.1 0 0\n0 0 0 1\n0.5 0.4 0.3 1\n0\n"
        f"* post\n-1 2 0.5\n0 0 0 1\n1\ncylinder\n0.1 1.0\n0 0 0\n0 0 0 1\n{NO_COLOUR}\n0\n"
        f"* rock\n-2 -2 0\n0 0 0 1\n1\n{tetrahedron}\n0 0 0\n0 0 0 1\n{NO_COLOUR}\n0\n.\n"
    )
    (tmp_path / "room.scene").write_text(text)
    made = vkc.importing.import_home(tmp_path / "room.scene", tmp_path / "room")
    scene = vkc.load_scene(made.file)
    assert scene.obstacle_names == ("table_1", "post", "rock")
    table, post, rock, _ = scene.obstacles
    np.testing.assert_allclose(table.placement.translation, [2.0, 0.1, 0.4], atol=1e-6)
    np.testing.assert_allclose(2.0 * table.geometry.halfSide, [0.8, 0.6, 0.8])
    assert (post.geometry.radius, 2.0 * post.geometry.halfLength) == (0.1, 1.0)
    points = np.array(rock.geometry.points())
    low = (points @ rock.placement.rotation.T + rock.placement.translation).min(axis=0)
    np.testing.assert_allclose(low, [-2.0, -2.0, 0.0], atol=1e-5)
    assert math.isclose(table.meshColor[0], 0.5)
