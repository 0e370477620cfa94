from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.importing.robots.mjcf import convert_mjcf
from vkc_pin.world.files.kinematic_tree import check_tree
from vkc_pin.world.models.robot_model import make_configuration

ARM = """
<mujoco model="arm"><compiler angle="degree"/>
  <asset><mesh name="wedge" vertex="0 0 0  0.2 0 0  0 0.1 0  0 0 0.3"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="table" pos="1 0 0"><geom type="box" size="0.1 0.1 0.1"/></body>
    <body name="foot" pos="0.1 0.2 0.3" euler="0 0 30">
      <geom type="cylinder" size="0.1 0.05"/>
      <body name="upper" pos="0 0 0.1" euler="20 0 0">
        <joint name="pan" axis="0 0 1" range="-90 90"/>
        <joint name="lift" axis="0 1 0" pos="0.05 0 0.02" ref="10" range="-45 80"/>
        <geom type="capsule" size="0.03 0.2" pos="0 0 0.2"/>
        <body name="fore" pos="0 0 0.4" quat="0.9 0.1 0.2 0.3">
          <joint name="out" type="slide" axis="1 0.5 0" range="0 0.3" actuatorfrcrange="-40 40"/>
          <joint name="twist" axis="1 0 0" pos="0 0.03 0"/>
          <geom type="mesh" mesh="wedge"/>
          <geom type="ellipsoid" size="0.02 0.03 0.04" contype="0" conaffinity="0" rgba="1 0 0 1"/>
          <body name="tip" pos="0.2 0 0"><joint name="jaw" type="slide" range="0 0.05"/>
            <geom type="sphere" size="0.02"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="jaw" joint2="out" polycoef="0.01 0.1 0 0 0"/></equality>
  <keyframe><key name="home" qpos="0.1 0.4 0.05 0.2 0.01"/></keyframe>
</mujoco>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_link_placements_agree_with_mujoco(file: Path, tmp_path: Path) -> None:
    """Several joints of a body, anchors away from its origin, references: at random positions."""
    root = convert_mjcf(file, tmp_path / "meshes").root
    for limit in root.iter("limit"):  # Pinocchio insists on them
        limit.attrib.update(effort="1", velocity="1")
    model = pin.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"))
    theirs = mujoco.MjModel.from_xml_path(str(file))
    state, data, rng = mujoco.MjData(theirs), model.createData(), np.random.default_rng(3)
    for _ in range(5):
        state.qpos[:] = rng.uniform(-0.5, 0.5, theirs.nq)
        mujoco.mj_kinematics(theirs, state)
        moved = state.qpos - theirs.qpos0
        positions = {theirs.joint(j).name: moved[theirs.jnt_qposadr[j]] for j in range(theirs.njnt)}
        pin.framesForwardKinematics(model, data, make_configuration(model, positions))
        for name in ("foot", "upper", "fore", "tip"):
            place = data.oMf[model.getFrameId(name, pin.FrameType.BODY)]
            np.testing.assert_allclose(place.translation, state.body(name).xpos, atol=1e-7)
            np.testing.assert_allclose(place.rotation.ravel(), state.body(name).xmat, atol=1e-7)


def test_limits_shapes_couplings_and_states_are_kept(file: Path, tmp_path: Path) -> None:
    made = convert_mjcf(file, tmp_path / "meshes")
    joints = {joint.get("name"): joint for joint in made.root.findall("joint")}

    def limit(name: str, key: str) -> float:
        element = joints[name].find("limit")
        assert element is not None
        return float(element.get(key, "nan"))

    assert limit("lift", "lower") == pytest.approx(np.radians(-55))  # of ref
    assert limit("out", "effort") == 40.0
    assert joints["twist"].get("type") == "continuous"
    mimic = joints["jaw"].find("mimic")
    assert mimic is not None
    assert mimic.attrib == {"joint": "out", "multiplier": "0.1", "offset": "0.01"}
    assert made.states["home"]["lift"] == pytest.approx(0.4 - np.radians(10))
    fore = next(link for link in made.root.findall("link") if link.get("name") == "fore")
    assert [element.find("geometry")[0].tag for element in fore.findall("collision")] == ["mesh"]  # type: ignore[index]
    assert len(fore.findall("visual")) == 1
    masses = sum(float(element.get("value", "0")) for element in made.root.iter("mass"))
    theirs = mujoco.MjModel.from_xml_path(str(file))
    assert masses == pytest.approx(
        theirs.body_mass[theirs.body_rootid == theirs.body("foot").id].sum(), rel=1e-6
    )
    assert any("table" in note for note in made.notes)


def test_invalid_files_are_named(tmp_path: Path) -> None:
    for name, text, said in (
        (
            "wrong.xml",
            "<mujoco><worldbody><body><joint axis='0 0 0'/></body></worldbody></mujoco>",
            "MuJoCo cannot",
        ),
        (
            "still.xml",
            "<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>",
            "the file has no joints",
        ),
    ):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        with pytest.raises(vkc.InputError, match=said) as caught:
            convert_mjcf(path, tmp_path)
        assert caught.value.file == path


def coupled(*equalities: str) -> str:
    """Return an MJCF of three sliding joints one on the other, with couplings."""
    joints = "".join(
        f'<body><joint name="j{k}" type="slide" range="0 1"/><geom size="0.01"/>' for k in range(3)
    )
    bodies = f"<worldbody>{joints}{'</body>' * 3}</worldbody>"
    return f"<mujoco>{bodies}<equality>{''.join(equalities)}</equality></mujoco>"


def same(one: str, other: str, more: str = "") -> str:
    return f'<joint joint1="{one}" joint2="{other}" {more}/>'


@pytest.mark.parametrize(
    ("equalities", "follows", "noted"),
    [
        ((same("j1", "j0"), same("j2", "j1")), {"j1": "j0", "j2": "j1"}, ""),
        (
            (same("j0", "j1"), same("j0", "j2", 'polycoef="0.1 2 0 0 0"')),
            {"j0": "j1", "j2": "j0"},
            "",
        ),  # the second is inverted: j0 = 0.1 + 2·j2
        (
            (same("j0", "j1"), same("j1", "j0")),
            {"j0": "j1"},
            "j1 follows j0; another coupling of it is left out",
        ),
        (
            (same("j1", "j0", 'polycoef="0 1 0.5 0 0"'),),
            {"j1": "j0"},
            "j1 follows j0 by a nonlinear function",
        ),
        ((same("j1", "j0", 'active="false"'),), {}, ""),
    ],
)
def test_couplings_become_a_tree(
    tmp_path: Path, equalities: tuple[str, ...], follows: dict[str, str], noted: str
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(coupled(*equalities))
    made = convert_mjcf(path, tmp_path / "meshes")
    said = {joint.get("name"): joint.find("mimic") for joint in made.root.findall("joint")}
    assert {
        name: mimic.get("joint") for name, mimic in said.items() if mimic is not None
    } == follows
    assert any(noted in note for note in made.notes) == bool(noted)
    if "j2" in follows and follows["j2"] == "j0":
        inverse = {"joint": "j0", "multiplier": "0.5", "offset": "-0.05"}
        assert said["j2"] is not None
        assert said["j2"].attrib == inverse


def test_similar_names_become_distinct_links_and_joints(tmp_path: Path) -> None:
    names = {"a+b": "j+1", "a b": "j 1", "base_fixed": "base"}
    bodies = "".join(
        f'<body name="{body}"><joint name="{joint}" range="-1 1"/><geom size="0.1{k}"/></body>'
        for k, (body, joint) in enumerate(names.items())
    )
    path = tmp_path / "arm.xml"
    path.write_text(
        f'<mujoco><worldbody><body name="base"><geom size="0.2"/>{bodies}</body></worldbody>'
        "</mujoco>"
    )
    root = convert_mjcf(path, tmp_path / "meshes").root
    check_tree(path, root)
    radii = {}
    for link in root.findall("link"):
        for sphere in link.findall("collision/geometry/sphere"):
            radii[link.get("name")] = float(sphere.attrib["radius"])
    assert radii == pytest.approx({"base": 0.2, "a_b": 0.1, "a_b_body": 0.11, "base_fixed": 0.12})
    moving = {joint.get("name") for joint in root.iter("joint") if joint.get("type") == "revolute"}
    assert moving == {"j_1", "j_1_joint", "base_joint"}
