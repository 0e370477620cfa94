from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.homes import HOME_MJCF, PLACES, WALLS, write_home_urdf

import vkc_pin as vkc
from vkc_pin.importing.homes.home_import import find_free_start
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*movable links overlap other shapes"
)  # cups penetrate their table, as in real homes


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.ImportedHome:
    folder = tmp_path_factory.mktemp("home")
    file, _ = write_home_urdf(folder)
    return vkc.importing.import_home(file, folder / "out")


def test_every_shape_of_the_file_is_imported(
    home: vkc.importing.ImportedHome, tmp_path: Path
) -> None:
    _, shapes = write_home_urdf(tmp_path)
    assert home.shapes["file"] == shapes
    assert home.shapes["floor"] == 2
    assert sum(home.shapes[key] for key in ("floor", "obstacles", "objects")) == shapes
    scene = vkc.load_scene(home.file)
    assert set(WALLS) < set(scene.obstacle_names)
    assert {"table", "sofa"} < set(scene.obstacle_names)
    assert not {"slab", "carpet"} & set(scene.obstacle_names)
    colliding = sum(
        len(placed.object.collision.geometryObjects) for placed in scene.objects.values()
    )
    assert colliding == home.shapes["objects"]  # no object has meshes
    sofa = [
        shape
        for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True)
        if label == "sofa"
    ]
    assert len(sofa) == 2, "the hull of the sofa would fill the space above its seat"
    assert len(scene.obstacles) == home.shapes["obstacles"] + 2  # one sofa piece, the floor


def test_placements_agree_with_the_file(home: vkc.importing.ImportedHome) -> None:
    scene = home.scene
    assert scene.arena == pytest.approx((-4.8, 4.8, -4.1, 6.1))
    for kind in PLACES:
        (name,) = (name for name in scene.objects if name.startswith(kind))
        x, y, yaw, seed = PLACES[kind]
        document = {
            "robot": "husky_ur5e",
            "start": {"base": [0, 0, 0]},
            "objects": [
                {
                    "name": "it",
                    "type": vkc.procedural.random_object(kind, seed),
                    "position": [x, y, 0],
                    "yaw": yaw,
                }
            ],
        }
        reference = vkc.Scene.from_document(document)
        boxes = [
            np.array(
                [
                    compute_world_box(shape.geometry, shape.placement)
                    for shape in make_world_shapes(placed)
                ]
            )
            for placed in (scene.objects[name], reference.objects["it"])
        ]
        assert np.allclose(np.sort(boxes[0], axis=0), np.sort(boxes[1], axis=0), atol=1e-5), kind
        own, other = scene.objects[name].object, reference.objects["it"].object
        assert np.allclose(own.upper - own.lower, other.upper - other.lower)
    assert scene.objects["cup_0"].placement.translation == pytest.approx([0.25, 0.2, 0.749])
    assert [name for name, placed in scene.objects.items() if placed.object.free] == [
        "cup_0",
        "cup_1",
        "lump",
    ]


def test_start_is_free_and_reaches_most_objects(home: vkc.importing.ImportedHome) -> None:
    assert home.scene.start_clearance() >= START_CLEARANCE
    assert home.scene.start[1] < 2.9  # the bedroom contains only the lump, which no hand can grasp
    assert home.reached == 6
    assert home.scene.sample_start(np.random.default_rng(1)).start_clearance() >= START_CLEARANCE


def test_report_names_objects_that_no_hand_can_grasp(home: vkc.importing.ImportedHome) -> None:
    report = home.summary()
    for text in (
        "67 shapes",
        "part of it: slab, carpet",
        "lump: carried by no hand",
        "refrigerator_hinge by",
        "4 articulated objects, 3 free objects",
    ):
        assert text in report, text
    assert not home.scene.objects["lump"].object.attachments
    assert "lump" not in {
        getattr(step, "object", None) for step in vkc.procedural.goals(home.scene)
    }


def test_imported_objects_can_be_opened_and_grasped(home: vkc.importing.ImportedHome) -> None:
    steps = {
        step.object: step
        for step in vkc.procedural.goals(home.scene)
        if isinstance(step, vkc.Actuate | vkc.Grasp)
    }
    for name in ("drawers_case", "cup_0"):
        plan = vkc.plan(home.scene, [steps[name]])
        assert plan.success, plan.summary()
        assert vkc.validate(home.scene, [steps[name]], plan.trajectory).ok
        for joint, value in getattr(steps[name], "joints", {}).items():
            assert plan.trajectory.column(f"{name}.{joint}")[-1] == pytest.approx(value, abs=1e-3)


def test_mjcf_home_is_imported(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    imported = vkc.importing.import_home(tmp_path / "small.xml", tmp_path / "out")
    assert imported.shapes == {"file": 9, "obstacles": 5, "objects": 4, "floor": 0}
    assert set(imported.scene.obstacle_names) == {"north", "south", "east", "west", "board"}
    assert {name: placed.object.free for name, placed in imported.scene.objects.items()} == {
        "cupboard": False,
        "mug": True,
    }
    assert any("'ground'" in note and "plane" in note for note in imported.notes)
    assert imported.scene.objects["mug"].placement.translation == pytest.approx([0.0, 2.3, 0.7])
    assert len(vkc.procedural.goals(imported.scene)) == 2
    assert "floor at another height" not in imported.summary()


def test_report_names_objects_above_the_hand(tmp_path: Path) -> None:
    """The floor is 1.5 m too low; the cupboard's bar is 0.4 m above the right one."""
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    imported = vkc.importing.import_home(tmp_path / "small.xml", tmp_path / "out", floor=-1.5)
    (note,) = [note for note in imported.notes if "floor at another height" in note]
    found = re.search(r"reaches (\S+) m high: cupboard \((\S+) m\), mug \((\S+) m\);", note)
    assert found, note
    assert 1.5 < float(found[1]) < 1.9
    assert float(found[2]) == 1.9


def format_sdf_box(size: str, place: str, name: str) -> str:
    shape = f"<geometry><box><size>{size}</size></box></geometry>"
    collision = f'<collision name="c"><pose>{place} 0 0 0</pose>{shape}</collision>'
    return f'<link name="{name}">{collision}</link>'


def test_sdf_world_is_imported(tmp_path: Path) -> None:
    """Static models are fixed, those with joints are objects, and others are free."""
    chest = (
        '<sdf version="1.9"><model name="chest">'
        + format_sdf_box("0.4 0.6 0.8", "0.2 0 0.4", "case")
        + format_sdf_box("0.02 0.56 0.3", "-0.01 0 0.5", "front").replace(
            "</link>",
            '<collision name="handle"><pose>-0.07 0 0.5 0 0 0</pose><geometry><box>'
            "<size>0.02 0.2 0.02</size></box></geometry></collision></link>",
        )
        + '<joint name="slide" type="prismatic"><parent>case</parent><child>front</child>'
        "<axis><xyz>-1 0 0</xyz><limit><lower>0</lower><upper>0.3</upper></limit></axis></joint>"
        "</model></sdf>"
    )
    (tmp_path / "chest").mkdir()
    (tmp_path / "chest" / "model.sdf").write_text(chest)
    cup = '<link name="l"><collision name="c"><geometry><cylinder><radius>0.03</radius>'
    cup += "<length>0.1</length></cylinder></geometry></collision></link>"
    (tmp_path / "flat.world").write_text(
        '<sdf version="1.9"><world name="flat">'
        "<include><uri>model://chest</uri><pose>2 1 0 0 0 0</pose></include>"
        "<include><uri>model://chest</uri><name>other</name><pose>2 -1 0 0 0 0</pose></include>"
        '<model name="wall"><static>1</static>'
        f"{format_sdf_box('6 0.1 2.4', '0 2 1.2', 'l')}</model>"
        f'<model name="cup"><pose>2.2 1 0.85 0 0 0</pose>{cup}</model></world></sdf>'
    )
    imported = vkc.importing.import_home(tmp_path / "flat.world", tmp_path / "out")
    assert imported.shapes == {"file": 8, "obstacles": 1, "objects": 7, "floor": 0}
    assert {name: placed.object.free for name, placed in imported.scene.objects.items()} == {
        "chest": False,
        "other": False,
        "cup": True,
    }
    for name in ("chest", "other"):
        item = imported.scene.objects[name].object
        assert list(item.coordinates.names) == ["slide"]
        assert {grasp.link for grasp in item.attachments.values()} == {"front"}
    assert "not static, but with joints, hence fixed in place: chest, other" in imported.notes
    assert "2 m of floor lie beyond the sides without walls: -x, -y, +x" in imported.notes
    assert imported.scene.objects["cup"].placement.translation == pytest.approx([2.2, 1.0, 0.8])
    # free floor on the three sides without a wall
    assert imported.scene.arena == pytest.approx((-5.0, 5.0, -1.3 - 2.0, 2.05))


def test_xacro_home_is_imported(tmp_path: Path) -> None:
    pytest.importorskip("xacro")
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.4, 0.6, 0.8)).export(tmp_path / "parts" / "meshes" / "case.stl")
    (tmp_path / "flat.urdf.xacro").write_text(
        """<robot name="flat" xmlns:xacro="http://www.ros.org/wiki/xacro">
        <xacro:arg name="depth" default="0.3"/>
        <xacro:macro name="chest" params="name x"><link name="${name}"><collision>
          <origin xyz="0 0 0.4"/><geometry><mesh filename="package://furniture/meshes/case.stl"/>
          </geometry></collision></link>
          <joint name="${name}_stands" type="fixed"><parent link="rooms"/><child link="${name}"/>
            <origin xyz="${x} 0 0"/></joint>
          <link name="${name}_front"><collision><geometry><box size="0.02 0.56 0.3"/></geometry>
            </collision><collision><origin xyz="-0.07 0 0"/><geometry><box size="0.02 0.2 0.02"/>
            </geometry></collision></link>
          <joint name="${name}_slide" type="prismatic"><parent link="${name}"/>
            <child link="${name}_front"/><origin xyz="-0.22 0 0.5"/><axis xyz="-1 0 0"/>
            <limit lower="0" upper="$(arg depth)"/></joint></xacro:macro>
        <link name="rooms"/>
        <xacro:chest name="left" x="${-1}"/><xacro:chest name="right" x="${1+1}"/>
        </robot>"""
    )
    imported = vkc.importing.import_home(
        tmp_path / "flat.urdf.xacro",
        tmp_path / "out",
        packages={"furniture": tmp_path / "parts"},
        arguments={"depth": "0.25"},
    )
    assert list(imported.scene.objects) == ["left", "right"]
    assert imported.scene.objects["right"].object.upper == pytest.approx([0.25])
    assert imported.scene.arena == pytest.approx((-1.3 - 2.0, 2.2 + 2.0, -2.3, 2.3))


def test_second_import_replaces_only_its_own_output(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    file, out = tmp_path / "x\nfloor: false\n#\x01.xml", tmp_path / "out"
    file.write_text(
        HOME_MJCF.replace("<worldbody>", '<worldbody><body name="storey" pos="0 0 2.8">')
        .replace("</worldbody>", "</body></worldbody>")
        .replace("<freejoint/>", "")
        .replace('type="plane" size="5 5 0.1"', 'type="box" size="3 3 0.1" pos="0 0 -0.1"')
    )
    first = vkc.importing.import_home(file, out, floor=2.8, seed=1)
    assert first.shapes["floor"] == 1
    shapes = make_world_shapes(first.scene.objects["cupboard"])
    low = min(compute_world_box(shape.geometry, shape.placement)[0][2] for shape in shapes)
    assert low == pytest.approx(0.0, abs=1e-6)
    assert first.scene.floor
    assert first.scene.name == "x_floor_false"
    head = first.file.read_text(encoding="utf-8").splitlines()[0]
    assert head == "# Made of x\\nfloor: false\\n#\\x01.xml by vkc-pin import-home."
    (out / "objects" / "old").mkdir()
    with pytest.raises(vkc.InputError, match="--force"):
        vkc.importing.import_home(file, out)
    again = vkc.importing.import_home(file, out, floor=2.8, seed=1, force=True)
    assert again.scene.document == first.scene.document
    assert not (out / "objects" / "old").exists()
    (out / "objects" / "letter.txt").write_text("mine")
    with pytest.raises(vkc.InputError, match=r"would delete .*got objects/letter\.txt\)"):
        vkc.importing.import_home(file, out, force=True)


def test_invalid_homes_and_arguments_are_rejected(tmp_path: Path) -> None:
    immovable = tmp_path / "still.urdf"
    immovable.write_text(
        '<robot name="s"><link name="a"><collision><geometry><box size="1 1 1"/></geometry>'
        "</collision></link></robot>"
    )
    for file, argument, message in (
        (tmp_path / "none.urdf", {}, r"none\.urdf"),
        (immovable, {}, r"still\.urdf.*the home has nothing movable"),
        (immovable, {"packages": {"p": 1}}, "packages"),
        (immovable, {"floor": float("nan")}, "floor"),
        (immovable, {"most": 0}, "most"),
        (immovable, {"robot": "husky_ur5"}, "husky_ur5e"),
        (immovable, {"options": 1}, "options"),
    ):
        with pytest.raises(vkc.InputError, match=message):
            vkc.importing.import_home(file, tmp_path / "out", **argument)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".import-home-*"))


def make_divided_room(drawer_x: float, **more: object) -> vkc.Scene:
    """Return a floor of 10 m × 4 m, divided by a wall, with a drawer on one side."""
    return vkc.Scene.from_document(
        {
            "robot": "husky_ur5e",
            "start": {"base": [0.0, 0.0, 0.0]},
            "arena": {"x": [-6, 4], "y": [-2, 2]},
            "obstacles": [
                {
                    "name": "wall",
                    "type": "box",
                    "size": [0.1, 4.0, 2.0],
                    "position": [0.0, 0.0, 1.0],
                }
            ],
            "objects": [{"name": "drawer", "type": "drawer", "position": [drawer_x, 0.0, 0.0]}],
            **more,
        }
    )


@pytest.mark.parametrize(("drawer_x", "side"), [(3.0, 1.0), (-2.0, -1.0)])
def test_start_is_on_the_side_of_the_reachable_object(drawer_x: float, side: float) -> None:
    scene, reached = find_free_start(make_divided_room(drawer_x), np.random.default_rng(0))
    assert np.sign(scene.start[0]) == side
    assert reached == 1
    assert scene.start_clearance() >= START_CLEARANCE


def test_missing_start_pose_is_reported() -> None:
    full = [
        {"name": "block", "type": "box", "size": [10.0, 4.0, 2.0], "position": [-1.0, 0.0, 1.0]}
    ]
    with pytest.raises(vkc.InputError, match=r"home\.xml: robot, floor: no start pose") as caught:
        find_free_start(
            make_divided_room(3.0, obstacles=full), np.random.default_rng(0), Path("home.xml")
        )
    assert caught.value.field == "robot, floor"
