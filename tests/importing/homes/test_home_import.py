from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.homes import HOME_MJCF, PLACES, WALLS, write_home_urdf
from helpers.texts import format_box

import vkc_pin as vkc
from vkc_pin.importing.homes.home_import import find_free_start
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

# Cups penetrate their table, as in real homes.
pytestmark = pytest.mark.filterwarnings("ignore:.*movable links overlap other shapes")


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
    colliding = sum(len(each.object.collision.geometryObjects) for each in scene.objects.values())
    assert colliding == home.shapes["objects"]  # no object has meshes
    # The hull of the sofa would fill the space above its seat.
    assert scene.obstacle_labels.count("sofa") == 2
    assert len(scene.obstacles) == home.shapes["obstacles"] + 2  # one sofa piece, the floor


def compute_boxes(placed: vkc.PlacedObject) -> np.ndarray:
    """Return the sorted bounding boxes of an object's shapes in the world, shape (n, 2, 3) [m]."""
    shapes = make_world_shapes(placed)
    return np.sort([compute_world_box(shape.geometry, shape.placement) for shape in shapes], axis=0)


def test_placements_agree_with_the_file(home: vkc.importing.ImportedHome) -> None:
    scene = home.scene
    assert scene.arena == pytest.approx((-4.8, 4.8, -4.1, 6.1))
    for kind, (x, y, yaw, seed) in PLACES.items():
        (found,) = (placed for name, placed in scene.objects.items() if name.startswith(kind))
        entry = {"name": "it", "type": vkc.procedural.random_object(kind, seed), "yaw": yaw}
        document = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}}
        objects = [{**entry, "position": [x, y, 0]}]
        expected = vkc.Scene.from_document({**document, "objects": objects}).objects["it"]
        assert np.allclose(compute_boxes(found), compute_boxes(expected), atol=1e-5), kind
        ranges = [each.object.upper - each.object.lower for each in (found, expected)]
        assert np.allclose(*ranges)
    assert scene.objects["cup_0"].placement.translation == pytest.approx([0.25, 0.2, 0.749])
    free = [name for name, placed in scene.objects.items() if placed.object.free]
    assert free == ["cup_0", "cup_1", "lump"]


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
    steps = vkc.procedural.goals(home.scene)
    assert "lump" not in {getattr(step, "object", None) for step in steps}


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


def list_free_objects(home: vkc.importing.ImportedHome) -> dict[str, bool]:
    return {name: placed.object.free for name, placed in home.scene.objects.items()}


def test_mjcf_home_is_imported(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    imported = vkc.importing.import_home(tmp_path / "small.xml", tmp_path / "out")
    assert imported.shapes == {"file": 9, "obstacles": 5, "objects": 4, "floor": 0}
    assert set(imported.scene.obstacle_names) == {"north", "south", "east", "west", "board"}
    assert list_free_objects(imported) == {"cupboard": False, "mug": True}
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
    return f'<collision name="{name}"><pose>{place} 0 0 0</pose>{shape}</collision>'


def test_sdf_world_is_imported(tmp_path: Path) -> None:
    """Static models are fixed, those with joints are objects, and others are free."""
    case = format_sdf_box("0.4 0.6 0.8", "0.2 0 0.4", "case")
    front = format_sdf_box("0.02 0.56 0.3", "-0.01 0 0.5", "front")
    handle = format_sdf_box("0.02 0.2 0.02", "-0.07 0 0.5", "handle")
    wall = format_sdf_box("6 0.1 2.4", "0 2 1.2", "wall")
    cup = format_sdf_box("0.05 0.05 0.1", "0 0 0", "cup")
    (tmp_path / "flat.world").write_text(
        f"""<sdf version="1.9"><world name="flat">
        <model name="chest"><pose>2 1 0 0 0 0</pose><link name="case">{case}</link>
          <link name="front">{front}{handle}</link>
          <joint name="slide" type="prismatic"><parent>case</parent><child>front</child>
            <axis><xyz>-1 0 0</xyz><limit><lower>0</lower><upper>0.3</upper></limit></axis></joint>
        </model>
        <model name="wall"><static>1</static><link name="l">{wall}</link></model>
        <model name="cup"><pose>2.2 1 0.85 0 0 0</pose><link name="l">{cup}</link></model>
        </world></sdf>"""
    )
    imported = vkc.importing.import_home(tmp_path / "flat.world", tmp_path / "out")
    assert imported.shapes == {"file": 5, "obstacles": 1, "objects": 4, "floor": 0}
    assert list_free_objects(imported) == {"chest": False, "cup": True}
    item = imported.scene.objects["chest"].object
    assert list(item.coordinates.names) == ["slide"]
    assert {grasp.link for grasp in item.attachments.values()} == {"front"}
    assert "not static, but with joints, hence fixed in place: chest" in imported.notes
    assert "2 m of floor lie beyond the sides without walls: -x, -y, +x" in imported.notes
    assert imported.scene.objects["cup"].placement.translation == pytest.approx([2.2, 1.0, 0.8])
    # free floor on the three sides without a wall
    assert imported.scene.arena == pytest.approx((-5.0, 5.0, 0.7 - 2.0, 2.05))


def test_second_import_replaces_only_its_own_output(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    file, out = tmp_path / "upstairs.xml", tmp_path / "out"
    file.write_text(
        HOME_MJCF.replace("<worldbody>", '<worldbody><body name="storey" pos="0 0 2.8">')
        .replace("</worldbody>", "</body></worldbody>")
        .replace("<freejoint/>", "")
        .replace('type="plane" size="5 5 0.1"', 'type="box" size="3 3 0.1" pos="0 0 -0.1"')
    )
    first = vkc.importing.import_home(file, out, floor=2.8, seed=1)
    assert first.shapes["floor"] == 1
    assert compute_boxes(first.scene.objects["cupboard"])[..., 2].min() == pytest.approx(0.0)
    assert first.scene.floor
    assert first.scene.name == "upstairs"
    (out / "objects" / "old").mkdir()
    with pytest.raises(vkc.InputError, match="--force"):
        vkc.importing.import_home(file, out)
    again = vkc.importing.import_home(file, out, floor=2.8, seed=1, force=True)
    assert again.scene.document == first.scene.document
    assert not (out / "objects" / "old").exists()


def test_invalid_homes_and_arguments_are_rejected(tmp_path: Path) -> None:
    immovable = tmp_path / "still.urdf"
    immovable.write_text(f'<robot name="s"><link name="a">{format_box("1 1 1")}</link></robot>')
    for file, argument, message in (
        (tmp_path / "none.urdf", {}, r"none\.urdf"),
        (immovable, {"packages": {"p": 1}}, "packages"),
        (immovable, {"arguments": 3}, "arguments"),
        (immovable, {"floor": float("nan")}, "floor"),
        (immovable, {"most": 0}, "most"),
        (immovable, {"robot": "husky_ur5"}, "husky_ur5e"),
        (immovable, {"options": 1}, "options"),
    ):
        with pytest.raises(vkc.InputError, match=message):
            vkc.importing.import_home(file, tmp_path / "out", **argument)
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".import-home-*"))


WALL = ("0.1 4 2.4", "2 0 1.2")
TABLE = ("0.8 0.8 0.8", "1 1 0.4")
FLOOR = ("6 6 0.02", "0 0 -0.01")


def format_fixed_urdf(kind: str) -> str:
    """Format a wall and a table; the joint of the table moves it if it has a range."""
    limit = '<limit lower="0.2" upper="0.2" effort="1" velocity="1"/>'
    return (
        f'<robot name="flat"><link name="wall">{format_box(*WALL)}</link>'
        f'<link name="table">{format_box(TABLE[0])}</link><link name="frame"/>'
        f'<joint name="stands" type="{kind}"><parent link="wall"/><child link="table"/>'
        f'<origin xyz="{TABLE[1]}"/><axis xyz="0 1 0"/>{limit}</joint>'
        '<joint name="turn" type="continuous"><parent link="table"/><child link="frame"/></joint>'
        "</robot>"
    )


def format_fixed_sdf() -> str:
    models = "".join(
        f'<model name="{name}"><static>true</static><pose>{at} 0 0 0</pose><link name="l">'
        f'<collision name="{name}"><geometry><box><size>{size}</size></box></geometry></collision>'
        "</link></model>"
        for name, (size, at) in (("wall", WALL), ("table", TABLE))
    )
    return f'<sdf version="1.7"><world name="flat">{models}</world></sdf>'


def format_fixed_mjcf() -> str:
    geoms = "".join(
        f'<geom name="{name}" type="box" pos="{at}" '
        f'size="{" ".join(str(float(value) / 2.0) for value in size.split())}"/>'
        for name, (size, at) in (("wall", WALL), ("table", TABLE), ("slab", FLOOR))
    )
    return f"<mujoco><worldbody>{geoms}</worldbody></mujoco>"


FIXED = {
    "flat.sdf": format_fixed_sdf(),
    "flat.urdf": format_fixed_urdf("fixed"),
    "stuck.urdf": format_fixed_urdf("prismatic"),
    "flat.xml": format_fixed_mjcf(),
}


@pytest.mark.parametrize(("name", "text"), FIXED.items(), ids=FIXED)
def test_home_in_which_nothing_moves_has_obstacles_alone(
    name: str, text: str, tmp_path: Path
) -> None:
    if name.endswith(".xml"):
        pytest.importorskip("mujoco")
    (tmp_path / name).write_text(text)
    done = vkc.importing.import_home(tmp_path / name, tmp_path / "out")
    assert set(done.scene.obstacle_names) == {"wall", "table"}
    assert not done.scene.objects
    assert (done.objects, done.reached) == ((), 0)
    assert any("nothing moves" in note for note in done.notes)
    assert not any("mass" in note for note in done.notes)
    assert "of these objects" not in done.summary()
    x_offset = 0.2 if name == "stuck.urdf" else 0.0
    boxes = {
        label: np.array(shape.placement.translation)
        for label, shape in zip(done.scene.obstacle_labels, done.scene.obstacles, strict=True)
    }
    assert boxes["wall"] == pytest.approx([2.0, 0.0, 1.2])
    assert boxes["table"][[0, 2]] == pytest.approx([1.0, 0.4])
    assert boxes["table"][1] == pytest.approx(1.0 + x_offset)
    assert vkc.plan(done.scene, [vkc.GoTo(0.0, -2.0)]).success


def make_divided_room(drawer_x: float, **more: object) -> vkc.Scene:
    """Return a floor of 10 m × 4 m, divided by a wall, with a drawer on one side."""
    wall = {"name": "wall", "type": "box", "size": [0.1, 4.0, 2.0], "position": [0.0, 0.0, 1.0]}
    document = {
        "robot": "husky_ur5e",
        "start": {"base": [0.0, 0.0, 0.0]},
        "arena": {"x": [-6, 4], "y": [-2, 2]},
        "obstacles": [wall],
        "objects": [{"name": "drawer", "type": "drawer", "position": [drawer_x, 0.0, 0.0]}],
    }
    return vkc.Scene.from_document({**document, **more})


@pytest.mark.parametrize(("drawer_x", "side"), [(3.0, 1.0), (-2.0, -1.0)])
def test_start_is_on_the_side_of_the_reachable_object(drawer_x: float, side: float) -> None:
    scene, reached = find_free_start(make_divided_room(drawer_x), np.random.default_rng(0))
    assert np.sign(scene.start[0]) == side
    assert reached == 1
    assert scene.start_clearance() >= START_CLEARANCE


def test_missing_start_pose_is_reported() -> None:
    full = {"name": "block", "type": "box", "size": [10, 4, 2], "position": [-1, 0, 1]}
    scene, rng = make_divided_room(3.0, obstacles=[full]), np.random.default_rng(0)
    with pytest.raises(vkc.InputError, match=r"home\.xml: robot, floor: no start pose") as caught:
        find_free_start(scene, rng, Path("home.xml"))
    assert caught.value.field == "robot, floor"
