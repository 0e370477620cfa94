from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trimesh

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description
from vkc_pin.importing.objects.limits import add_missing_limits
from vkc_pin.importing.objects.object_reading import read_object

CHEST = """<?xml version="1.0"?>
<sdf version="{version}"><model name="chest">{model}
<link name="case"><pose>0 0 0.4 0 0 0</pose>
  <collision name="c"><geometry><box><size>0.4 0.6 0.8</size></box></geometry></collision></link>
<link name="front"><pose{attributes}>{pose}</pose>{front}
  <collision name="c"><geometry><box><size>0.02 0.56 0.3</size></box></geometry></collision></link>
<joint name="slide" type="prismatic">{joint_pose}<parent>{parent}</parent><child>{child}</child>
  <axis>{axis}<limit><lower>{lower}</lower><upper>{upper}</upper></limit>{dynamics}</axis></joint>
</model></sdf>"""
DEFAULTS = {
    "version": "1.7",
    "model": "",
    "attributes": "",
    "pose": "-0.22 0 0.5 0 0 0",
    "front": "",
    "joint_pose": "",
    "parent": "case",
    "child": "front",
    "axis": "<xyz>-1 0 0</xyz>",
    "lower": "0",
    "upper": "0.3",
    "dynamics": "",
}


def format_chest(**changes: str) -> str:
    return CHEST.format(**{**DEFAULTS, **changes})


def read_model(folder: Path, text: str) -> Description:
    (folder / "t.sdf").write_text(text)
    return read_object(folder / "t.sdf")


def read_chest(folder: Path, **changes: str) -> Description:
    return read_model(folder, format_chest(**changes))


def find_axis(found: Description, link: str) -> np.ndarray:
    """Return the axis of a link's joint in the world."""
    return found.compute_placements()[link].rotation @ found.joints[link].axis


def compute_box(found: Description, link: str = "front") -> np.ndarray:
    """Return the bounding box of a link's first shape in the world, shape (2, 3) [m]."""
    mesh = found.links[link].collision[0].make_mesh()
    return mesh.apply_transform(found.compute_placements()[link].homogeneous).bounds


def format_joint(parent: str, child: str, *, name: str = "k", kind: str = "fixed") -> str:
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f'<joint name="{name}" type="{kind}">{ends}</joint>'


FRAMES = (
    '<frame name="f" attached_to="case"><pose>-0.22 0 0 0 0 0</pose></frame>'
    '<frame name="g" attached_to="f"/><frame name="h" attached_to="front"/>'
)
QUATERNION = ' rotation_format="quat_xyzw"'


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"axis": "<xyz>-3 0 0</xyz>"},
        {"child": "h", "model": FRAMES},
        {"parent": "g", "model": FRAMES},
        {"parent": "__model__"},
        {"attributes": ' relative_to="f"', "pose": "0 0 0.1 0 0 0", "model": FRAMES},
        {"attributes": ' relative_to="g"', "pose": " 0 0 0.1 \n 0\t0 0 ", "model": FRAMES},
        {"attributes": ' frame="case"', "pose": "-0.22 0 0.1 0 0 0", "version": "1.6"},
        {"attributes": ' relative_to=""'},
        {"attributes": ' relative_to="__model__"'},
        {"attributes": ' relative_to="world"'},
        {
            "attributes": ' relative_to="slide"',
            "pose": "",
            "joint_pose": '<pose relative_to="case">-0.22 0 0.1 0 0 0</pose>',
        },
        {"attributes": QUATERNION, "pose": "-0.22 0 0.5 0 0 0 1"},
        {"attributes": QUATERNION, "pose": "-0.22 0 0.5 0 0 2 0", "axis": "<xyz>1 0 0</xyz>"},
        {
            "attributes": ' rotation_format="euler_rpy" degrees="1"',
            "pose": "-0.22 0 0.5 0 0 180",
            "axis": "<xyz>1 0 0</xyz>",
        },
        {"attributes": ' degrees="TRUE"', "pose": "-0.22 0 0.5 360 0 0", "version": "1.12"},
        {"model": '<pose relative_to="">0 0 0 0 0 0</pose>', "version": "1.6.0"},
        {"version": " 1.10 "},
        {"version": "1.2"},
        {"lower": " 0 ", "upper": "3e-1"},
        {"axis": '<xyz expressed_in="case">-1 0 0</xyz>'},
        {
            "axis": '<xyz expressed_in="front">-1 0 0</xyz>',
            "joint_pose": "<pose>0 0 0 0 0 2</pose>",
        },
    ],
)
def test_equivalent_spellings_yield_the_same_chest(tmp_path: Path, changes: dict[str, str]) -> None:
    found = read_chest(tmp_path, **changes)
    np.testing.assert_allclose(
        compute_box(found), [[-0.23, -0.28, 0.35], [-0.21, 0.28, 0.65]], atol=1e-9
    )
    np.testing.assert_allclose(find_axis(found, "front"), [-1.0, 0.0, 0.0], atol=1e-9)
    assert found.joints["front"].limits == (0.0, 0.3)
    assert found.joints["front"].parent == "case"
    assert found.notes == ()


@pytest.mark.parametrize(
    ("version", "flag", "axis"),
    [
        ("1.2", "", [0, 0, 1]),
        ("1.4", "", [0, 0, 1]),
        ("1.4", "<use_parent_model_frame>0</use_parent_model_frame>", [0, 0, 1]),
        ("1.5", "", [0, -1, 0]),
        ("1.5", "<use_parent_model_frame>1</use_parent_model_frame>", [0, 0, 1]),
        ("1.6", "<use_parent_model_frame> True </use_parent_model_frame>", [0, 0, 1]),
        ("1.6", "<use_parent_model_frame>false</use_parent_model_frame>", [0, -1, 0]),
        ("1.7", "<use_parent_model_frame>1</use_parent_model_frame>", [0, -1, 0]),
    ],
)
def test_version_determines_the_frame_of_the_axis(
    tmp_path: Path, version: str, flag: str, axis: list[float]
) -> None:
    """The front is rolled by 90°; the pose of the model also rotates the axis."""
    pose = "-0.22 0 0.5 1.5707963267948966 0 0"
    changes = {"version": version, "pose": pose, "axis": f"<xyz>0 0 1</xyz>{flag}"}
    found = read_chest(tmp_path, **changes)
    np.testing.assert_allclose(find_axis(found, "front"), axis, atol=1e-9)
    yawed = read_chest(tmp_path, **changes, model="<pose>0 0 0 0 0 1.5707963267948966</pose>")
    x, y, z = axis
    np.testing.assert_allclose(find_axis(yawed, "front"), [-y, x, z], atol=1e-9)
    np.testing.assert_allclose(np.ptp(compute_box(yawed, "case"), axis=0), [0.6, 0.4, 0.8])


PARENT_FRAME = "<use_parent_model_frame>{}</use_parent_model_frame>"


@pytest.mark.parametrize(
    ("changes", "left_out"),
    [
        ({"version": "1.7", "flag": PARENT_FRAME.format("1")}, "<use_parent_model_frame>"),
        ({"version": "1.11", "flag": PARENT_FRAME.format(" true ")}, "<use_parent_model_frame>"),
        ({"version": "1.7", "flag": PARENT_FRAME.format("0")}, ""),  # as in every version since
        ({"version": "1.6", "flag": PARENT_FRAME.format("1")}, ""),
        ({"version": "1.5", "flag": PARENT_FRAME.format("0")}, ""),
        ({"version": "1.4", "flag": PARENT_FRAME.format("0")}, "<use_parent_model_frame>"),
        ({"version": "1.4", "flag": PARENT_FRAME.format("1")}, ""),  # as in every version before
        ({"version": "1.7", "attributes": ' frame="case"'}, "`frame` of <pose>"),
        ({"version": "1.9", "attributes": ' frame="nothing"'}, "`frame` of <pose>"),
        ({"version": "1.6", "attributes": ' frame="case"'}, ""),
        ({"version": "1.7", "attributes": ' relative_to="case"'}, ""),
    ],
)
def test_settings_of_other_versions_are_noted(
    tmp_path: Path, changes: dict[str, str], left_out: str
) -> None:
    axis = f"<xyz>-1 0 0</xyz>{changes.pop('flag', '')}"
    found = read_chest(tmp_path, axis=axis, **changes)
    version = changes["version"]
    assert len(found.notes) == bool(left_out)
    if "pose" in left_out:
        np.testing.assert_allclose(compute_box(found)[0], [-0.23, -0.28, 0.35], atol=1e-9)
    for note in found.notes:
        assert note.startswith("t.sdf:")
        assert note.endswith(f": {left_out} does not belong to SDF {version}: left out")


@pytest.mark.parametrize("free", [False, True])
def test_links_of_old_files_may_be_named_world(tmp_path: Path, free: bool) -> None:
    text = format_chest(version="1.6", parent="world").replace('"case"', '"world"')
    (tmp_path / "t.sdf").write_text(text)
    found = read_object(tmp_path / "t.sdf", free=free)
    assert found.joints["front"].parent == "world"
    assert len(found.links) == 2
    np.testing.assert_allclose(np.ptp(compute_box(found, "world"), axis=0), [0.4, 0.6, 0.8])


def test_joint_to_the_world_makes_the_world_the_root(tmp_path: Path) -> None:
    found = read_chest(tmp_path, model=format_joint("world", "case"))
    assert found.root == "world"
    assert np.allclose(found.compute_placements()["case"].translation, [0.0, 0.0, 0.4])


@pytest.mark.parametrize("frame", ["case", "f", "slide", "front"])
def test_model_pose_refers_to_its_placement_frame(tmp_path: Path, frame: str) -> None:
    """A pose equal to that of the frame in the model leaves the model in place."""
    found = read_chest(tmp_path, model=FRAMES)
    poses = {"case": "0 0 0.4", "f": "-0.22 0 0.4", "slide": "-0.22 0 0.5", "front": "-0.22 0 0.5"}
    text = format_chest(model=f"{FRAMES}<pose>{poses[frame]} 0 0 0</pose>", version="1.8")
    placed = read_model(tmp_path, text.replace('"chest"', f'"chest" placement_frame="{frame}"'))
    np.testing.assert_allclose(compute_box(placed), compute_box(found), atol=1e-9)


def test_links_and_joints_may_share_a_name(tmp_path: Path) -> None:
    text = format_chest(joint_pose="<pose>0 0.1 0 0 0 0</pose>").replace('"slide"', '"front"')
    np.testing.assert_allclose(compute_box(read_model(tmp_path, text))[0], [-0.23, -0.28, 0.35])


@pytest.mark.parametrize(
    ("lower", "upper", "limits", "assumed"),
    [
        ("-0.3", "1e16", (-0.3, np.inf), (-0.3, 0.0)),
        ("-inf", "0.25", (-np.inf, 0.25), (0.0, 0.25)),
        ("0", "inf", (0.0, np.inf), (0.0, 0.016)),
        ("-1e16", "0", (-np.inf, 0.0), (-0.016, 0.0)),
        ("0.1", "1.79769e308", (0.1, np.inf), (0.1, 0.116)),
        ("-INF", "Inf", None, (0.0, 0.016)),
        ("0.3", "-0.1", (-0.1, 0.3), (-0.1, 0.3)),
    ],
)
def test_limits_may_be_one_sided(
    tmp_path: Path,
    lower: str,
    upper: str,
    limits: tuple[float, float] | None,
    assumed: tuple[float, float],
) -> None:
    found = read_chest(tmp_path, lower=lower, upper=upper)
    assert found.joints["front"].limits == limits
    completed = add_missing_limits(found)
    assert completed.joints["front"].limits == pytest.approx(assumed)
    assert completed.notes


def test_missing_meshes_are_replaced_or_listed(tmp_path: Path) -> None:
    mesh = '<{} name="v"><geometry><mesh><uri>model://a/{}.dae</uri></mesh></geometry></{}>'
    visual, collision, other = (
        mesh.format(kind, file, kind)
        for kind, file in (("visual", "b"), ("collision", "b"), ("collision", "c"))
    )
    found = read_chest(tmp_path, front=visual)
    assert found.links["front"].visual == ()
    assert "link 'front': " in found.notes[0]
    assert "no such mesh" in found.notes[0]
    assert found.notes[0].endswith("left out")
    sphere = '<visual name="s"><geometry><sphere><radius>1</radius></sphere></geometry></visual>'
    found = read_chest(tmp_path, front=collision + sphere)
    assert [part.kind for part in found.links["front"].solid] == ["sphere"]
    assert found.notes[0].endswith("its visual shapes collide instead")
    for changes, message in (
        ({"front": collision}, r"t\.sdf:5: model://a/b\.dae: there is no such mesh"),
        ({"front": collision + other}, r"2 meshes do not exist: model://a/b\.dae, model"),
        ({"model": f'<static>1</static><link name="seen">{visual}</link>'}, "no such mesh"),
    ):
        with pytest.raises(InputError, match=message):
            read_chest(tmp_path, **changes).check_meshes()


def test_inertia_resistance_and_springs_are_read(tmp_path: Path) -> None:
    moments = "<inertia><ixx>0.1</ixx><iyy>0.2</iyy><izz>0.25</izz></inertia>"
    inertial = f"<inertial><pose>0 0 0.1 0 0 0</pose><mass>2</mass>{moments}</inertial>"
    settings = {"damping": 0.4, "friction": 0.2, "spring_stiffness": 4.0, "spring_reference": -0.2}
    dynamics = "".join(f"<{name}>{value}</{name}>" for name, value in settings.items())
    found = read_chest(tmp_path, front=inertial, dynamics=f"<dynamics>{dynamics}</dynamics>")
    expected = pin.Inertia(2.0, np.array([0.0, 0.0, 0.1]), np.diag([0.1, 0.2, 0.25]))
    assert found.links["front"].inertia.isApprox(expected)
    joint = found.joints["front"]
    read = (joint.damping, joint.friction, joint.stiffness, joint.springref)
    assert read == tuple(settings.values())
    wrong = read_chest(tmp_path, front=inertial.replace("0.1</ixx>", "-0.1</ixx>"))
    assert wrong.links["front"].inertia.mass == 0.0
    assert any("<inertial> counts as none" in note for note in wrong.notes)


BOXES = (
    '<collision name="{0}"><pose>0 0 {1} 0 0 0</pose>{2}'
    "<geometry><box><size>0.1 0.2 0.3</size></box></geometry></collision>"
)
BALL = (
    '<collision name="ball"><pose>0.2 0 0 0 0 0</pose>'
    "<geometry><sphere><radius>0.1</radius></sphere></geometry></collision>"
)
BOX_SIZE = (0.1, 0.2, 0.3)
BALL_MASS = 4000.0 / 3.0 * np.pi * 0.1**3


def place(inertia: pin.Inertia, *at: float) -> pin.Inertia:
    return pin.SE3(np.eye(3), np.array(at)).act(inertia)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("<inertial><mass>2</mass></inertial>", pin.Inertia(2.0, np.zeros(3), np.eye(3))),
        ("<inertial/>", pin.Inertia(1.0, np.zeros(3), np.eye(3))),
        (
            "<inertial><pose>0 0.1 0 0 0 0</pose><mass>3</mass>"
            "<inertia><ixx>0.5</ixx><iyz>0.1</iyz></inertia></inertial>",
            pin.Inertia(
                3.0,
                np.array([0.0, 0.1, 0.0]),
                np.array([[0.5, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, 0.1, 1.0]]),
            ),
        ),
        (
            '<inertial auto="true"/>' + BOXES.format("b", 0.5, ""),
            place(pin.Inertia.FromBox(6.0, *BOX_SIZE), 0.0, 0.0, 0.5),
        ),
        (
            '<inertial auto="1"><density>200</density></inertial>'
            + BOXES.format("b", 0.5, "")
            + BOXES.format("c", 1.0, "<density>20000</density>"),
            place(pin.Inertia.FromBox(1.2, *BOX_SIZE), 0.0, 0.0, 0.5)
            + place(pin.Inertia.FromBox(120.0, *BOX_SIZE), 0.0, 0.0, 1.0),
        ),
        (
            '<inertial auto="true"><mass>5</mass><inertia><ixx>9</ixx></inertia></inertial>'
            + BOXES.format("b", 0.5, "<density>7</density>"),
            place(pin.Inertia.FromBox(5.0, *BOX_SIZE), 0.0, 0.0, 0.5),
        ),
        (
            '<inertial auto="true"/>' + BALL,
            place(pin.Inertia.FromSphere(BALL_MASS, 0.1), 0.2, 0.0, 0.0),
        ),
    ],
)
def test_inertia_that_is_not_stated_is_that_of_gazebo(
    tmp_path: Path, content: str, expected: pin.Inertia
) -> None:
    text = f'<sdf version="1.11"><model name="m"><link name="l">{content}</link></model></sdf>'
    found = read_model(tmp_path, text).links["l"].inertia
    assert found.isApprox(expected, 1e-6)


def test_mass_of_imported_drawer_is_computed_from_its_mesh(tmp_path: Path) -> None:
    """The mesh is an L of two boxes, scaled from millimetres."""
    parts = [trimesh.creation.box((400, 100, 100)), trimesh.creation.box((100, 300, 100))]
    parts[1].apply_translation((-150, 200, 0))
    trimesh.util.concatenate(parts).export(tmp_path / "l.stl")
    shape = "<mesh><uri>l.stl</uri><scale>0.001 0.001 0.001</scale></mesh>"
    front = f'<collision name="l"><geometry>{shape}</geometry></collision>'
    found = read_chest(tmp_path, front=f'<inertial auto="true"/>{front}', version="1.11")
    inertia = found.links["front"].inertia
    box_mass = sum(
        1000.0 * np.prod(part.size) for part in found.links["front"].collision if part.kind == "box"
    )
    assert inertia.mass == pytest.approx(7.0 + box_mass)


def test_inertia_without_solids_counts_as_none(tmp_path: Path) -> None:
    link = '<link name="l"><inertial auto="true"/></link>'
    found = read_model(tmp_path, f'<sdf version="1.11"><model name="m">{link}</model></sdf>')
    assert found.links["l"].inertia.mass == 0.0
    assert any("cannot be computed from its collision shapes" in note for note in found.notes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *[
            ({"version": version}, r"t\.sdf:2: sdf version: .*1\.2 to 1\.12")
            for version in ("1", "", "1.a", "2.0", "1.0", "-1.7", "1.7beta")
        ],
        ({"axis": "<xyz>0 0 0</xyz>"}, "slide: axis xyz: an axis without direction"),
        ({"axis": "<xyz>0 1</xyz>"}, r"t\.sdf:8: slide: axis xyz: wrong numbers"),
        ({"axis": '<xyz expressed_in="cas">0 0 1</xyz>'}, "no frame 'cas'; did you mean 'case'"),
        ({"attributes": ' rotation_format="quat"'}, "did you mean 'quat_xyzw'"),
        ({"attributes": QUATERNION}, "front: pose: .*7 finite"),
        ({"attributes": QUATERNION, "pose": "0 0 0 0 0 0 0"}, "front: .*length 0"),
        (
            {"attributes": f'{QUATERNION} degrees="1"', "pose": "0 0 0 0 0 0 1"},
            "a quaternion in degrees",
        ),
        ({"pose": "0 0 1e300 0 0 0"}, "front: pose: .*at most 10000"),
        ({"pose": "0 0 0"}, "front: pose: wrong numbers .*6 finite numbers"),
        ({"attributes": ' relative_to="slide"'}, "cycle .*front → slide → front"),
        ({"model": '<frame name="a" attached_to="a"/>', "child": "a"}, "cycle .*a → a"),
        ({"model": '<frame name="a" attached_to="slide"/>', "child": "a"}, "cycle"),
        ({"parent": "front"}, r"t\.sdf:5: front: links in a circle .*front → front"),
        ({"child": "frot"}, r"t\.sdf: .*'frot'; did you mean 'front'"),
        ({"child": ""}, r"t\.sdf:7: slide: a joint that connects nothing .*<child>"),
        ({"child": "world"}, "slide: the world cannot be a child"),
        ({"model": format_joint("", "", name="slide")}, "slide: two joints have the same name"),
        ({"model": format_joint("front", "case")}, "links in a circle"),
        (
            {"model": format_joint("world", "front")},
            "front: a link with two parents .*'k' and 'slide'",
        ),
        (
            {"model": format_joint("world", "case", kind="hinge")},
            "k: there is no joint type 'hinge'",
        ),
        ({"model": '</model><model name="other">'}, "not hold exactly one model"),
        ({"model": "<link/>"}, "a link without a name"),
        *[
            ({"model": f"<include>{uri}</include>"}, "no such model")
            for uri in ("", f"<uri>{'a' * 300}</uri>", "<uri>model://%00</uri>")
        ],
        (
            {"model": '<link name="a::b"/><model name="a"><link name="b"/></model>'},
            "a::b: two links have the same name",
        ),
        ({"model": "<include><uri>t.sdf</uri></include>"}, r"includes itself .*t\.sdf → t\.sdf"),
        ({"model": '<model name="m"/>'}, "m: a model without links"),
        (
            {
                "model": "".join(
                    f'<frame name="f{k}" attached_to="f{k + 1}"/>' for k in range(2000)
                ),
                "parent": "f0",
            },
            "nested too deeply",
        ),
    ],
)
def test_invalid_models_are_rejected(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_chest(tmp_path, **changes)


def test_notes_state_how_a_file_is_read(tmp_path: Path) -> None:
    """The file has commas between numbers, or a missing or unknown version."""
    (tmp_path / "t.sdf").write_text(format_chest(pose="-0.22, 0, 0.5, 0, 0, 0"))
    found = read_object(tmp_path / "t.sdf")
    np.testing.assert_allclose(compute_box(found)[0], [-0.23, -0.28, 0.35])
    assert found.notes == (f"{tmp_path / 't.sdf'}: pose text: commas are read as spaces",)
    found = read_model(tmp_path, format_chest().replace(' version="1.7"', ""))
    assert found.notes == ("t.sdf states no version: read as SDF 1.7",)
    assert "1.99: read as SDF 1.12" in read_chest(tmp_path, version="1.99").notes[0]


def test_submesh_selects_a_part_of_a_mesh_file(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    for name, size, at in (
        ("shell", (0.4, 0.6, 0.8), (0, 0, 0)),
        ("face", (0.02, 0.5, 0.3), (1, 0, 0)),
    ):
        box = trimesh.creation.box(size).apply_translation(at)
        scene.add_geometry(box, node_name=name)
    # In glTF files y is up.
    scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2.0, (1, 0, 0)))
    scene.export(tmp_path / "both.glb")
    text = format_chest(pose="0 0 0 0 0 0")
    box = "<box><size>0.02 0.56 0.3</size></box>"
    for centre, low in (("", 1.98), ("<center>true</center>", -0.02)):
        part = f"<submesh><name>face</name>{centre}</submesh><scale>2 1 1</scale>"
        mesh = f"<mesh><uri>both.glb</uri>{part}</mesh>"
        bounds = compute_box(read_model(tmp_path, text.replace(box, mesh)))
        expected = [[low, -0.25, -0.15], [low + 0.04, 0.25, 0.15]]
        np.testing.assert_allclose(bounds, expected, atol=1e-6)
    with pytest.raises(InputError, match="submesh 'fac'; did you mean 'face'"):
        read_model(tmp_path, text.replace(box, mesh.replace("face", "fac")))


WORLD = """<sdf version="1.6"><world name="flat">
  <include><uri>model://bin</uri><pose>3 0 0 0 0 0</pose></include>
  <include><uri>model://plain</uri><name>other</name><pose>4 0 0 0 0 0</pose>
    <static>1</static></include>
  <model name="wall"><static>true</static><pose>0 2 1 0 0 0</pose><link name="l">
    <collision name="c"><geometry><box><size>4 0.1 2</size></box></geometry></collision></link>
  </model>
  <model name="unit"><pose>1 0 0 0 0 0</pose>
    <include><uri>model://bin</uri><name>part</name><pose>0 0 1 0 0 0</pose></include>
    <joint name="door" type="revolute"><parent>world</parent><child>part::body</child>
      <axis><xyz>0 0 1</xyz><limit><lower>0</lower><upper>1</upper></limit></axis></joint></model>
  <light name="sun"/><state world_name="flat"/><model name="nothing"/>
</world></sdf>"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder `worlds` beside `models` with a model in two versions, and in one."""
    bin_folder = tmp_path / "models" / "bin"
    bin_folder.mkdir(parents=True)
    (tmp_path / "worlds").mkdir()
    body = (
        '<model name="bin"><pose>9 9 9 0 0 0</pose><link name="body"><collision name="c">'
        "<geometry><ellipsoid><radii>0.1 0.2 0.3</radii></ellipsoid></geometry></collision></link>"
        "</model>"
    )
    (tmp_path / "models" / "plain").mkdir()
    for file in (bin_folder / "new.sdf", tmp_path / "models" / "plain" / "model.sdf"):
        file.write_text(f'<sdf version="1.6">{body}</sdf>')
    (bin_folder / "old.sdf").write_text('<sdf version="1.4"/>')
    (bin_folder / "model.config").write_text(
        '<model><sdf version="1.4">old.sdf</sdf><sdf version="1.6">new.sdf</sdf></model>'
    )
    return tmp_path / "worlds"


def test_worlds_and_included_models_are_read(folder: Path) -> None:
    (folder / "flat.world").write_text(WORLD)
    found = read_object(folder / "flat.world", free=True)
    kinds = {name: (joint.kind, joint.parent) for name, joint in found.joints.items()}
    assert kinds == {
        "bin": ("floating", "world"),
        "other": ("fixed", "world"),
        "wall": ("fixed", "world"),
        "unit::part::body": ("revolute", "world"),
    }
    placements = found.compute_placements()
    for name, position in (
        ("bin", [3, 0, 0]),
        ("other", [4, 0, 0]),
        ("unit::part::body", [1, 0, 1]),
    ):
        np.testing.assert_allclose(placements[name].translation, position)
    np.testing.assert_allclose(
        np.ptp(compute_box(found, "bin"), axis=0), [0.2, 0.4, 0.6], rtol=0.02
    )
    assert found.notes == ("<state> is left out", "model 'nothing' has no links: left out")
    without_free = read_object(folder / "flat.world")
    assert "bin" not in without_free.links
    assert "body 'bin' is free, hence a separate object: left out" in without_free.notes


@pytest.mark.parametrize("version", ["1.6", "1.9"])
def test_models_include_models(folder: Path, version: str) -> None:
    """Covers nested and merged models, and poses relative to another frame."""
    include = "<include{merge}><uri>model://bin</uri>{more}</include>"
    joint = (
        '<joint name="j" type="fixed"><parent>case</parent><child>{link}</child></joint>'
        '<frame name="f"><pose>0 0 2 0 0 0</pose></frame>'
    )
    for link, merge, more, position in (
        ("bin::body", "", "", [9, 9, 9]),
        ("b::body", "", "<name>b</name><pose>1 0 0 0 0 0</pose>", [1, 0, 0]),
        ("b", "", '<name>b</name><pose relative_to="f">1 0 0 0 0 0</pose>', [1, 0, 2]),
        ("body", ' merge="true"', "<pose>0 3 0 0 0 0</pose>", [0, 3, 0]),
    ):
        model = include.format(merge=merge, more=more) + joint.format(link=link)
        found = read_model(folder, format_chest(version=version, model=model))
        name = next(name for name in found.links if name.endswith("body"))
        assert found.joints[name].parent == "case"
        np.testing.assert_allclose(
            found.compute_placements()[name].translation, position, atol=1e-9
        )


@pytest.mark.long
def test_exponentially_many_models_are_rejected(tmp_path: Path) -> None:
    for k in range(14):
        inner = "".join(
            f"<include><uri>m{k + 1}.sdf</uri><name>{name}</name></include>" for name in "ab"
        )
        model = f'<model name="m"><link name="l"/>{inner if k < 13 else ""}</model>'
        (tmp_path / f"m{k}.sdf").write_text(f'<sdf version="1.7">{model}</sdf>')
    with pytest.raises(InputError, match=r"m0\.sdf: too many models"):
        read_object(tmp_path / "m0.sdf")


def format_follower(child: str, leader: str, limits: tuple[float, float], **mimic: float) -> str:
    """Return a link and its slide, which follows another one if there is a leader."""
    content = "".join(f"<{key}>{value}</{key}>" for key, value in mimic.items())
    coupling = f'<mimic joint="{leader}">{content}</mimic>' if leader else ""
    ends = f"<lower>{limits[0]}</lower><upper>{limits[1]}</upper>"
    box = "<geometry><box><size>0.1 0.1 0.1</size></box></geometry>"
    return (
        f'<link name="{child}"><collision name="c">{box}</collision></link>'
        f'<joint name="to_{child}" type="prismatic"><parent>base</parent><child>{child}</child>'
        f"<axis><xyz>0 1 0</xyz><limit>{ends}</limit>{coupling}</axis></joint>"
    )


@pytest.mark.parametrize(
    ("limits", "mimic", "expected"),
    [
        ((0.0, 0.4), {"multiplier": -1.0}, (-0.4, 0.0)),
        ((-0.2, 0.0), {"multiplier": -1.0}, (-0.2, 0.0)),
        ((-1e16, 1e16), {"multiplier": 0.5, "offset": 0.1}, (0.1, 0.3)),
        ((0.0, 9.0), {"multiplier": 2.0, "reference": 0.1, "offset": 0.3}, (0.1, 0.9)),
        ((0.0, 0.4), {}, (0.0, 0.4)),
        ((1.0, 1.4), {"multiplier": -2.0}, (-0.8, 0.0)),
    ],
)
@pytest.mark.parametrize("is_nested", [False, True])
def test_followers_keep_the_limits_that_their_leaders_reach(
    tmp_path: Path,
    limits: tuple[float, float],
    mimic: dict[str, float],
    expected: tuple[float, float],
    is_nested: bool,
) -> None:
    """A third joint follows the second one; a circle ends at its first joint."""
    content = (
        '<link name="base"/>'
        + format_follower("third", "to_second", (-9.0, 9.0), multiplier=-1.0)
        + format_follower("second", "to_first", limits, **mimic)
        + format_follower("first", "", (0.0, 0.4))
        + format_follower("one", "to_other", (0.0, 1.0), multiplier=-1.0)
        + format_follower("other", "to_one", (0.0, 1.0), multiplier=-1.0)
    )
    nested = f'<model name="part">{content}</model>' if is_nested else content
    text = f'<sdf version="1.11"><model name="m">{nested}</model></sdf>'
    found = {joint.name: joint.limits for joint in read_model(tmp_path, text).joints.values()}
    assert found["to_second"] == pytest.approx(expected)
    assert found["to_third"] == pytest.approx((-expected[1], -expected[0]))
    assert found["to_first"] == (0.0, 0.4)
    assert found["to_one"] == (-1.0, 0.0)
    assert found["to_other"] == (0.0, 1.0)


def test_spaces_around_names_do_not_matter(tmp_path: Path) -> None:
    content = '<link name="base"/>' + format_follower("first", "", (0.0, 0.4))
    content += format_follower("second", " to_first ", (0.0, 0.4), multiplier=-1.0)
    content = content.replace('joint name="to_first"', 'joint name=" to_first "')
    text = f'<sdf version="1.11"><model name="m">{content}</model></sdf>'
    found = {joint.name: joint.limits for joint in read_model(tmp_path, text).joints.values()}
    assert found == {"to_first": (0.0, 0.4), "to_second": (-0.4, 0.0)}


def test_links_take_no_names_from_elements_inside(tmp_path: Path) -> None:
    text = '<sdf version="1.11"><model name="m"><link><name>l</name></link></model></sdf>'
    with pytest.raises(InputError, match="a link without a name"):
        read_model(tmp_path, text)


@pytest.mark.parametrize(("radius", "length"), [(0.1, 0.3), (0.4, 0.05), (0.02, 1.0)])
def test_cones_stand_on_their_base(tmp_path: Path, radius: float, length: float) -> None:
    cone = f"<cone><radius>{radius}</radius><length>{length}</length></cone>"
    text = (
        '<sdf version="1.11"><model name="m"><link name="l"><inertial auto="true"/>'
        f'<collision name="c"><pose>1 0 0 0 0 0</pose><geometry>{cone}</geometry></collision>'
        "</link></model></sdf>"
    )
    link = read_model(tmp_path, text).links["l"]
    (part,) = link.collision
    low, high = part.make_mesh().bounds
    assert low == pytest.approx([1.0 - radius, -radius, -length / 2.0], abs=0.01 * radius)
    assert high == pytest.approx([1.0 + radius, radius, length / 2.0], abs=0.01 * radius)
    mass = 1000.0 * np.pi * radius**2 * length / 3.0
    assert link.inertia.mass == pytest.approx(mass, rel=0.01)
    # The centre of mass is at a quarter of the height above the base.
    assert link.inertia.lever == pytest.approx([1.0, 0.0, -length / 4.0], abs=1e-6)
