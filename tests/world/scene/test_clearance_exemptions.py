"""Tests close pairs of shapes: exemptions, their joint ranges, and warnings."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.carrying import describe_box
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields
from helpers.expected_errors import expect_error
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.world.scene.clearance_exemptions import (
    CONTACT_DEPTH,
    NearStretch,
    PlacedShapes,
    find_clearance_exemptions,
    find_close_pairs,
)

SAFE = 0.02
SHORT = vkc.Options(reach_waypoints=16, move_waypoints=12)
# y of the side of the drawer's front; the shut front extends from x = 1.885 to 1.903
TRAY = 0.295
HINGE = {"hinge": 1.2}


def make_panel_scene(gap: float, begin: float = 1.7) -> vkc.Scene:
    """Return the drawer scene with a panel beside the drawer's front that starts at x = `begin`."""
    depth = 2.3 - begin
    return add_boxes(
        load_drawer_scene(), side=((depth, 0.1, 0.9), (begin + depth / 2, TRAY + gap + 0.05, 0.45))
    )


def make_wall_scene(*depths: float, folder: str | Path = ".", **fields: Any) -> vkc.Scene:
    """Return a room with a door whose leaf overlaps walls at its hinges, at y = 0, by `depths`."""
    document = {
        "name": "tight",
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0]},
        "objects": [{"name": "door", "type": "door", "position": [2.55, 0.0, 0.0]}],
        "obstacles": [
            describe_box(name, [0.08, 1.2, 2.4], [2.55, y, 1.2])
            for name, y in (
                *((f"wall_{k}", 0.6 - depth) for k, depth in enumerate(depths)),
                ("other", -1.56),
            )
        ],
    }
    return vkc.Scene.from_document({**document, **fields}, folder)


@given(gap=st.floats(0.001, 0.018), begin=st.floats(1.4, 1.8))
@settings(max_examples=8, deadline=None)
def test_drawer_is_exempt_from_a_panel_until_it_has_passed(gap: float, begin: float) -> None:
    scene = make_panel_scene(gap, begin)
    (close,) = find_close_pairs(scene, SAFE)
    assert close[:2] == ("drawer.tray", "side")
    assert close.distance == pytest.approx(gap, abs=1e-6)
    (one,) = find_clearance_exemptions(scene, SAFE)
    assert (one.margin, one.distance) == (0.0, close.distance)
    lower, upper = one.ranges["drawer.slide"]
    assert lower == -np.inf
    # Once the back face of the front is past the panel, the distance is √(gap² + travel²).
    clear_at = 1.903 - begin + np.sqrt(SAFE**2 - gap**2)
    assert upper == (
        np.inf
        if clear_at > scene.objects["drawer"].object.upper[0]
        else pytest.approx(clear_at, abs=2e-4)
    )


def test_exemptions_follow_obstacles_and_states() -> None:
    scene = make_panel_scene(0.004)
    (one,) = find_clearance_exemptions(scene, SAFE)
    remaining = [k for k, label in enumerate(scene.obstacle_labels) if label != "side"]
    fields = {
        name: tuple(getattr(scene, name)[k] for k in remaining)
        for name in ("obstacles", "obstacle_labels")
    }
    assert find_clearance_exemptions(dataclasses.replace(scene, **fields), SAFE) == ()
    assert find_clearance_exemptions(scene.with_start(base=[0.0, 0.0, 0.0]), SAFE) == (one,)
    opened = scene.with_state("drawer", {"slide": 0.4})  # the closed state remains exempt
    assert find_close_pairs(opened, SAFE) == []
    (other,) = find_clearance_exemptions(opened, SAFE)
    assert (other.shapes, other.margin, other.ranges) == (one.shapes, one.margin, one.ranges)
    # This box is 0.37 m ahead of the front, which is 0.59 m wide.
    ahead = add_boxes(load_drawer_scene(), ahead=((0.1, 0.5, 0.2), (1.43, 0.0, 0.755)))
    assert find_clearance_exemptions(ahead, SAFE) == ()
    found = find_clearance_exemptions(ahead.with_state("drawer", {"slide": 0.4}), SAFE)
    assert {(one.first, one.second) for one in found} == {("drawer.tray", "ahead")}
    assert all(one.margin in (0.0, pytest.approx(one.distance, abs=2e-4)) for one in found)
    assert len({one.shapes for one in found}) == len(found)  # one for each close shape of the tray


def test_drawers_side_by_side_are_exempt_until_either_has_passed() -> None:
    gap, thickness = 0.015, 0.018  # gap between the fronts, and their thickness
    pair = [
        {"name": name, "type": "drawer", "position": [1.93, y, 0.0]}
        for name, y in (("near", 0.0), ("next", 2 * TRAY + gap))
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
    with pytest.warns(UserWarning, match=r"tight: .* overlap other shapes.*`allow:`") as caught:
        scene = make_wall_scene(*np.arange(0.01, 0.085, 0.01))
    assert [one.filename for one in caught] == [__file__]
    assert len(find_close_pairs(scene, 0.0)) == 8
    text = str(caught[0].message)
    assert text.count("overlap by") == 6
    assert "door.panel – wall_2 overlap by 30.0 mm" in text
    assert "; and 2 more." in text


@pytest.mark.parametrize(
    ("allow", "margin"),
    [
        ([["door.panel", "wall_0"]], -np.inf),
        ([{"pair": ["door", "wall_0"], "margin": 0.004}], 0.004),
        ([{"pair": ["door", "wall_0"], "margin": 0.004}, ["door.panel", "wall_0"]], -np.inf),
        ([{"srdf": "home.srdf"}], -np.inf),
    ],
)
@pytest.mark.filterwarnings("error")
def test_allowed_pairs_raise_no_warning(tmp_path: Path, allow: list[Any], margin: float) -> None:
    (tmp_path / "home.srdf").write_text(
        '<robot name="home"><disable_collisions link1="door.panel" link2="wall_0"/></robot>'
    )
    scene = make_wall_scene(0.004, folder=tmp_path, allow=allow)
    assert scene.allowed[frozenset(("door.panel", "wall_0"))] == margin
    assert find_close_pairs(scene, SAFE) == []
    assert all(isinstance(label, str) for pair in scene.allowed for label in pair)
    again = vkc.Scene.from_document(scene.document, tmp_path)
    assert dict(again.allowed) == dict(scene.allowed)
    assert dict(scene.with_state("door", {"hinge": 0.4}).allowed) == dict(scene.allowed)


@pytest.mark.parametrize(
    ("elements", "pairs"),
    [
        ('<disable_collisions link1="panel" link2="wall_0"/>', {("door.panel", "wall_0")}),
        ('<disable_collisions link1="panel" link2="base_link"/>', {("base_link", "door.panel")}),
    ],
)
def test_srdf_names_links_without_their_object(
    tmp_path: Path, elements: str, pairs: set[tuple[str, str]]
) -> None:
    (tmp_path / "home.srdf").write_text(f"<robot>{elements}</robot>")
    scene = make_wall_scene(0.004, folder=tmp_path, allow=["home.srdf"])
    assert set(scene.allowed) == {frozenset(pair) for pair in pairs}


def test_default_of_an_obstacle_does_not_concern_the_robot(tmp_path: Path) -> None:
    (tmp_path / "home.srdf").write_text(
        '<robot><disable_default_collisions link="wall_0"/>'
        '<enable_collisions link1="wall_0" link2="floor"/></robot>'
    )
    scene = make_wall_scene(0.004, folder=tmp_path, allow=["home.srdf"])
    links = {f"door.{link}" for link in scene.objects["door"].object.links}
    assert set(scene.allowed) == {frozenset(("wall_0", other)) for other in {*links, "other"}}


def test_stale_names_of_an_srdf_are_warned_of(tmp_path: Path) -> None:
    pairs = "".join(
        f'<disable_collisions link1="panel" link2="{name}"/>' for name in ("wall_0", "gone")
    )
    (tmp_path / "home.srdf").write_text(f"<robot>{pairs}</robot>")
    with pytest.warns(UserWarning, match=r"home\.srdf: skipped pairs of links .*: gone"):
        scene = make_wall_scene(0.004, folder=tmp_path, allow=["home.srdf"])
    assert scene.allowed.keys() == {frozenset(("door.panel", "wall_0"))}


@pytest.mark.parametrize(
    ("allow", "field", "message"),
    [
        ([["door.panle", "wall_0"]], "allow[0][0]", "did you mean 'door.panel'"),
        ([{"pair": ["door", "wall"]}], "allow[0].pair[1]", "did you mean 'wall_0'"),
        ([{"margin": 0.1}], "allow[0]", "neither a pair nor an SRDF file"),
        (["nowhere.srdf"], "allow[0]", "there is no such file"),
        ([{"pair": ["door", "other"], "margin": "thin"}], "allow[0].margin", "a number"),
        (["home.srdf"], "disable_collisions", r"home\.srdf:2: .*did you mean 'door'"),
    ],
)
def test_errors_name_invalid_allowed_pairs(
    tmp_path: Path, allow: list[Any], field: str, message: str
) -> None:
    (tmp_path / "home.srdf").write_text(
        '<robot name="home">\n<disable_collisions link1="doro" link2="other"/>\n</robot>'
    )
    with expect_error(message, field=field):
        make_wall_scene(-0.03, folder=tmp_path, allow=allow)


def test_door_opens_and_closes_in_its_wall() -> None:
    """The oracle, which finds close pairs independently, also checks the plan."""
    with pytest.warns(UserWarning, match="overlap by 50"):
        scene = make_wall_scene(0.05)
    (one,) = find_clearance_exemptions(scene, SAFE)
    assert one.is_between("wall_0", "door.panel")
    assert (one.margin, one.ranges) == (-np.inf, {"door.hinge": (-np.inf, np.inf)})
    steps = [vkc.Actuate("door", HINGE), vkc.Actuate("door", {"hinge": 0.0})]
    plan = vkc.plan(scene, steps, options=SHORT)
    assert plan.success, plan.summary()
    assert plan.report.clearance > 0.015  # of pairs that are not exempt


def test_cup_may_leave_but_not_enter_an_overlap() -> None:
    cup = {"name": "cup", "type": "cup", "position": [1.5, 0.0, 0.748]}
    table = describe_box("table", [0.8, 1.2, 0.05], [1.8, 0.0, 0.725])
    with pytest.warns(UserWarning, match=r"cup\.cup – table overlap by 2\.0 mm"):
        scene = make_wall_scene(objects=[cup], obstacles=[table])
    plan = vkc.plan(scene, [vkc.Place("cup", (1.5, 0.4, 0.751))])
    assert plan.success, plan.summary()
    deep = vkc.validate(scene, [vkc.Place("cup", (1.5, 0.4, 0.749))], plan.trajectory)
    assert {violation.constraint for violation in deep.violations} == {"goal"}


def test_allowed_margin_lets_a_leaf_turn_into_its_wall() -> None:
    """A gap of 3 mm is too small for a leaf 40 mm thick that turns about its edge."""
    scene = make_wall_scene(-0.003)
    plan = vkc.plan(scene, [vkc.Actuate("door", HINGE)], options=SHORT)
    assert plan.status == "infeasible"
    (note,) = plan.report.notes
    assert "door.panel – wall_0" in note
    overlap = float(note.rpartition("overlap by ")[2].partition(" mm")[0])
    pair = {"pair": ["door", "wall_0"], "margin": -1e-3 * (overlap + 0.2)}
    enough = replace_scene_fields(scene, allow=[pair])
    assert vkc.plan(enough, [vkc.Actuate("door", HINGE)], options=SHORT).success


def format_box(position: str, size: str) -> str:
    geometry = f'<geometry><box size="{size}"/></geometry>'
    return f'<collision><origin xyz="{position}"/>{geometry}</collision>'


def write_post_scene(folder: Path, *, blocking: str = "") -> vkc.Scene:
    """Return a scene with a leaf 1 mm inside its post, and optionally a block on the same wall."""
    folder.mkdir()
    post = format_box("0.02 0.049 1", "0.1 0.1 2")
    (folder / "wall.urdf").write_text(
        f'<robot name="w"><link name="w">{post}{blocking}</link></robot>', encoding="utf-8"
    )
    leaf = format_box("0.02 -0.4 1", "0.04 0.8 2") + format_box("-0.07 -0.7 1", "0.02 0.02 0.2")
    urdf = (
        f'<robot name="d"><link name="frame"/><link name="leaf">{leaf}</link>'
        '<joint name="hinge" type="revolute"><parent link="frame"/><child link="leaf"/>'
        '<axis xyz="0 0 1"/><limit lower="0" upper="1.5" velocity="1" effort="1"/></joint></robot>'
    )
    grip = {"name": "h", "link": "leaf", "position": [-0.07, -0.7, 1.0]}
    door = {
        "urdf": urdf,
        "attachments": [{**grip, "approach": [1, 0, 0], "closing": [0, 1, 0]}],
    }
    wall = {"name": "wall", "type": "urdf", "file": "wall.urdf", "position": [1.5, 0.4, 0]}
    with pytest.warns(UserWarning, match=r"door\.leaf – wall overlap by 1\.0 mm"):
        return make_wall_scene(
            folder=folder,
            start={"base": [-1.5, 0, 0]},
            arena={"x": [-4, 4], "y": [-4, 4]},
            obstacles=[wall],
            objects=[{"name": "door", "position": [1.5, 0.4, 0], "type": door}],
        )


def test_exemption_applies_to_shapes_not_links(tmp_path: Path) -> None:
    """The leaf may turn in its post, but not through other shapes of the same obstacle."""
    steps = [vkc.Actuate("door", {"hinge": 1.2})]
    opened = vkc.plan(write_post_scene(tmp_path / "free"), steps)
    assert opened.success, opened.summary()
    (used,) = opened.report.exemptions
    assert used.subject == "door.leaf – wall"
    assert -0.045 < used.distance < -0.03  # the corner of the leaf, 40 mm thick, turns in the post
    assert "1.0 mm inside each other" in used.reason
    assert f"exempt {used}" in " ".join(opened.summary().split())

    block = format_box("0.3 -0.25 0.3", "0.2 0.2 0.6")
    blocked = write_post_scene(tmp_path / "blocked", blocking=block)
    (one,) = find_clearance_exemptions(blocked, SAFE)
    assert one.shapes == ("door.leaf_0", "wall_0")
    report = vkc.validate(blocked, steps, opened.trajectory)
    (hit,) = (found for found in report.violations if found.constraint == "penetration")
    assert hit.subject == "door.leaf – wall"
    assert hit.amount == pytest.approx(0.161, abs=0.002)


@pytest.mark.parametrize(("deepest", "is_allowed"), [(0.035, True), (0.06, False)])
def test_leaf_gets_deeper_by_its_own_thickness(
    tmp_path: Path, deepest: float, is_allowed: bool
) -> None:
    """Not by that of its post, which is 100 mm thick."""
    scene = write_post_scene(tmp_path / "scene")
    shapes = PlacedShapes(scene, scene.objects)
    leaf = shapes.labels.index("door.leaf")
    post = shapes.labels.index("wall")
    turning = NearStretch(-np.inf, np.inf, nearest=-deepest, farthest=-0.001, turns=True)
    for pair in ((leaf, post), (post, leaf)):
        depth = shapes.find_allowed_depth(*pair, -0.001, {"hinge": turning})
        assert depth == (np.inf if is_allowed else pytest.approx(0.001 + CONTACT_DEPTH + 0.04))


@pytest.mark.parametrize(
    ("lower", "upper", "farthest", "overlaps"),
    [
        (-np.inf, np.inf, -0.001, True),
        (-np.inf, np.inf, 0.001, False),
        (-1.0, np.inf, -0.001, False),
        (-np.inf, 1.0, -0.001, False),
    ],
)
def test_shapes_overlap_throughout_on_all_of_the_range(
    lower: float, upper: float, farthest: float, overlaps: bool
) -> None:
    stretch = NearStretch(lower, upper, nearest=-0.01, farthest=farthest, turns=True)
    assert stretch.overlaps_throughout is overlaps
