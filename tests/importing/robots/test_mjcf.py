from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.importing.robots.sources import Source, read_source
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


def read_robot(file: Path) -> Source:
    return read_source(file, file.parent / "meshes", packages={}, arguments={})


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arm.xml"
    path.write_text(ARM, encoding="utf-8")
    return path


def test_shapes_are_where_mujoco_has_them(file: Path, tmp_path: Path) -> None:
    """Bodies have several joints, anchors away from the origin, and reference positions."""
    robot = read_robot(file).file
    model = pin.buildModelFromXML(robot.text)
    shapes = robot.read_shapes("collision")
    assert [shape.link for shape in shapes] == ["foot", "upper", "fore", "tip"]
    reference = mujoco.MjModel.from_xml_path(str(file))
    state = mujoco.MjData(reference)
    data = model.createData()
    rng = np.random.default_rng(3)
    for _ in range(5):
        state.qpos[:] = rng.uniform(-0.5, 0.5, reference.nq)
        mujoco.mj_kinematics(reference, state)
        moved = state.qpos - reference.qpos0
        positions = {
            reference.joint(j).name: moved[reference.jnt_qposadr[j]] for j in range(reference.njnt)
        }
        pin.framesForwardKinematics(model, data, make_configuration(model, positions))
        for shape in shapes:
            frame = data.oMf[model.getFrameId(shape.link, pin.FrameType.BODY)]
            place = frame * shape.placement
            geom = reference.body(shape.link).geomadr[0]  # the first one of its body collides
            np.testing.assert_allclose(place.translation, state.geom_xpos[geom], atol=1e-7)
            np.testing.assert_allclose(place.rotation.ravel(), state.geom_xmat[geom], atol=1e-7)


def test_limits_shapes_couplings_and_states_are_converted(file: Path, tmp_path: Path) -> None:
    converted = read_robot(file)
    joints = {joint.get("name"): joint for joint in converted.file.root.findall("joint")}

    def limit(name: str, key: str) -> float:
        return float(joints[name].find("limit").get(key, "nan"))  # type: ignore[union-attr]

    assert limit("lift", "lower") == pytest.approx(np.radians(-55))  # relative to ref
    assert limit("out", "effort") == 40.0
    assert joints["twist"].get("type") == "continuous"
    mimic = joints["jaw"].find("mimic")
    assert mimic is not None
    assert mimic.attrib == {"joint": "out", "multiplier": "0.1", "offset": "0.01"}
    (home,) = converted.srdf.states
    assert home.name == "home"
    assert home.positions["lift"] == pytest.approx(0.4 - np.radians(10))
    fore = next(link for link in converted.file.root.findall("link") if link.get("name") == "fore")
    assert [element.find("geometry")[0].tag for element in fore.findall("collision")] == ["mesh"]  # type: ignore[index]
    assert len(fore.findall("visual")) == 2  # MuJoCo's viewer shows both
    masses = sum(float(element.get("value", "0")) for element in converted.file.root.iter("mass"))
    reference = mujoco.MjModel.from_xml_path(str(file))
    arm = reference.body_rootid == reference.body("foot").id
    assert masses == pytest.approx(reference.body_mass[arm].sum(), rel=1e-6)
    assert any("table" in note for note in converted.notes)


def test_errors_name_the_invalid_file(tmp_path: Path) -> None:
    for name, content, message in (
        ("wrong.xml", "<joint axis='0 0 0'/>", "MuJoCo cannot"),
        ("wrong.xml", "<geom size='1'/>", "the file has no joints"),
        ("\udcff.xml", "<geom size='1'/>", "MuJoCo needs a file name in UTF-8"),
    ):
        path = tmp_path / name
        path.write_text(f"<mujoco><worldbody><body>{content}</body></worldbody></mujoco>")
        with pytest.raises(vkc.InputError, match=message) as caught:
            read_robot(path)
        assert caught.value.file == path


def couple(one: str, other: str, more: str = "") -> str:
    return f'<joint joint1="{one}" joint2="{other}" {more}/>'


@pytest.mark.parametrize(
    ("equalities", "follows", "expected_note"),
    [
        (couple("j1", "j0") + couple("j2", "j1"), {"j1": "j0", "j2": "j1"}, ""),
        # The second is inverted: j0 = 0.1 + 2·j2.
        (
            couple("j0", "j1") + couple("j0", "j2", 'polycoef="0.1 2 0 0 0"'),
            {"j0": "j1", "j2": "j0"},
            "",
        ),
        (
            couple("j0", "j1") + couple("j1", "j0"),
            {"j0": "j1"},
            "j1 follows j0; another coupling of it is left out",
        ),
        (
            couple("j1", "j0", 'polycoef="0 1 0.5 0 0"'),
            {"j1": "j0"},
            "j1 follows j0 by a nonlinear function",
        ),
        (couple("j1", "j0", 'active="false"'), {}, ""),
    ],
)
def test_couplings_become_a_tree(
    tmp_path: Path, equalities: str, follows: dict[str, str], expected_note: str
) -> None:
    """Three prismatic joints in series are coupled."""
    bodies = "".join(
        f'<body><joint name="j{k}" type="slide" range="0 1"/><geom size="0.01"/>' for k in range(3)
    )
    path = tmp_path / "arm.xml"
    path.write_text(
        f"<mujoco><worldbody>{bodies}{'</body>' * 3}</worldbody>"
        f"<equality>{equalities}</equality></mujoco>"
    )
    converted = read_robot(path)
    mimics = {
        joint.get("name"): mimic.attrib
        for joint in converted.file.root.findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    assert {name: mimic["joint"] for name, mimic in mimics.items()} == follows
    notes = [note for note in converted.notes if "follows" in note]
    assert any(expected_note in note for note in notes) == bool(expected_note)
    if follows.get("j2") == "j0":
        assert mimics["j2"] == {"joint": "j0", "multiplier": "0.5", "offset": "-0.05"}


def test_similar_names_become_distinct_links_and_joints(tmp_path: Path) -> None:
    names = {"a+b": "j+1", "a b": "j 1", "base_fixed": "base"}
    bodies = "".join(
        f'<body name="{body}"><joint name="{joint}" range="-1 1"/><geom size="0.1{k}"/></body>'
        for k, (body, joint) in enumerate(names.items())
    )
    path = tmp_path / "arm.xml"
    base = f'<body name="base"><geom size="0.2"/>{bodies}</body>'
    path.write_text(f"<mujoco><worldbody>{base}</worldbody></mujoco>")
    root = read_robot(path).file.root
    check_tree(path, root)
    radii = {
        link.get("name"): float(sphere.attrib["radius"])
        for link in root.findall("link")
        for sphere in link.findall("collision/geometry/sphere")
    }
    assert radii == pytest.approx({"base": 0.2, "a_b": 0.1, "a_b_body": 0.11, "base_fixed": 0.12})
    moving = {joint.get("name") for joint in root.iter("joint") if joint.get("type") == "revolute"}
    assert moving == {"j_1", "j_1_joint", "base_joint"}
