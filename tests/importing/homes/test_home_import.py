from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.downloads import SDF
from helpers.homes import HOME_MJCF, PLACES, WALLS, home_urdf

import vkc_pin as vkc
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import START_CLEARANCE

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*movable links overlap other shapes"
)  # cups in their table, as in real homes


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> vkc.importing.ImportedHome:
    folder = tmp_path_factory.mktemp("home")
    file, _ = home_urdf(folder)
    return vkc.importing.import_home(file, folder / "out")


def test_every_shape_of_the_file_is_imported(
    home: vkc.importing.ImportedHome, tmp_path: Path
) -> None:
    _, shapes = home_urdf(tmp_path)
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
    assert colliding == home.shapes["objects"]  # none of them is a mesh
    sofa = [
        shape
        for shape, label in zip(scene.obstacles, scene.obstacle_labels, strict=True)
        if label == "sofa"
    ]
    assert len(sofa) == 2, "a concave mesh, whose hull would fill the space above the seat"
    assert len(scene.obstacles) == home.shapes["obstacles"] + 2  # with the floor


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
        there = vkc.Scene.from_document(document)
        boxes = [
            np.array(
                [
                    compute_world_box(shape.geometry, shape.placement)
                    for shape in make_world_shapes(one)
                ]
            )
            for one in (scene.objects[name], there.objects["it"])
        ]
        assert np.allclose(np.sort(boxes[0], axis=0), np.sort(boxes[1], axis=0), atol=1e-5), kind
        own, other = scene.objects[name].object, there.objects["it"].object
        assert np.allclose(own.upper - own.lower, other.upper - other.lower)
    assert scene.objects["cup_0"].placement.translation == pytest.approx([0.25, 0.2, 0.749])
    assert [name for name, placed in scene.objects.items() if placed.object.free] == [
        "cup_0",
        "cup_1",
        "lump",
    ]


def test_start_is_free_and_reaches_most_objects(home: vkc.importing.ImportedHome) -> None:
    assert home.scene.start_clearance() >= START_CLEARANCE
    assert home.scene.start[1] < 2.9  # the bedroom has the lump alone, which no hand can grasp
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
    for name in ("refrigerator_body", "drawers_case", "dishwasher_body", "door_frame", "cup_0"):
        plan = vkc.plan(home.scene, [steps[name]])
        assert plan.success, plan.summary()
        assert vkc.validate(home.scene, [steps[name]], plan.trajectory).ok
        for joint, value in getattr(steps[name], "joints", {}).items():
            assert plan.trajectory.column(f"{name}.{joint}")[-1] == pytest.approx(value, abs=1e-3)


def test_mjcf_home_is_imported(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    done = vkc.importing.import_home(tmp_path / "small.xml", tmp_path / "out")
    assert done.shapes == {"file": 9, "obstacles": 5, "objects": 4, "floor": 0}
    assert set(done.scene.obstacle_names) == {"north", "south", "east", "west", "board"}
    assert {name: placed.object.free for name, placed in done.scene.objects.items()} == {
        "cupboard": False,
        "mug": True,
    }
    assert any("'ground'" in note and "plane" in note for note in done.notes)
    assert done.scene.objects["mug"].placement.translation == pytest.approx([0.0, 2.3, 0.7])
    steps = vkc.procedural.goals(done.scene)
    assert len(steps) == 2
    for step in steps:
        plan = vkc.plan(done.scene, [step])
        assert plan.success, plan.summary()


def test_floor_height_is_respected(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(
        HOME_MJCF.replace("<worldbody>", '<worldbody><body name="storey" pos="0 0 2.8">')
        .replace("</worldbody>", "</body></worldbody>")
        .replace("<freejoint/>", "")
        .replace('type="plane" size="5 5 0.1"', 'type="box" size="3 3 0.1" pos="0 0 -0.1"')
    )
    done = vkc.importing.import_home(tmp_path / "small.xml", tmp_path / "out", floor=2.8)
    assert done.shapes["floor"] == 1
    assert "cupboard" in done.scene.objects
    low = min(
        compute_world_box(shape.geometry, shape.placement)[0][2]
        for shape in make_world_shapes(done.scene.objects["cupboard"])
    )
    assert low == pytest.approx(0.0, abs=1e-6)


def test_invalid_homes_and_arguments_are_refused(tmp_path: Path) -> None:
    still = tmp_path / "still.urdf"
    still.write_text(
        '<robot name="s"><link name="a"><collision><geometry><box size="1 1 1"/></geometry></collision></link></robot>'
    )
    (tmp_path / "box.sdf").write_text(SDF)
    for file, wrong, word in (
        (tmp_path / "none.urdf", {}, r"none\.urdf"),
        (still, {}, r"still\.urdf.*the home has nothing movable"),
        (tmp_path / "box.sdf", {}, "URDF and MJCF only"),
        (still, {"floor": float("nan")}, "floor"),
        (still, {"most": 0}, "most"),
        (still, {"robot": "husky_ur5"}, "husky_ur5e"),
        (still, {"options": 1}, "options"),
    ):
        with pytest.raises(vkc.InputError, match=word):
            vkc.importing.import_home(file, tmp_path / "out", **wrong)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".import-home-*"))


def test_folder_is_replaced_only_with_force(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "small.xml").write_text(HOME_MJCF)
    out = tmp_path / "out"
    out.mkdir()
    (out / "letter.txt").write_text("mine")
    for force in (False, True):
        with pytest.raises(vkc.InputError, match="already exists"):
            vkc.importing.import_home(tmp_path / "small.xml", out, force=force)
    assert (out / "letter.txt").read_text() == "mine"
    (out / "letter.txt").unlink()
    first = vkc.importing.import_home(tmp_path / "small.xml", out, seed=1)
    (out / "objects" / "old").mkdir()
    (out / "objects" / "letter.txt").write_text("mine")
    with pytest.raises(vkc.InputError, match="--force"):
        vkc.importing.import_home(tmp_path / "small.xml", out)
    with pytest.raises(vkc.InputError, match=r"would delete .*got objects/letter\.txt\)"):
        vkc.importing.import_home(tmp_path / "small.xml", out, force=True)
    (out / "objects" / "letter.txt").unlink()
    again = vkc.importing.import_home(tmp_path / "small.xml", out, seed=1, force=True)
    assert np.array_equal(first.scene.start, again.scene.start), "the same seed, another start"
    assert not (out / "objects" / "old").exists()


def write_halves(file: Path, wardrobe: str, cabinet: str) -> None:
    """Write a home that a wardrobe with a tray divides in two, and a cabinet with a drawer."""

    def boxes(name: str, *parts: tuple[str, str]) -> str:
        shapes = (
            f'<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'
            for size, at in parts
        )
        return f'<link name="{name}">{"".join(shapes)}</link>'

    def joint(kind: str, parent: str, child: str, at: str, travel: float = 0.0) -> str:
        ends = f'<axis xyz="-1 0 0"/><limit lower="0" upper="{travel}"/>' if travel else ""
        links = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>'
        return f'<joint name="{child}_joint" type="{kind}">{links}{ends}</joint>'

    walls = (
        ("8 .1 2.4", "0 1.8 1.2"),
        ("8 .1 2.4", "0 -1.8 1.2"),
        (".1 4 2.4", "4 0 1.2"),
        (".1 4 2.4", "-4 0 1.2"),
    )
    parts = [
        boxes("rooms", *walls),
        boxes(wardrobe, ("0.4 3.4 0.5", "0 0 0.25"), ("0.4 3.4 1.2", "0 0 1.3")),
        boxes("tray", ("0.02 0.56 0.1", "0 0 0"), ("0.02 0.2 0.02", "-0.07 0 0")),
        boxes(cabinet, ("0.3 0.4 0.5", "0 0 0.25")),
        boxes("drawer", ("0.02 0.36 0.2", "0 0 0"), ("0.02 0.2 0.02", "-0.07 0 0")),
        joint("fixed", "rooms", wardrobe, "-1 0 0"),
        joint("prismatic", wardrobe, "tray", "-0.22 0 0.6", 0.15),
        joint("fixed", "rooms", cabinet, "3.7 -1 0"),
        joint("prismatic", cabinet, "drawer", "-0.17 0 0.4", 0.25),
    ]
    file.write_text(f'<robot name="h">{"".join(parts)}</robot>', encoding="utf-8")


@pytest.mark.parametrize(
    ("wardrobe", "cabinet", "files"),
    [
        ("wardrobe", "cabinet", ("wardrobe", "cabinet")),
        ("шкаф", "стол", ("part", "part_2")),
        ("a+b", "a b", ("a_b_2", "a_b")),
    ],
)
def test_objects_with_similar_names_stay_distinct(
    wardrobe: str, cabinet: str, files: tuple[str, str], tmp_path: Path
) -> None:
    write_halves(tmp_path / "h.urdf", wardrobe, cabinet)
    done = vkc.importing.import_home(tmp_path / "h.urdf", tmp_path / "out")
    entries = {entry["name"]: entry["type"] for entry in done.scene.document["objects"]}
    names = wardrobe, cabinet.replace(" ", "_")
    assert entries == {
        name: f"objects/{file}/{file}.yaml" for name, file in zip(names, files, strict=True)
    }
    for name, travel, low, high in (
        (names[0], 0.15, (-1.3, -1.7, 0.0), (-0.8, 1.7, 1.9)),
        (names[1], 0.25, (3.45, -1.2, 0.0), (3.85, -0.8, 0.5)),
    ):
        item = done.scene.objects[name]
        boxes = np.array(
            [
                compute_world_box(shape.geometry, shape.placement)
                for shape in make_world_shapes(item)
            ]
        )
        assert boxes[:, 0].min(axis=0) == pytest.approx(low, abs=1e-5), name
        assert boxes[:, 1].max(axis=0) == pytest.approx(high, abs=1e-5), name
        assert item.object.upper == pytest.approx([travel])
    plan = vkc.plan(
        done.scene.with_start(base=[1.0, 0.0, 0.0]), [vkc.GoTo(-2.5, 0.0)], time_limit=30
    )
    assert not plan.success
    assert plan.status == "infeasible"
    again = vkc.importing.import_home(tmp_path / "h.urdf", tmp_path / "out", force=True)
    assert again.scene.document == done.scene.document


def test_file_name_cannot_add_fields_to_the_scene(tmp_path: Path) -> None:
    file = tmp_path / "x\nfloor: false\n#\x01\udcff.urdf"
    write_halves(file, "wardrobe", "cabinet")
    done = vkc.importing.import_home(file, tmp_path / "out")
    assert done.scene.floor
    assert done.scene.name == "x_floor_false"
    head = done.file.read_text(encoding="utf-8").splitlines()[0]
    assert head == "# Made of x\\nfloor: false\\n#\\x01\\udcff.urdf by vkc-pin import-home."
