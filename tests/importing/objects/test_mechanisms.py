"""Compares imported objects with equalities with what MuJoCo simulates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import vkc_pin as vkc
from vkc_pin.importing.objects.object_reading import read_object

mujoco = pytest.importorskip("mujoco")

CABINET = """<mujoco model="cabinet"><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>
<body name="case"><geom type="box" size=".2 .25 .4" pos=".3 0 .4" mass="20"/>
<body name="l" pos=".08 -.25 .4"><joint name="left" axis="0 0 1" range="-1.5 1.5" damping="1"/>
<geom name="l" type="box" size=".01 .12 .4" pos="0 .125 0" mass="3" contype="0" conaffinity="0"/>
<geom type="box" size=".01 .01 .1" pos="-.06 .2 0" mass=".1"/><site name="l" pos="0 .25 0"/></body>
<body name="r" pos=".08 .25 .4"><joint name="right" axis="0 0 1" range="-1.5 1.5" damping="1"/>
<geom name="r" type="box" size=".01 .12 .4" pos="0 -.125 0" mass="3" contype="0" conaffinity="0"/>
<geom type="box" size=".01 .01 .1" pos="-.06 -.2 0" mass=".1"/>
<site name="r" pos="0 -.25 0"/></body>
</body>{bodies}</worldbody><equality>{equalities}</equality></mujoco>"""
KNOB = (
    '<body name="knob" pos="0 0 .9"><freejoint/><geom type="box" size=".2 .2 .2" mass="5"'
    ' contype="0" conaffinity="0"/></body>'
)
LID = (
    '<body name="lid" pos="0 0 .9"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/>'
    '<body name="flap"><joint name="flap" axis="0 0 1" range="-1 1"/><geom size=".02" mass=".1"/>'
    "</body></body>"
)

# Name → further bodies, equalities, joints that stay, words of the notes
CASES = {
    "none": ("", "", {"left", "right"}, ()),
    "held": ("", '<joint joint1="right" polycoef="-0.4 0 0 0 0"/>', {"left"}, ("held at -0.4",)),
    "held by a polynomial without slope": (
        "",
        '<joint joint1="right" joint2="left" polycoef="-0.4 0 0 0 0"/>',
        {"left"},
        ("held at -0.4",),
    ),
    "follower of a held joint": (
        "",
        '<joint joint1="right" joint2="left" polycoef="0.1 -1 0.5 0 0"/>'
        '<joint joint1="left" polycoef="0.6 0 0 0 0"/>',
        set(),
        ("'left' is held at 0.6", "'right' is held at -0.32"),
    ),
    "coupled": (
        "",
        '<joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/>',
        {"left", "right"},
        ("'right' follows 'left'", "made independent"),
    ),
    "connected": (
        "",
        '<connect body1="l" body2="r" anchor="0 .25 0"/>',
        set(),
        ("'l' and 'r' are connected", "joint 'left', joint 'right'"),
    ),
    "connected at sites": (
        "",
        '<connect site1="l" site2="r"/>',
        set(),
        ("'l' and 'r' are connected",),
    ),
    "welded": ("", '<weld body1="l" body2="r"/>', set(), ("'l' and 'r' are welded",)),
    "welded to the case": ("", '<weld body1="r" body2="case"/>', {"left"}, ("joint 'right'",)),
    "welded to the world": ("", '<weld body1="r"/>', {"left"}, ("'r' and 'world' are welded",)),
    "inactive": ("", '<weld body1="l" body2="r" active="false"/>', {"left", "right"}, ()),
    "free body welded to a leaf": (
        KNOB,
        '<weld body1="knob" body2="r"/>',
        {"left", "right"},
        ("free body 'knob'",),
    ),
    "free bodies welded to each other": (
        KNOB + LID,
        '<weld body1="lid" body2="knob"/><weld body1="knob" body2="lid"/><weld body1="r"/>',
        {"left"},
        ("'lid' and 'knob' are welded",),
    ),
    "leaves welded by a free body": (
        KNOB,
        '<weld body1="knob" body2="r"/><weld body1="l" body2="knob"/>',
        set(),
        ("'knob' and 'r' are welded", "'l' and 'knob' are welded", "joint 'left', joint 'right'"),
    ),
}


def simulate(text: str) -> tuple[object, object]:
    """Return model and data 4 s after a torque began to turn both leaves."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    for name, torque in (("left", 0.3), ("right", 0.2)):
        data.qfrc_applied[model.jnt_dofadr[model.joint(name).id]] = torque
    for _ in range(2000):
        mujoco.mj_step(model, data)
    return model, data


@pytest.mark.parametrize(("bodies", "equalities", "joints", "words"), CASES.values(), ids=CASES)
def test_joints_that_mujoco_holds_are_fixed_where_it_holds_them(
    bodies: str, equalities: str, joints: set[str], words: tuple[str, ...], tmp_path: Path
) -> None:
    text = CABINET.format(bodies=bodies, equalities=equalities)
    (tmp_path / "c.xml").write_text(text)
    found = read_object(tmp_path / "c.xml")
    moving = {joint.name for joint in found.joints.values() if joint.kind == "revolute"}
    assert moving == joints
    model, data = simulate(text)
    values = {name: float(data.qpos[model.jnt_qposadr[model.joint(name).id]]) for name in joints}
    # Joints that stay follow MuJoCo's positions; all links are where MuJoCo has them.
    for link, place in found.compute_placements(values).items():
        body = model.body(link).id
        assert place.translation == pytest.approx(data.xpos[body], abs=0.02), link
        assert np.allclose(place.rotation, data.xmat[body].reshape(3, 3), atol=0.05), link
    notes = " ".join(found.notes)
    for word in words:
        assert word in notes
    assert ("<equality>" in notes) == bool(words)


def test_free_bodies_in_a_home_are_attached_or_stay_free(tmp_path: Path) -> None:
    text = CABINET.format(bodies=KNOB + LID, equalities='<weld body1="knob" body2="r"/>')
    (tmp_path / "c.xml").write_text(text)
    joints = read_object(tmp_path / "c.xml", free=True).joints
    assert (joints["knob"].kind, joints["knob"].parent) == ("fixed", "r")
    assert (joints["lid"].kind, joints["lid"].parent) == ("floating", "world")
    assert "knob" in read_object(tmp_path / "c.xml").links
    assert "lid" not in read_object(tmp_path / "c.xml").links


def test_joints_between_a_free_body_and_its_weld_are_held(tmp_path: Path) -> None:
    """The lid could still swing about its flap, which is on the leaf."""
    text = CABINET.format(bodies=LID, equalities='<weld body1="flap" body2="r"/>')
    (tmp_path / "c.xml").write_text(text)
    found = read_object(tmp_path / "c.xml")
    assert {name: found.joints[name].kind for name in ("lid", "flap", "r")} == {
        "lid": "fixed",
        "flap": "fixed",
        "r": "revolute",
    }
    assert any("free body 'lid', joint 'flap'" in note for note in found.notes)


def test_equalities_of_tendons_are_noted(tmp_path: Path) -> None:
    tendons = "".join(
        f'<fixed name="{name}"><joint joint="{name}" coef="1"/></fixed>'
        for name in ("left", "right")
    )
    equality = '<tendon name="pair" tendon1="left" tendon2="right"/>'
    text = CABINET.format(bodies="", equalities=equality)
    (tmp_path / "c.xml").write_text(
        text.replace("</mujoco>", f"<tendon>{tendons}</tendon></mujoco>")
    )
    assert any("'pair' of tendons" in note for note in read_object(tmp_path / "c.xml").notes)


def test_held_leaf_of_an_imported_cabinet_stands_open(tmp_path: Path) -> None:
    """The other leaf is its only joint."""
    equality = '<joint joint1="right" polycoef="-0.4 0 0 0 0"/>'
    (tmp_path / "c.xml").write_text(CABINET.format(bodies="", equalities=equality))
    done = vkc.importing.import_object(tmp_path / "c.xml", tmp_path / "out")
    assert done.object.coordinates.names == ("left",)
    assert any("'right' is held at -0.4" in note for note in done.notes)


FORWARD = 'range="0 1.5"'


@pytest.mark.parametrize(
    ("left", "right", "coefficients", "expected"),
    [
        (FORWARD, FORWARD, "0 -1 0 0 0", (-1.5, 0.0)),  # a range copied from the leader
        (FORWARD, 'range="-1 0"', "0 -1 0 0 0", (-1.0, 0.0)),
        (FORWARD, 'range="-9 9" ref="0.5"', "0.5 2 0 0 0", (0.5, 3.5)),
        ('range="0.2 1.7" ref="0.2"', 'limited="false"', "0 -0.5 0 0 0", (-0.75, 0.0)),
        ('limited="false"', FORWARD, "0 -1 0 0 0", (0.0, 1.5)),
        (FORWARD, FORWARD, "0 1 0.5 0 0", (0.0, 1.5)),  # no straight line
    ],
)
def test_followers_keep_the_limits_that_their_leaders_reach(
    tmp_path: Path, left: str, right: str, coefficients: str, expected: tuple[float, float]
) -> None:
    """A third joint follows the second one; a circle ends at its first joint."""
    couplings = '<joint joint1="third" joint2="right" polycoef="0 -1 0 0 0"/>'
    couplings += f'<joint joint1="right" joint2="left" polycoef="{coefficients}"/>'
    couplings += '<joint joint1="one" joint2="other" polycoef="0 -1 0 0 0"/>'
    couplings += '<joint joint1="other" joint2="one" polycoef="0 -1 0 0 0"/>'
    settings = {"left": left, "right": right, "third": 'range="-9 9"', "one": FORWARD}
    settings["other"] = FORWARD
    bodies = "".join(
        f'<body><joint name="{name}" {text}/><geom size="0.1"/></body>'
        for name, text in settings.items()
    )
    (tmp_path / "t.xml").write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody>'
        f"<equality>{couplings}</equality></mujoco>"
    )
    found = {joint.name: joint.limits for joint in read_object(tmp_path / "t.xml").joints.values()}
    assert found["right"] == pytest.approx(expected)
    assert found["third"] == pytest.approx((-expected[1], -expected[0]))
    assert found["one"] == (-1.5, 0.0)
    assert found["other"] == (0.0, 1.5)
