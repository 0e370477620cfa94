from __future__ import annotations

import dataclasses
import inspect
import itertools
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.furniture import BAR, flap
from helpers.grippers import cheeky_drawer, write_gripper

import vkc_pin as vkc
from vkc_pin.importing.proposals.fitting import HandClearance
from vkc_pin.importing.proposals.hand import make_hand

POSTS = "".join(
    f'<collision><origin xyz="-0.045 0.5 {z}"/><geometry><box size="0.07 0.09 0.014"/></geometry></collision>'
    for z in (-0.13, 0.13)
)
HAND_WRITTEN = [
    ("drawer", "slide", "handle"),
    ("low_drawer", "slide", "handle"),
    ("counter_drawer", "slide", "handle"),
    ("cabinet", "hinge", "handle"),
    ("refrigerator", "hinge", "handle"),
    ("dishwasher", "door", "door_handle"),
    ("door", "knob", "handle"),
    ("narrow_door", "hinge", "handle"),
]


@pytest.mark.parametrize(("name", "joint", "handle"), HAND_WRITTEN)
def test_the_best_proposal_is_the_bar_that_somebody_chose(
    name: str, joint: str, handle: str
) -> None:
    """On the same bar: beside the hand-written grasp by no more than the hand can slide, along the bar, closing across it."""
    item = vkc.load_object(name)
    best, wanted = (
        vkc.importing.propose_attachments(item).opening(joint)[0],
        item.attachment(handle),
    )
    assert best.attachment.link == wanted.link
    apart = best.attachment.placement.inverse() * wanted.placement
    slide = next(freedom for freedom in best.attachment.freedoms if freedom.kind == "prismatic")
    assert np.linalg.norm(apart.translation[[0, 2]]) < 0.005
    assert slide.lower - 0.02 <= apart.translation[1] <= slide.upper + 0.02
    assert abs(apart.rotation[1, 1]) == pytest.approx(1.0)
    low, high = item.lower[item.coordinates.index(joint)], item.upper[item.coordinates.index(joint)]
    assert best.opens[joint] == pytest.approx(high if abs(high) >= abs(low) else low)


def test_every_proposal_has_the_clearance_that_plans_must_keep() -> None:
    for name in ("drawer", "cabinet", "door", "dishwasher"):
        item = vkc.load_object(name)
        found = vkc.importing.propose_attachments(item)
        fitting = HandClearance(item, found.hand, 0.02, 0.005)
        for proposal in found.found:
            state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
            for joint, value in proposal.when.items():
                state[item.coordinates.index(joint)] = value
            fitting.place(state)
            grip = proposal.attachment
            tool = item.link_placement(grip.link, state) * grip.tool(np.zeros(len(grip.freedoms)))
            assert fitting.find_obstruction(tool, grip.link) is None, (name, grip.name)


def test_a_door_in_the_way_is_opened_first() -> None:
    found = vkc.importing.propose_attachments(vkc.load_object("dishwasher"))
    assert found.because == {}
    assert dict(found.opening("rack")[0].when) == {"door": pytest.approx(np.pi / 2.0)}
    assert "while door is at 1.57" in found.summary()


def test_without_a_handle_it_is_the_free_edge_far_from_the_hinge(tmp_path: Path) -> None:
    best = vkc.importing.propose_attachments(flap(tmp_path, behind=0.1)).found[0]
    assert best.kind == "edge"
    assert best.thickness == pytest.approx(0.02)
    assert best.attachment.placement.translation[1] > 0.5


def test_a_name_decides_between_equals(tmp_path: Path) -> None:
    other = BAR.replace("-0.08 0.5 0", "-0.08 0.4 0").format(' name="handle"')
    first = vkc.importing.propose_attachments(flap(tmp_path, BAR.format(""))).found[0]
    assert not first.named
    assert first.attachment.placement.translation[1] == pytest.approx(0.5)
    named = vkc.importing.propose_attachments(flap(tmp_path, BAR.format("") + other)).found[0]
    assert named.named
    assert named.attachment.placement.translation[1] == pytest.approx(0.4)


def test_what_is_too_thick_has_no_attachment_and_says_so(tmp_path: Path) -> None:
    found = vkc.importing.propose_attachments(flap(tmp_path, thick=0.12))
    assert found.found == ()
    assert "nothing of it fits between the fingers, 86 mm apart" in found.because["hinge"]
    assert "120 mm at its thinnest" in found.because["hinge"]
    assert found.because["hinge"] in found.summary()
    assert dict(found.applied().attachments) == {}


def test_a_bar_without_room_behind_it_is_given_up(tmp_path: Path) -> None:
    flush = BAR.replace("-0.08", "-0.03").format(' name="handle"')
    found = vkc.importing.propose_attachments(flap(tmp_path, flush, thick=0.09))
    assert "are not 5 mm from flap" in found.because["hinge"]


def test_a_bar_close_to_the_flap_is_taken_with_the_finger_tips(tmp_path: Path) -> None:
    close = BAR.replace("-0.08", "-0.03").format(' name="handle"')
    best = vkc.importing.propose_attachments(flap(tmp_path, close)).found[0]
    assert best.kind == "bar"
    assert best.attachment.standoff > 0.0
    tight = vkc.importing.propose_attachments(flap(tmp_path, close), grasp_clearance=0.02)
    assert all(proposal.kind != "bar" for proposal in tight.found)


def knob(z: float, turned: float = 0.0) -> str:
    """Return a square knob, 30 mm wide, on the flap at some height, turned about its own axis."""
    shape = '<geometry><box size="0.05 0.03 0.03"/></geometry>'
    return f'<collision><origin xyz="-0.055 0.5 {z}" rpy="{turned} 0 0"/>{shape}</collision>'


def test_two_knobs_come_before_one_with_the_hand_turned(tmp_path: Path) -> None:
    """Turned, the hand has the better one nearly as well as before; but what keeps it from there does so in both cases."""
    alone, two = (
        vkc.importing.propose_attachments(flap(tmp_path, text), most=2).found
        for text in (knob(0.0), knob(0.0) + knob(0.25))
    )
    (first, turned), (same, other) = alone, two
    assert turned.score > 0.9 * first.score
    assert (same.score, other.score < turned.score) == (pytest.approx(first.score), True)
    heights = [
        proposal.attachment.placement.translation[2] for proposal in (first, turned, same, other)
    ]
    np.testing.assert_allclose(heights, [0.0, 0.0, 0.0, 0.25], atol=1e-6)


def test_a_hand_that_is_turned_a_little_is_not_proposed_again(tmp_path: Path) -> None:
    """Of two pieces one in the other, turned by 45°, each has its own faces."""
    found = vkc.importing.propose_attachments(
        flap(tmp_path, knob(0.0) + knob(0.0, np.pi / 4)), most=8
    ).found
    places = [proposal.attachment.placement for proposal in found if proposal.kind == "knob"]
    assert len(places) >= 2
    for one, other in itertools.combinations(places, 2):
        same = (
            one.rotation[:, 2] @ other.rotation[:, 2] > 0.5
            and np.linalg.norm(one.translation - other.translation) < 0.03
        )
        assert not same or abs(one.rotation[:, 1] @ other.rotation[:, 1]) < 0.5


def test_posts_end_the_slide(tmp_path: Path) -> None:
    free, held = (
        vkc.importing.propose_attachments(flap(tmp_path, BAR.format("") + posts)).found[0]
        for posts in ("", POSTS)
    )
    lengths = [
        best.attachment.freedoms[0].upper - best.attachment.freedoms[0].lower
        for best in (free, held)
    ]
    assert lengths[1] < lengths[0] - 0.02


def test_the_same_object_gives_the_same_proposals() -> None:
    one, other = (vkc.importing.propose_attachments(vkc.load_object("cabinet")) for _ in range(2))
    assert [p.description() for p in one.found] == [p.description() for p in other.found]


def test_clearances_are_those_that_plans_keep_by_default() -> None:
    defaults = inspect.signature(vkc.importing.propose_attachments).parameters
    for name in ("dist_safe", "grasp_clearance"):
        assert defaults[name].default == getattr(vkc.Options(), name)


def test_wrong_arguments() -> None:
    with pytest.raises(vkc.InputError, match="ArticulatedObject"):
        vkc.importing.propose_attachments("drawer")  # type: ignore[arg-type]
    with pytest.raises(vkc.UnknownNameError, match="husky_ur5e"):
        vkc.importing.propose_attachments(vkc.load_object("drawer"), "husky_ur5")
    with pytest.raises(vkc.InputError, match="dist_safe"):
        vkc.importing.propose_attachments(vkc.load_object("drawer"), dist_safe=-0.1)
    with pytest.raises(vkc.InputError, match="most"):
        vkc.importing.propose_attachments(vkc.load_object("drawer"), most=0)


@pytest.mark.parametrize("name", ["drawer", "cabinet"])
def test_the_best_proposal_opens_it(name: str, tmp_path: Path) -> None:
    """Alone on the floor; the oracle judges the motion."""
    item = vkc.load_object(name)
    found = vkc.importing.propose_attachments(item)
    file, joint = tmp_path / f"{name}.yaml", item.coordinates.names[0]
    file.write_text(
        yaml.safe_dump(
            {"urdf": str(item.urdf), "attachments": [p.description() for p in found.found]}
        )
    )
    scene = {
        "name": "alone",
        "robot": {"name": "husky_ur5e", "base": "omni"},
        "start": {"base": [-1.6, 0.3, 0.0], "arm": "home"},
        "arena": {"x": [-4, 4], "y": [-4, 4]},
        "floor": True,
        "objects": [{"name": "it", "type": str(file), "position": [0, 0, 0]}],
    }
    (tmp_path / "alone.yaml").write_text(yaml.safe_dump(scene))
    plan = vkc.plan(vkc.load_scene(tmp_path / "alone.yaml"), [vkc.Actuate("it", {joint: 0.3})])
    assert plan.success, plan.summary()
    assert plan.trajectory.column(f"it.{joint}")[-1] == pytest.approx(0.3, abs=1e-3)


def test_fingers_come_closer_together_where_they_have_no_room_fully_open(tmp_path: Path) -> None:
    """Posts of the drawer's frame stand 60 mm from the middle of its handle, on both sides."""
    item, robot = vkc.load_object(cheeky_drawer()), vkc.load_robot(write_gripper(tmp_path))
    found = vkc.importing.propose_attachments(item, robot)
    best = found.opening("slide")[0]
    assert best.thickness == pytest.approx(0.02)
    assert best.attachment.opening == pytest.approx(0.03)  # 5 mm on both sides
    assert best.description()["opening"] == 0.03
    assert "20 mm thick, fingers 30 mm apart" in found.summary()
    fitting = HandClearance(item, make_hand(robot.opened(best.attachment.opening)), 0.02, 0.005)
    tool = item.link_placement("front", [0.0]) * best.attachment.tool(
        np.zeros(len(best.attachment.freedoms))
    )
    assert fitting.find_obstruction(tool, "front") is None
    assert HandClearance(item, found.hand, 0.02, 0.005).find_obstruction(tool, "front") is not None
    still = dataclasses.replace(robot, gripper=None)
    assert best.kind not in {
        one.kind for one in vkc.importing.propose_attachments(item, still).found
    }


def test_fingers_that_have_room_stay_fully_open(tmp_path: Path) -> None:
    item, robot = vkc.load_object(cheeky_drawer(gap=0.15)), vkc.load_robot(write_gripper(tmp_path))
    assert [one.attachment.opening for one in vkc.importing.propose_attachments(item, robot).found][
        :1
    ] == [None]
