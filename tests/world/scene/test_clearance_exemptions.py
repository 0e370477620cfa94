"""Tests close pairs of shapes: exemptions, their joint ranges, and warnings."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.clearance_exemptions import (
    ClearanceExemption,
    find_clearance_exemptions,
    find_close_pairs,
)
from vkc_pin.world.scene.scene import Scene

SAFE = 0.02
# y of the side of the drawer's front; the shut front extends from x = 1.885 to 1.903
TRAY = 0.295
HINGE = {"hinge": 1.2}


def make_panel_scene(gap: float, begin: float = 1.7) -> Scene:
    """Return the drawer scene with a panel beside the drawer's front that starts at x = `begin`."""
    depth = 2.3 - begin
    return add_boxes(
        load_drawer_scene(), side=((depth, 0.1, 0.9), (begin + depth / 2, TRAY + gap + 0.05, 0.45))
    )


def make_wall_scene(depth: float = 0.05, **fields: Any) -> Scene:
    """Return a room with a door whose leaf overlaps the wall at its hinges, at y = 0."""
    walls = [
        {
            "name": "wall",
            "type": "box",
            "size": [0.08, 1.2, 2.4],
            "position": [2.55, 0.6 - depth, 1.2],
        },
        {"name": "other", "type": "box", "size": [0.08, 1.2, 2.4], "position": [2.55, -1.56, 1.2]},
    ]
    document = {
        "name": "tight",
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0]},
        "objects": [{"name": "door", "type": "door", "position": [2.55, 0.0, 0.0]}],
        "obstacles": walls,
    }
    return Scene.from_document({**document, **fields})


@given(gap=st.floats(0.001, 0.018), begin=st.floats(1.4, 1.8))
@settings(max_examples=8, deadline=None)
def test_drawer_is_exempt_from_a_panel_until_it_has_passed(gap: float, begin: float) -> None:
    (close,) = find_close_pairs(make_panel_scene(gap, begin), SAFE)
    assert close[:2] == ("drawer.tray", "side")
    assert close.distance == pytest.approx(gap, abs=1e-6)
    (one,) = find_clearance_exemptions(make_panel_scene(gap, begin), SAFE)
    assert (one.margin, one.distance) == (0.0, close.distance)
    lower, upper = one.ranges["drawer.slide"]
    assert lower == -np.inf
    # Once the back face of the front is past the panel, the distance is √(gap² + travel²).
    clear_at = 1.903 - begin + np.sqrt(SAFE**2 - gap**2)
    assert upper == (
        np.inf
        if clear_at > load_drawer_scene().objects["drawer"].object.upper[0]
        else pytest.approx(clear_at, abs=2e-4)
    )


def test_cache_depends_on_obstacles_and_states() -> None:
    scene = make_panel_scene(0.004, 1.4)
    (one,) = find_clearance_exemptions(scene, SAFE)
    remaining = [k for k, label in enumerate(scene.obstacle_labels) if label != "side"]
    fields = {
        name: tuple(getattr(scene, name)[k] for k in remaining)
        for name in ("obstacles", "obstacle_labels")
    }
    assert find_clearance_exemptions(dataclasses.replace(scene, **fields), SAFE) == ()
    assert find_clearance_exemptions(scene.with_start(base=[0.0, 0.0, 0.0]), SAFE) == (one,)
    ahead = add_boxes(
        load_drawer_scene(), ahead=((0.1, 0.5, 0.2), (1.43, 0.0, 0.755))
    )  # 0.37 m ahead of the front, which is 0.59 m wide
    assert find_clearance_exemptions(ahead, SAFE) == ()
    found = find_clearance_exemptions(ahead.with_state("drawer", {"slide": 0.4}), SAFE)
    assert {(one.first, one.second) for one in found} == {("drawer.tray", "ahead")}
    assert -np.inf in {one.margin for one in found}
    assert len({one.shapes for one in found}) == len(found)  # one for each close shape of the tray


def test_drawers_side_by_side_are_exempt_until_either_has_passed() -> None:
    gap, thickness = 0.015, 0.018  # gap between the fronts, and their thickness
    drawer = {"type": "drawer", "position": [1.93, 0.0, 0.0]}
    at = [[1.93, y, 0.0] for y in (0.0, 2 * TRAY + gap)]
    pair = [
        {**drawer, "name": name, "position": place}
        for name, place in zip(("near", "next"), at, strict=True)
    ]
    scene = replace_scene_fields(load_drawer_scene(), objects=pair, obstacles=[])
    (one,) = find_clearance_exemptions(scene, SAFE)
    assert one.is_between("near.tray", "next.tray")
    # The ranges follow the state of either drawer.
    for name, other in (("near", "next"), ("next", "near")):
        found = find_clearance_exemptions(scene.with_state(name, {"slide": 0.01}), SAFE)
        upper = one.ranges[f"{other}.slide"][1]
        assert sorted(each.ranges[f"{other}.slide"][1] for each in found) == pytest.approx(
            [upper, upper + 0.01], abs=4e-4
        )
    clear_at = thickness + np.sqrt(SAFE**2 - gap**2)
    assert {name: ends[1] for name, ends in one.ranges.items()} == {
        f"{name}.slide": pytest.approx(clear_at, abs=2e-4) for name in ("near", "next")
    }
    out = np.array([[0.0, 0.0], [0.02, 0.03], [0.05, 0.0], [0.0, 0.05]])
    assert one.is_active(["near.slide", "next.slide"], out).tolist() == [True, True, False, False]


def test_warning_names_the_six_deepest_overlaps() -> None:
    walls = [
        {"name": f"wall_{k}", "type": "box", "size": [0.08, 1.2, 2.4], "position": [2.55, y, 1.2]}
        for k, y in enumerate(0.6 - 0.01 * np.arange(1, 9))
    ]
    with pytest.warns(UserWarning, match="overlap other shapes") as caught:
        scene = make_wall_scene(obstacles=walls)
    text = str(caught[0].message)
    close = find_close_pairs(scene, 0.0)
    assert len(close) == len(walls)
    assert text.count("overlap by") == 6
    assert "wall_2 overlap" in text
    assert "wall_1 overlap" not in text
    assert "; and 2 more." in text


def test_warning_names_overlapping_links() -> None:
    with pytest.warns(
        UserWarning, match=r"tight: .*door\.panel – wall overlap by 50\.0 mm.*`allow:`"
    ) as caught:
        scene = make_wall_scene()
    assert [one.filename for one in caught] == [__file__]
    (one,) = find_clearance_exemptions(scene, SAFE)
    assert one.is_between("wall", "door.panel")
    assert (one.margin, one.ranges) == (-np.inf, {"door.hinge": (-np.inf, np.inf)})


def test_exemptions_at_zero_joint_positions_apply_in_any_state() -> None:
    (one,) = find_clearance_exemptions(make_panel_scene(0.004), SAFE)
    opened = make_panel_scene(0.004).with_state("drawer", {"slide": 0.4})
    assert find_close_pairs(opened, SAFE) == []
    (other,) = find_clearance_exemptions(opened, SAFE)
    assert (other.shapes, other.margin, other.ranges) == (one.shapes, one.margin, one.ranges)


def test_exemption_is_active_where_every_joint_is_in_range() -> None:
    one = ClearanceExemption("a.b", "c", 0.0, 0.01, {"a.x": (0.0, 1.0), "a.y": (-np.inf, 0.5)})
    states = np.array([[9.0, 0.5, 0.0], [9.0, 1.5, 0.0], [9.0, 1.0, 0.6], [9.0, 0.0, -7.0]])
    assert one.is_active(["q", "a.x", "a.y"], states).tolist() == [True, False, False, True]
    assert ClearanceExemption("a", "b", 0.0, 0.0).is_active([], np.zeros((2, 0))).all()


@pytest.mark.parametrize(
    ("allow", "margin"),
    [
        ([["door.panel", "wall"]], -np.inf),
        ([{"pair": ["door", "wall"], "margin": 0.004}], 0.004),
        ([{"pair": ["door", "wall"], "margin": 0.004}, ["door.panel", "wall"]], -np.inf),
        ([{"srdf": "home.srdf"}], -np.inf),
    ],
)
def test_allowed_pairs_of_a_scene(tmp_path: Path, allow: list[Any], margin: float) -> None:
    (tmp_path / "home.srdf").write_text(
        '<robot name="home"><disable_collisions link1="door.panel" link2="wall"/></robot>'
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # allowed overlaps raise no warning
        scene = Scene.from_document({**make_wall_scene(-0.004).document, "allow": allow}, tmp_path)
    assert scene.allowed[frozenset(("door.panel", "wall"))] == margin
    assert find_close_pairs(scene, SAFE) == []
    assert all(isinstance(label, str) for pair in scene.allowed for label in pair)
    again = Scene.from_document(scene.document, tmp_path)
    assert dict(again.allowed) == dict(scene.allowed)
    assert dict(scene.with_state("door", {"hinge": 0.4}).allowed) == dict(scene.allowed)


@pytest.mark.parametrize(
    ("allow", "field", "message"),
    [
        ([["door.panle", "wall"]], "allow[0][0]", "did you mean 'door.panel'"),
        ([{"pair": ["door", "wal"]}], "allow[0].pair[1]", "did you mean 'wall'"),
        ([{"margin": 0.1}], "allow[0]", "neither a pair nor an SRDF file"),
        (["nowhere.srdf"], "allow[0]", "there is no such file"),
        ([{"pair": ["door", "wall"], "margin": "thin"}], "allow[0].margin", "a number"),
    ],
)
def test_errors_name_invalid_allowed_pairs(allow: list[Any], field: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        Scene.from_document({**make_wall_scene(-0.03).document, "allow": allow})
    assert caught.value.field == field
    assert message in str(caught.value)


def test_missing_file_error_suggests_the_nearest_file(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    for name in ("door.yaml", "door.yml", "oven.yaml"):
        (tmp_path / "mine" / name).touch()
    door = {"name": "door", "type": "mine/dor.yaml", "position": [2.0, 0.0, 0.0]}
    for missing, message in (
        ("mine/dor.yaml", ", perhaps mine/door.yaml, got"),
        ("none/dor.yaml", rf"a file in {tmp_path}, got"),
    ):
        with pytest.raises(InputError, match=message):
            Scene.from_document(
                {
                    **make_wall_scene(-0.03).document,
                    "objects": [{**door, "type": missing}],
                    "allow": [],
                },
                tmp_path,
            )


def test_unknown_links_in_srdf_are_located(tmp_path: Path) -> None:
    (tmp_path / "home.srdf").write_text(
        '<robot name="home">\n<disable_collisions link1="doro" link2="wall"/>\n</robot>'
    )
    with pytest.raises(UnknownNameError, match=r"home\.srdf:2: .*did you mean 'door'"):
        Scene.from_document({**make_wall_scene(-0.03).document, "allow": ["home.srdf"]}, tmp_path)


def test_door_opens_and_closes_in_its_wall() -> None:
    """The oracle, which finds close pairs independently, also checks the plan."""
    with pytest.warns(UserWarning, match="overlap by 50"):
        scene = make_wall_scene()
    plan = vkc.plan(scene, [vkc.Actuate("door", HINGE), vkc.Actuate("door", {"hinge": 0.0})])
    assert plan.success, plan.summary()
    assert plan.report.clearance > 0.015  # of pairs that are not exempt


def test_cup_may_leave_but_not_enter_an_overlap() -> None:
    cup, table = {"name": "cup", "type": "cup", "position": [1.5, 0.0, 0.748]}, [0.8, 1.2, 0.05]
    document = {"robot": "husky_ur5e", "start": {"base": [0.0, 0.0, 0.0]}, "objects": [cup]}
    tables = [{"name": "table", "type": "box", "size": table, "position": [1.8, 0.0, 0.725]}]
    with pytest.warns(UserWarning, match=r"cup\.cup – table overlap by 2\.0 mm"):
        scene = Scene.from_document({**document, "obstacles": tables})
    plan = vkc.plan(scene, [vkc.Place("cup", (1.5, 0.4, 0.751))])
    assert plan.success, plan.summary()
    deep = validate(scene, [vkc.Place("cup", (1.5, 0.4, 0.749))], plan.trajectory)
    assert {violation.constraint for violation in deep.violations} == {"goal"}


def test_allowed_margin_lets_a_leaf_turn_into_its_wall() -> None:
    """A gap of 3 mm is too small for a leaf 40 mm thick that turns about its edge."""
    scene = make_wall_scene(-0.003)
    plan = vkc.plan(scene, [vkc.Actuate("door", HINGE)])
    assert plan.status == "infeasible"
    (note,) = plan.report.notes
    assert "door.panel – wall" in note
    overlap = float(note.rpartition("overlap by ")[2].partition(" mm")[0])
    pair = {"pair": ["door", "wall"], "margin": -1e-3 * (overlap + 0.2)}
    enough = Scene.from_document({**scene.document, "allow": [pair]})
    assert vkc.plan(enough, [vkc.Actuate("door", HINGE)]).success


LEAF = (
    '<robot name="d"><link name="frame"/><link name="leaf">{leaf}'
    '<collision><origin xyz="-0.07 -0.7 1"/><geometry><box size="0.02 0.02 0.2"/></geometry>'
    '</collision></link><joint name="hinge" type="revolute"><parent link="frame"/>'
    '<child link="leaf"/><axis xyz="0 0 1"/>'
    '<limit lower="0" upper="1.5" velocity="1" effort="1"/></joint></robot>'
)


def format_box(position: str, size: str) -> str:
    geometry = f'<geometry><box size="{size}"/></geometry>'
    return f'<collision><origin xyz="{position}"/>{geometry}</collision>'


def write_post_scene(folder: Path, *, block: bool) -> Scene:
    """Return a scene with a leaf 1 mm inside its post, and optionally a block on the same wall."""
    post, blocking = (
        format_box("0.02 0.049 1", "0.1 0.1 2"),
        format_box("0.3 -0.25 0.3", "0.2 0.2 0.6"),
    )
    wall = f'<robot name="w"><link name="w">{post}{blocking if block else ""}</link></robot>'
    (folder / "wall.urdf").write_text(wall, encoding="utf-8")
    attachment = {
        "name": "h",
        "link": "leaf",
        "position": [-0.07, -0.7, 1.0],
        "approach": [1, 0, 0],
        "closing": [0, 1, 0],
    }
    door = {
        "urdf": LEAF.format(leaf=format_box("0.02 -0.4 1", "0.04 0.8 2")),
        "attachments": [attachment],
    }
    document = {
        "name": "hinged",
        "robot": "husky_ur5e",
        "start": {"base": [-1.5, 0, 0]},
        "arena": {"x": [-4, 4], "y": [-4, 4]},
        "obstacles": [
            {"name": "wall", "type": "urdf", "file": "wall.urdf", "position": [1.5, 0.4, 0]}
        ],
        "objects": [{"name": "door", "position": [1.5, 0.4, 0], "type": door}],
    }
    with pytest.warns(UserWarning, match=r"door\.leaf – wall overlap by 1\.0 mm"):
        return Scene.from_document(document, folder)


def test_exemption_applies_to_shapes_not_links(tmp_path: Path) -> None:
    """The leaf may turn in its post, but not through other shapes of the same obstacle."""
    for name in ("free", "blocked"):
        (tmp_path / name).mkdir()
    steps = [vkc.Actuate("door", {"hinge": 1.2})]
    free = write_post_scene(tmp_path / "free", block=False)
    opened = vkc.plan(free, steps)
    assert opened.success, opened.summary()
    (used,) = opened.report.exemptions
    assert used.subject == "door.leaf – wall"
    assert -0.045 < used.distance < -0.03  # the corner of the leaf, 40 mm thick, turns in the post
    assert "1.0 mm inside each other" in used.reason
    assert f"exempt      {used}" in opened.summary()

    blocked = write_post_scene(tmp_path / "blocked", block=True)
    (one,) = find_clearance_exemptions(blocked, SAFE)
    assert one.shapes == ("door.leaf_0", "wall_0")
    report = validate(blocked, steps, opened.trajectory)
    (hit,) = (found for found in report.violations if found.constraint == "penetration")
    assert hit.subject == "door.leaf – wall"
    assert hit.amount == pytest.approx(0.161, abs=0.002)
