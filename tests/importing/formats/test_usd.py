"""Tests the reader of USD against usd-core's own transforms, physics parser and masses."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import trimesh

pytest.importorskip("pxr")
from helpers.arm_urdf import write_arms
from helpers.homes import HOME_MJCF
from helpers.usd_stages import (
    UP,
    add_body,
    add_box,
    add_joint,
    add_mesh,
    compute_corners,
    create_stage,
    make_quaternion,
    place_bodies,
    set_matrix,
    write_description,
)
from pxr import Gf, Sdf, UsdGeom, UsdPhysics, UsdShade, Vt

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.importing.description import MOVING_KINDS, Description, Part
from vkc_pin.importing.formats.reading import read_description
from vkc_pin.importing.robots.sources import read_source
from vkc_pin.utils import optional_imports

UNITS = [(1.0, "Z", 1.0), (0.01, "Y", 1.0), (0.001, "Z", 0.001), (2.54, "Y", 0.45)]
CABINET = Path(__file__).parents[3] / "scenes" / "objects" / "cabinet.urdf"
ROBOT = Path(__file__).parents[2] / "fuzz" / "inputs" / "robot.urdf"


def read(stage: Any) -> Description:
    stage.Save()
    return read_description(stage.GetRootLayer().realPath)


def read_text(folder: Path, text: str) -> Description:
    file = folder / "t.usda"
    file.write_text('#usda 1.0\n(metersPerUnit = 1\nupAxis = "Z")\n' + text)
    return read_description(file)


def has_note(found: Description, *words: str) -> bool:
    return any(all(word in note for word in words) for note in found.notes)


def get_vertices(part: Part) -> np.ndarray:
    return np.asarray(part.make_mesh().vertices)


def measure_distance(one: np.ndarray, other: np.ndarray) -> float:
    """Return the Hausdorff distance of two sets of points."""
    distances = np.linalg.norm(one[:, None] - other[None], axis=-1)
    return float(max(distances.min(axis=0).max(), distances.min(axis=1).max()))


# Kinematics


def draw_rotation(rng: np.random.Generator) -> np.ndarray:
    return np.asarray(pin.exp3(rng.uniform(-2.0, 2.0, 3)))


def draw_frame(rng: np.random.Generator, size: float) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = draw_rotation(rng)
    frame[:3, 3] = rng.uniform(-size, size, 3)
    return frame


class RandomJoint:
    """A joint with random frames in two bodies, at a random position.

    Attributes:
        frames: Frame of the joint in the body that carries, and in the other one, (4, 4) each.
        is_reversed: Whether `body1` carries.
    """

    def __init__(self, rng: np.random.Generator, length: float) -> None:
        self.frames = (draw_frame(rng, length), draw_frame(rng, length))
        self.kind = str(rng.choice(["Revolute", "Prismatic", "Fixed"]))
        self.axis = str(rng.choice(["X", "Y", "Z"]))
        self.limits = (rng.uniform(-100.0, 0.0), rng.uniform(0.0, 100.0))
        self.is_reversed = rng.random() < 0.5
        self.value = rng.uniform(*self.limits)

    def place(self, carrying: np.ndarray) -> np.ndarray:
        """Return the pose of the other body."""
        direction = np.eye(3)["XYZ".index(self.axis)]
        motion = np.eye(4)
        if self.kind == "Revolute":
            motion[:3, :3] = pin.exp3(np.radians(self.value) * direction)
        elif self.kind == "Prismatic":
            motion[:3, 3] = self.value * direction
        if self.is_reversed:
            motion = np.linalg.inv(motion)
        first, second = self.frames
        return carrying @ first @ motion @ np.linalg.inv(second)

    def write(self, stage: Any, path: str, bodies: tuple[str, str], scales: Any) -> None:
        """Add the joint of the bodies that carry and are carried."""
        sides = list(zip(bodies, self.frames, scales, strict=True))
        if self.is_reversed:
            sides.reverse()
        (body0, frame0, scale0), (body1, frame1, scale1) = sides
        ends = {"at0": frame0[:3, 3] / scale0, "at1": frame1[:3, 3] / scale1}
        joint = add_joint(
            stage, path, self.kind, body0, body1, axis=self.axis, limits=self.limits, **ends
        )
        joint.CreateLocalRot0Attr(make_quaternion(frame0[:3, :3]))
        joint.CreateLocalRot1Attr(make_quaternion(frame1[:3, :3]))


def write_random_tree(file: Path, seed: int) -> tuple[str, dict[str, tuple[float, float]]]:
    """Write bodies with random frames and scales; return the root and the joints' limits.

    Bodies may be nested, either side of a joint may carry the other, and the bodies are where the
    joints have them at a random position.
    """
    rng = np.random.default_rng(seed)
    metres, up, kilograms = UNITS[seed % len(UNITS)]
    length = 0.5 / metres
    stage = create_stage(file, metres=metres, up=up, kilograms=kilograms)
    world = draw_frame(rng, length)
    world[:3, :3] *= rng.uniform(0.5, 2.0)
    set_matrix(UsdGeom.Xform.Define(stage, "/World"), world)
    matrices = {"/World": world}
    poses = dict[str, np.ndarray]()
    scales = dict[str, np.ndarray]()
    limits = dict[str, tuple[float, float]]()
    for number in range(5):
        is_uniform = rng.random() < 0.5
        scale = np.full(3, rng.uniform(0.5, 2.0)) if is_uniform else rng.uniform(0.5, 2.0, 3)
        carrying = str(rng.choice(list(poses))) if poses else "/World"
        joint = RandomJoint(rng, length)
        pose = joint.place(poses[carrying]) if poses else draw_frame(rng, length)
        # Under a body with one scale for all axes, frames are not sheared.
        can_hold = carrying in scales and np.ptp(scales[carrying]) == 0.0
        parent = carrying if can_hold and rng.random() < 0.5 else "/World"
        path = f"{parent}/body_{number}"
        matrix = pose @ np.diag([*scale, 1.0])
        add_body(stage, path, np.linalg.inv(matrices[parent]) @ matrix)
        size = length * rng.uniform(0.1, 0.5, 3)
        add_box(stage, f"{path}/box", size, length * rng.uniform(-0.5, 0.5, 3))
        if poses:
            name = f"/World/joint_{number}"
            joint.write(stage, name, (carrying, path), (scales[carrying], scale))
            if joint.kind != "Fixed":
                limits[name] = joint.limits
        poses[path] = pose
        scales[path] = scale
        matrices[path] = matrix
    (root, *_) = poses
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath(root))
    stage.Save()
    return root, limits


@pytest.mark.parametrize("seed", range(16))
def test_random_trees_move_as_usd_core_says(tmp_path: Path, seed: int) -> None:
    """Corners of boxes at random positions of the joints."""
    file = tmp_path / "t.usdc"
    root, limits = write_random_tree(file, seed)
    found = read_description(file)
    assert not has_note(found, "beside")
    metres, _, _ = UNITS[seed % len(UNITS)]
    rng = np.random.default_rng(seed + 1000)
    units = dict[str, float]()
    for joint in found.joints.values():
        units[joint.name] = metres if joint.kind == "prismatic" else math.radians(1.0)
    by_name = {joint.name: joint for joint in found.joints.values()}
    for path, (low, high) in limits.items():
        name = path.rpartition("/")[2]
        assert by_name[name].limits == pytest.approx(np.array([low, high]) * units[name], rel=1e-5)
    for _ in range(3):
        values = {path: float(rng.uniform(*ends)) for path, ends in limits.items()}
        motions = place_bodies(file, root, values)
        names = {path: path.rpartition("/")[2] for path in (*values, *motions)}
        positions = {names[path]: value * units[names[path]] for path, value in values.items()}
        placements = found.compute_placements(positions)
        for path, motion in motions.items():
            corners = compute_corners(file, f"{path}/box")
            expected = corners @ motion[:3, :3].T + motion[:3, 3]
            (part,) = found.links[names[path]].collision
            got = get_vertices(part.transform(placements[names[path]]))
            assert measure_distance(got, expected) < 2e-5


@pytest.mark.parametrize("seed", range(16))
def test_positions_in_the_file_are_a_state(tmp_path: Path, seed: int) -> None:
    """At these, links are where usd-core has the bodies."""
    file = tmp_path / "t.usda"
    root, _ = write_random_tree(file, seed)
    found = read_description(file)
    placements = found.compute_placements(found.states.get("stage"))
    for path in place_bodies(file, root, {}):
        name = path.rpartition("/")[2]
        (part,) = found.links[name].collision
        got = get_vertices(part.transform(placements[name]))
        assert measure_distance(got, compute_corners(file, f"{path}/box")) < 1e-4


@pytest.mark.parametrize(("metres", "up", "kilograms"), UNITS)
@pytest.mark.parametrize("kind", ["object", "robot", "home"])
def test_round_trip_keeps_kinematics_shapes_and_masses(
    tmp_path: Path, kind: str, metres: float, up: str, kilograms: float
) -> None:
    source = {"object": CABINET, "robot": ROBOT, "home": tmp_path / "home.xml"}[kind]
    if kind == "home":
        source.write_text(HOME_MJCF)
    elif kind == "robot":
        box = trimesh.creation.box((0.05, 0.05, 0.2))
        for suffix in ("stl", "obj"):
            box.export(tmp_path / f"part.{suffix}")
        (tmp_path / "robot.urdf").write_bytes(ROBOT.read_bytes())
        source = tmp_path / "robot.urdf"
    original = read_description(source)
    file = tmp_path / "t.usdc"
    write_description(original, file, metres=metres, up=up, kilograms=kilograms)
    found = read_description(file)
    rng = np.random.default_rng(0)
    moving = [joint for joint in original.joints.values() if joint.kind in MOVING_KINDS]
    values = {joint.name: rng.uniform(-1.0, 1.0) for joint in moving}
    moved = {f"joint_{name}": value for name, value in values.items()}
    expected = original.compute_placements(values)
    placements = found.compute_placements(moved)
    root = original.root
    for name, link in original.links.items():
        other = found.links[name]
        offset = placements[root].actInv(placements[name])
        in_root = expected[root].actInv(expected[name])
        assert np.allclose(offset.homogeneous, in_root.homogeneous, atol=1e-5)
        # A body without a mass weighs what its colliders do.
        if link.inertia.mass > 0.0:
            assert other.inertia.mass == pytest.approx(link.inertia.mass, rel=1e-5)
            assert np.allclose(other.inertia.inertia, link.inertia.inertia, rtol=1e-4, atol=1e-7)
            assert np.allclose(other.inertia.lever, link.inertia.lever, atol=1e-5)
        assert len(other.collision) == len(link.collision)
        for one, two in zip(link.collision, other.collision, strict=True):
            assert one.kind == two.kind
            if one.kind == "mesh":
                assert measure_distance(get_vertices(one), get_vertices(two)) < 1e-5
            else:
                assert two.size == pytest.approx(one.size, rel=1e-5)
    by_name = {joint.name: joint for joint in found.joints.values()}
    for joint in moving:
        if joint.kind != "continuous":
            read_back = by_name[f"joint_{joint.name}"]
            limits = joint.limits or (-math.inf, math.inf)
            assert read_back.kind == joint.kind
            assert read_back.limits == pytest.approx(limits, rel=1e-5, abs=1e-6)
            assert read_back.effort == (joint.effort and pytest.approx(joint.effort, rel=1e-5))
            assert read_back.is_driven == (joint.effort is not None)


# Joints


def make_pair(folder: Path, **options: Any) -> Any:
    """Return a stage with bodies /a and /b, 1 m apart, and a static prim /s at 2 m, turned."""
    stage = create_stage(folder / "t.usda", **options)
    for name, x in (("a", 0.0), ("b", 1.0)):
        add_body(stage, f"/{name}", pin.SE3(np.eye(3), np.array([x, 0.0, 0.0])).homogeneous)
        add_box(stage, f"/{name}/box", (0.1, 0.2, 0.3))
    static = UsdGeom.Xform.Define(stage, "/s")
    quarter = pin.exp3(np.array([0.0, 0.0, math.pi / 2.0]))
    set_matrix(static, pin.SE3(quarter, np.array([2.0, 0.0, 0.0])).homogeneous)
    return stage


@pytest.mark.parametrize(
    ("kind", "limits", "expected"),
    [
        ("Revolute", (-90.0, 90.0), (-math.pi / 2.0, math.pi / 2.0)),
        ("Revolute", (None, None), (-math.inf, math.inf)),
        ("Revolute", (None, 90.0), (-math.inf, math.pi / 2.0)),
        ("Revolute", (-90.0, None), (-math.pi / 2.0, math.inf)),
        ("Revolute", (-1e38, 90.0), (-math.inf, math.pi / 2.0)),
        ("Revolute", (5.0, 5.0), (math.radians(5.0), math.radians(5.0))),
        ("Prismatic", (-50.0, 20.0), (-0.5, 0.2)),
        ("Prismatic", (None, 20.0), (-math.inf, 0.2)),
        ("Revolute", (10.0, -10.0), None),
        ("Prismatic", (1.0, 0.5), None),
    ],
)
def test_limits(
    tmp_path: Path, kind: str, limits: Any, expected: tuple[float, float] | None
) -> None:
    """Missing ones are infinite; a lower limit above the upper one locks the joint."""
    stage = make_pair(tmp_path, metres=0.01)
    add_joint(stage, "/j", kind, "/a", "/b", at0=(1.0, 0.0, 0.0), limits=limits)
    found = read(stage)
    joint = found.joints["b"]
    if expected is None:
        assert joint.kind == "fixed"
        assert has_note(found, "/j", "locked")
    else:
        assert joint.kind == kind.lower()
        assert joint.limits == pytest.approx(expected)


LOCKED = (1.0, -1.0)


@pytest.mark.parametrize(
    ("free", "kind", "axis"),
    [
        ({}, "fixed", None),
        ({"rotY": (-90.0, 45.0)}, "revolute", [0.0, 1.0, 0.0]),
        ({"transZ": (-0.1, 0.3)}, "prismatic", [0.0, 0.0, 1.0]),
        ({"rotX": None}, "revolute", [1.0, 0.0, 0.0]),
        ({"rotX": None, "rotY": (0.0, 1.0)}, "fixed", None),
    ],
)
def test_generic_joints_with_one_free_axis_are_hinges_and_slides(
    tmp_path: Path, free: dict[str, Any], kind: str, axis: list[float] | None
) -> None:
    stage = make_pair(tmp_path)
    joint = add_joint(stage, "/j", "", "/a", "/b", at0=(1.0, 0.0, 0.0)).GetPrim()
    for name in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ"):
        limits = free.get(name, LOCKED)
        if limits is not None:
            limit = UsdPhysics.LimitAPI.Apply(joint, name)
            limit.CreateLowAttr(limits[0])
            limit.CreateHighAttr(limits[1])
    for name in free:
        UsdPhysics.DriveAPI.Apply(joint, name).CreateMaxForceAttr(7.0)
    found = read(stage)
    got = found.joints["b"]
    assert got.kind == kind
    assert has_note(found, "/j is free about rotX, rotY: taken as fixed") == (len(free) > 1)
    if axis is not None:
        assert np.allclose(got.axis, axis)
        (limits,) = free.values()
        unit = math.radians(1.0) if kind == "revolute" else 1.0
        low, high = limits or (-math.inf, math.inf)
        assert got.limits == pytest.approx((low * unit, high * unit))
        assert (got.effort, got.is_driven) == (7.0, True)


@pytest.mark.parametrize("kind", ["Spherical", "Distance", "", "Fixed"])
def test_joints_that_a_description_lacks_are_noted(tmp_path: Path, kind: str) -> None:
    stage = make_pair(tmp_path)
    add_joint(stage, "/j", kind, "/a", "/b", at0=(1.0, 0.0, 0.0))
    found = read(stage)
    note, joint_kind = {
        "Spherical": ("joint /j is spherical: taken as fixed", "fixed"),
        "Distance": ("joint /j limits a distance only: left out", "floating"),
        "": ("joint /j leaves all axes free: left out", "floating"),
        "Fixed": (None, "fixed"),
    }[kind]
    assert found.joints["b"].kind == joint_kind
    assert note is None or has_note(found, note)


def test_foreign_joints_and_tendons_are_noted(tmp_path: Path) -> None:
    stage = make_pair(tmp_path)
    stage.DefinePrim("/gear", "PhysxPhysicsGearJoint")
    joint = add_joint(stage, "/j", "Revolute", "/a", "/b", at0=(1.0, 0.0, 0.0)).GetPrim()
    schemas = Sdf.TokenListOp.CreateExplicit(["PhysxTendonAxisRootAPI:t"])
    joint.SetMetadata("apiSchemas", schemas)
    disabled = add_joint(stage, "/off", "Fixed", None, "/b")
    disabled.CreateJointEnabledAttr(False)
    add_joint(stage, "/same", "Fixed", "/a", "/a/box")
    found = read(stage)
    assert has_note(found, "PhysxPhysicsGearJoint are left out: /gear")
    assert has_note(found, "tendons are left out: /j")
    assert has_note(found, "disabled joints are left out: /off")
    assert has_note(found, "connect nothing", "/same")


def test_joints_without_a_body_are_in_the_frame_of_the_stage(tmp_path: Path) -> None:
    """Not in that of the joint's parent, which may be moved; and y is up, in centimetres."""
    stage = create_stage(tmp_path / "t.usda", metres=0.01, up="Y")
    set_matrix(UsdGeom.Xform.Define(stage, "/World"), np.diag([2.0, 2.0, 2.0, 1.0]))
    add_body(stage, "/World/a", pin.SE3(np.eye(3), np.array([50.0, 10.0, 0.0])).homogeneous)
    add_box(stage, "/World/a/box", (10.0, 10.0, 10.0))
    add_joint(
        stage,
        "/World/j",
        "Revolute",
        None,
        "/World/a",
        at0=(100.0, 20.0, 30.0),
        at1=(0.0, 0.0, 15.0),
        axis="Y",
        limits=(0.0, 90.0),
    )
    found = read(stage)
    joint = found.joints["a"]
    assert (joint.parent, joint.kind) == ("world", "revolute")
    assert np.allclose(joint.placement.translation, [1.0, -0.3, 0.2], atol=1e-6)
    turned = found.compute_placements({"j": math.pi / 2.0})["a"]
    assert np.allclose(turned.rotation @ joint.axis, [0.0, 0.0, 1.0], atol=1e-6)
    assert found.links["a"].collision[0].size == pytest.approx((0.2, 0.2, 0.2))
    centre = turned.act(found.links["a"].collision[0].placement.translation)
    # From (0, 0.3) about the hinge to (-0.3, 0)
    assert np.allclose(centre, [0.7, -0.3, 0.2], atol=1e-6)


def test_static_prims_carry_joints_where_they_are(tmp_path: Path) -> None:
    stage = make_pair(tmp_path)
    add_joint(stage, "/j", "Revolute", "/s", "/b", at0=(0.0, 1.0, 0.0), axis="Z")
    found = read(stage)
    assert np.allclose(found.joints["b"].placement.translation, [1.0, 0.0, 0.0], atol=1e-6)
    # The bodies are a quarter turn behind the joint.
    assert found.states["stage"]["j"] == pytest.approx(-math.pi / 2.0)


def test_assets_that_are_placed_elsewhere_stay_there(tmp_path: Path) -> None:
    """A fixed joint to the world keeps the frame in it that the asset was made with."""
    asset = create_stage(tmp_path / "asset.usda")
    root = UsdGeom.Xform.Define(asset, "/chest")
    asset.SetDefaultPrim(root.GetPrim())
    for name, x in (("case", 0.0), ("front", -0.2)):
        add_body(asset, f"/chest/{name}", pin.SE3(np.eye(3), np.array([x, 0, 0.4])).homogeneous)
        add_box(asset, f"/chest/{name}/box", (0.1, 0.4, 0.4))
    add_joint(asset, "/chest/stands", "Fixed", None, "/chest/case", at0=(0.0, 0.0, 0.4))
    add_joint(
        asset,
        "/chest/slide",
        "Prismatic",
        "/chest/case",
        "/chest/front",
        at0=(-0.2, 0.0, 0.0),
        limits=(-0.3, 0.0),
    )
    asset.Save()
    stage = create_stage(tmp_path / "t.usda")
    for number in range(3):
        place = UsdGeom.Xform.Define(stage, f"/home/chest_{number}")
        set_matrix(place, pin.SE3(np.eye(3), np.array([0.0, number, 0.0])).homogeneous)
        place.GetPrim().GetReferences().AddReference("./asset.usda")
        place.GetPrim().SetInstanceable(number > 0)
    found = read(stage)
    placements = found.compute_placements()
    assert len(found.links) == 7
    for number in range(3):
        name = f"home/chest_{number}/front"
        assert np.allclose(placements[name].translation, [-0.2, number, 0.4], atol=1e-6)
        assert found.joints[name].parent == f"home/chest_{number}/case"
        assert found.joints[name].limits == pytest.approx((-0.3, 0.0))


def test_bodies_beside_their_joints_are_noted(tmp_path: Path) -> None:
    stage = make_pair(tmp_path)
    add_joint(stage, "/j", "Prismatic", "/a", "/b", at0=(0.0, 0.2, 0.0), axis="X")
    found = read(stage)
    assert has_note(found, "body /b is 200 mm and 0.0° beside its joint /j")
    assert found.states["stage"]["j"] == pytest.approx(1.0)


def test_excluded_joints_are_cut_where_they_close_a_loop(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    places = {"base": (0.0, 0.0), "left": (0.0, 1.0), "right": (1.0, 1.0), "top": (0.5, 2.0)}
    for name, (x, z) in places.items():
        add_body(stage, f"/{name}", pin.SE3(np.eye(3), np.array([x, 0.0, z])).homogeneous)
        add_box(stage, f"/{name}/box", (0.1, 0.1, 0.1))
    for name, ends, at0, at1 in (
        ("one", ("base", "left"), (0, 0, 0), (0, 0, -1)),
        ("two", ("base", "right"), (1, 0, 0), (0, 0, -1)),
        ("three", ("left", "top"), (0, 0, 1), (-0.5, 0, 0)),
        ("four", ("right", "top"), (0, 0, 1), (0.5, 0, 0)),
    ):
        bodies = [f"/{end}" for end in ends]
        add_joint(stage, f"/{name}", "Revolute", *bodies, at0=at0, at1=at1, axis="Y")
    stage.Save()
    message = r"joints close a loop \(expected physics:excludeFromArticulation.*/one.*/four"
    with pytest.raises(InputError, match=message) as caught:
        read(stage)
    assert caught.value.field == "/four"
    UsdPhysics.Joint.Get(stage, "/three").CreateExcludeFromArticulationAttr(True)
    found = read(stage)
    assert has_note(found, "joint /three closes a loop: cut")
    (loop,) = found.loops
    assert (loop.kind, loop.links) == ("connected", ("left", "top"))
    placements = found.compute_placements()
    for link, point in zip(loop.links, loop.points or (), strict=True):
        assert np.allclose(placements[link].act(point), [0.0, 0.0, 2.0], atol=1e-6)
    UsdPhysics.Joint.Get(stage, "/four").CreateExcludeFromArticulationAttr(True)
    both = read(stage)
    assert len(both.loops) == 1  # the other one holds the top


def test_joints_of_loops_are_at_zero_where_the_loop_is_closed(tmp_path: Path) -> None:
    stage = make_pair(tmp_path)
    add_joint(stage, "/j", "Prismatic", "/a", "/b", limits=(0.0, 1.5))
    weld = add_joint(stage, "/weld", "Fixed", "/a", "/b", at0=(1.0, 0.0, 0.0))
    weld.CreateExcludeFromArticulationAttr(True)
    found = read(stage)
    assert found.joints["b"].limits == pytest.approx((-1.0, 0.5))
    assert np.allclose(found.compute_placements()["b"].translation, [1.0, 0.0, 0.0])
    assert found.loops[0].kind == "welded"
    assert has_note(found, "'j' belongs to a loop", "less by 1")
    assert not found.states


@pytest.mark.parametrize("schema", ["NewtonMimicAPI", "PhysxMimicJointAPI:rotZ"])
def test_mimic_joints_are_couplings(tmp_path: Path, schema: str) -> None:
    stage = make_pair(tmp_path, metres=0.01)
    add_joint(stage, "/turn", "Revolute", "/s", "/a", at0=(0, 2, 0), axis="Z", limits=(-90, 90))
    slide = add_joint(stage, "/slide", "Prismatic", "/a", "/b", limits=(0, 10)).GetPrim()
    slide.SetMetadata("apiSchemas", Sdf.TokenListOp.CreateExplicit([schema]))
    names = {"NewtonMimicAPI": ("newton:mimicJoint", "newton:mimicCoef0", "newton:mimicCoef1", 1)}
    prefix = "physxMimicJoint:rotZ:"
    physx = (f"{prefix}referenceJoint", f"{prefix}offset", f"{prefix}gearing", -1)
    leader, offset, factor, sign = names.get(schema, physx)
    slide.CreateRelationship(leader).SetTargets(["/turn"])
    slide.CreateAttribute(offset, Sdf.ValueTypeNames.Float).Set(sign * 2.0)
    slide.CreateAttribute(factor, Sdf.ValueTypeNames.Float).Set(sign * 0.1)
    (coupling,) = read(stage).couplings
    assert (coupling.joint, coupling.leader) == ("slide", "turn")
    # 2 cm, and 0.1 cm for each degree
    assert coupling.coefficients == pytest.approx((0.02, 0.001 * 180.0 / math.pi))


def test_drives_and_velocities_are_in_si_units(tmp_path: Path) -> None:
    stage = make_pair(tmp_path, metres=0.01, kilograms=0.001)
    turn = add_joint(stage, "/turn", "Revolute", None, "/a", axis="Z").GetPrim()
    slide = add_joint(stage, "/slide", "Prismatic", "/a", "/b").GetPrim()
    UsdPhysics.DriveAPI.Apply(turn, "angular").CreateMaxForceAttr(3e7)
    UsdPhysics.DriveAPI.Apply(slide, "linear")
    name = "physxJoint:maxJointVelocity"
    turn.CreateAttribute(name, Sdf.ValueTypeNames.Float).Set(90.0)
    slide.CreateAttribute(name, Sdf.ValueTypeNames.Float).Set(50.0)
    found = read(stage)
    assert found.joints["a"].effort == pytest.approx(3.0)  # 3e7 g cm² / s²
    assert found.joints["a"].velocity == pytest.approx(math.pi / 2.0)
    assert found.joints["b"].effort is None
    assert found.joints["b"].is_driven
    assert found.joints["b"].velocity == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("prepare", "root", "kind"),
    [
        (lambda stage: UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/b")), "b", None),
        (lambda stage: None, "a", "not"),
        (
            lambda stage: UsdPhysics.RigidBodyAPI.Get(stage, "/b").CreateKinematicEnabledAttr(True),
            "b",
            None,
        ),
    ],
)
def test_the_root_of_a_tree_is_the_stated_one(
    tmp_path: Path, prepare: Callable[[Any], Any], root: str, kind: str | None
) -> None:
    stage = make_pair(tmp_path)
    add_joint(stage, "/j", "Revolute", "/a", "/b", at0=(1.0, 0.0, 0.0), axis="Z")
    prepare(stage)
    found = read(stage)
    assert found.joints[root].parent == "world"
    assert found.joints[root].kind == "fixed"
    is_kinematic = root == "b" and not has_note(found, "fixed in place")
    assert is_kinematic or has_note(found, f"fixed in place: {root}")
    for name, x in (("a", 0.0), ("b", 1.0)):
        box = found.links[name].collision[0].transform(found.compute_placements()[name])
        assert np.allclose(box.placement.translation, [x, 0.0, 0.0], atol=1e-6)


def test_disabled_bodies_are_static(tmp_path: Path) -> None:
    stage = make_pair(tmp_path)
    UsdPhysics.RigidBodyAPI.Get(stage, "/a").CreateRigidBodyEnabledAttr(False)
    add_joint(stage, "/j", "Revolute", "/a", "/b", at0=(1.0, 0.0, 0.0), axis="Z")
    found = read(stage)
    assert list(found.links) == ["world", "b"]
    assert [part.name for part in found.links["world"].collision] == ["box"]
    assert found.joints["b"].parent == "world"


# Shapes


def make_shape(folder: Path, kind: str, values: dict[str, Any]) -> tuple[Any, Any]:
    """Return a stage with a body `/a`, and a shape of it with values of its attributes."""
    stage = create_stage(folder / "t.usda")
    add_body(stage, "/a")
    shape = getattr(UsdGeom, kind).Define(stage, "/a/s")
    for name, value in values.items():
        shape.GetPrim().GetAttribute(name).Set(value)
    return stage, shape


def get_shape(found: Description) -> Part:
    (part,) = found.links["a"].collision
    return part


@pytest.mark.parametrize(
    ("kind", "values", "scale", "expected"),
    [
        ("Cube", {}, (1, 1, 1), ("box", (2, 2, 2))),
        ("Cube", {"size": 1.0}, (1, -2, 3), ("box", (1, 2, 3))),
        ("Sphere", {}, (1, 1, 1), ("sphere", (1,))),
        ("Sphere", {"radius": 0.5}, (2, 2, 2), ("sphere", (1,))),
        ("Cylinder", {}, (1, 1, 1), ("cylinder", (1, 2))),
        ("Cylinder", {"axis": "X", "radius": 0.1}, (2, 3, 3), ("cylinder", (0.3, 4))),
        ("Capsule", {"axis": "Y", "height": 0.4}, (1, 1, 1), ("capsule", (0.5, 0.4))),
        ("Cylinder_1", {"radiusTop": 0.3, "radiusBottom": 0.3}, (1, 1, 1), ("cylinder", (0.3, 2))),
        ("Capsule_1", {"height": 0.0}, (1, 1, 1), ("capsule", (0.5, 0.0))),
    ],
)
def test_primitives_have_their_defaults_and_scales(
    tmp_path: Path, kind: str, values: dict[str, Any], scale: Any, expected: Any
) -> None:
    stage, shape = make_shape(tmp_path, kind, values)
    UsdGeom.Xformable(shape).AddScaleOp().Set(Gf.Vec3f(*map(float, scale)))
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    part = get_shape(read(stage))
    assert (part.kind, part.size) == (expected[0], pytest.approx(expected[1]))
    axis = "XYZ".index(values.get("axis", "Z"))
    assert abs(part.placement.rotation[axis, 2]) == pytest.approx(1.0) or kind == "Cube"


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize(
    ("kind", "values", "size", "volume"),
    [
        ("Sphere", {}, (2.0, 4.0, 6.0), 4.0 / 3.0 * math.pi * 6.0),
        ("Cone", {"radius": 1.0, "height": 3.0}, (2.0, 2.0, 3.0), math.pi),
        ("Cylinder_1", {"radiusBottom": 1.0, "radiusTop": 0.5}, (2, 2, 2), math.pi * 3.5 / 3.0),
        ("Cylinder", {"radius": 0.5, "height": 1.0}, (2.0, 4.0, 6.0), math.pi * 12.0),
        ("Capsule", {"radius": 0.5, "height": 1.0}, (2.0, 4.0, 12.0), 48.0 * math.pi * 5.0 / 12.0),
    ],
)
def test_other_solids_are_meshes(
    tmp_path: Path, axis: str, kind: str, values: dict[str, Any], size: Any, volume: float
) -> None:
    """Sizes are along the shape's own axes, z along its axis; meshes have less volume."""
    stage, shape = make_shape(tmp_path, kind, values)
    order = {"X": [2, 0, 1], "Y": [1, 2, 0], "Z": [0, 1, 2]}[axis]
    if kind == "Sphere":
        order = [0, 1, 2]
    else:
        shape.CreateAxisAttr(axis)
    bare = {"Capsule": (1.0, 1.0, 2.0), "Cylinder": (1.0, 1.0, 1.0), "Sphere": (2.0, 2.0, 2.0)}
    scale = np.array(size) / np.array(bare.get(kind, size))
    UsdGeom.Xformable(shape).AddScaleOp().Set(Gf.Vec3f(*map(float, scale[order])))
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
    mesh = get_shape(read(stage)).make_mesh()
    assert mesh.is_volume
    assert 0.96 * volume < mesh.volume <= volume * (1.0 + 1e-9)
    assert np.allclose(mesh.bounds[1] - mesh.bounds[0], np.array(size)[order], rtol=1e-2)
    if kind in ("Cone", "Cylinder_1"):
        along = "XYZ".index(axis)
        assert mesh.center_mass[along] < -0.1  # the thick end is below


def write_mesh(folder: Path, **settings: Any) -> Any:
    """Return a stage with a body whose collider is an L, in a scaled and turned group."""
    stage = create_stage(folder / "t.usda")
    add_body(stage, "/a")
    group = UsdGeom.Xform.Define(stage, "/a/group")
    scale = settings.get("scale", (1.0, 2.0, 0.5))
    matrix = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.5])), np.array([0.1, 0.2, 0.3])).homogeneous
    set_matrix(group, matrix @ np.diag([*scale, 1.0]))
    boxes = [trimesh.creation.box(bounds=b) for b in settings.get("boxes", BOXES)]
    prim = add_mesh(stage, "/a/group/l", trimesh.util.concatenate(boxes))
    UsdPhysics.CollisionAPI.Apply(prim)
    approximation = settings.get("approximation")
    if approximation is not None:
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(approximation)
    return stage


BOXES = ([[0.0, 0.0, 0.0], [0.2, 0.1, 0.1]], [[0.0, 0.1, 0.0], [0.1, 0.3, 0.1]])


@pytest.mark.parametrize(
    ("approximation", "kind", "volume"),
    [
        (None, "mesh", 0.004),
        ("none", "mesh", 0.004),
        ("meshSimplification", "mesh", 0.004),
        ("convexDecomposition", "mesh", 0.004),
        ("convexHull", "mesh", 0.005),
        ("boundingCube", "box", 0.006),
        ("boundingSphere", "sphere", None),
        ("sdf", "mesh", 0.004),
    ],
)
def test_approximations_of_meshes(
    tmp_path: Path, approximation: str | None, kind: str, volume: float | None
) -> None:
    stage = write_mesh(tmp_path, approximation=approximation)
    found = read(stage)
    part = get_shape(found)
    exact = found.links["a"].visual[0].make_mesh()
    assert exact.volume == pytest.approx(0.004, rel=1e-5)
    assert part.kind == kind
    mesh = part.make_mesh()
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=1e-5)
        hull = mesh.convex_hull
        heights = (exact.vertices[:, None] - hull.triangles_center) * hull.face_normals
        assert heights.sum(axis=-1).max() < 1e-6
    else:
        away = np.linalg.norm(exact.vertices - part.placement.translation, axis=1)
        assert away.max() == pytest.approx(part.size[0])
    assert has_note(found, "/a/group/l collides as 'sdf'") == (approximation == "sdf")


@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_faces_point_outward_in_mirrored_meshes(
    tmp_path: Path, mirror: float, orientation: str
) -> None:
    stage = write_mesh(tmp_path, scale=(mirror, 1.0, 1.0))
    mesh = UsdGeom.Mesh.Get(stage, "/a/group/l")
    if orientation == "leftHanded":
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)[:, ::-1]
        mesh.GetFaceVertexIndicesAttr().Set(Vt.IntArray.FromNumpy(corners.ravel()))
        mesh.CreateOrientationAttr(orientation)
    assert get_shape(read(stage)).make_mesh().volume == pytest.approx(0.004, rel=1e-5)


def test_polygons_holes_and_flat_meshes(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    add_body(stage, "/a")
    mesh = UsdGeom.Mesh.Define(stage, "/a/m")
    mesh.CreatePointsAttr([(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 0.5, 0), (0, 2, 0), (3, 0, 0)])
    mesh.CreateFaceVertexCountsAttr([5, 3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3, 4, 1, 5, 2])
    mesh.CreateHoleIndicesAttr([1])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    api = UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim())
    assert get_shape(read(stage)).make_mesh().area == pytest.approx(2.5)
    for approximation in ("convexHull", "boundingCube"):
        api.CreateApproximationAttr(approximation)
        assert get_shape(read(stage)).make_mesh().volume > 0.0


def test_visual_shapes_collide_only_if_they_say_so(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    add_body(stage, "/a")
    for name in ("both", "hidden", "guide", "seen", "invisible", "off"):
        box = add_box(stage, f"/a/{name}")
        if name in ("seen", "invisible"):
            box.RemoveAPI(UsdPhysics.CollisionAPI)
        if name in ("hidden", "invisible"):
            UsdGeom.Imageable(box).MakeInvisible()
    UsdGeom.Imageable.Get(stage, "/a/guide").CreatePurposeAttr("guide")
    UsdPhysics.CollisionAPI.Get(stage, "/a/off").CreateCollisionEnabledAttr(False)
    UsdGeom.Plane.Define(stage, "/ground")
    UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath("/ground"))
    UsdGeom.Cube.Get(stage, "/a/both").CreateDisplayColorAttr([(1.0, 0.5, 0.25)])
    stage.SetEditTarget(stage.GetRootLayer())
    material = UsdShade.Material.Define(stage, "/red")
    shader = UsdShade.Shader.Define(stage, "/red/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(1.0, 0.0, 0.0))
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.5)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/a/seen")).Bind(material)
    found = read(stage)
    link = found.links["a"]
    assert [part.name for part in link.collision] == ["both", "hidden", "guide"]
    assert [part.name for part in link.visual] == ["both", "seen", "off"]
    assert link.visual[0].colour == pytest.approx((1.0, 0.5, 0.25, 1.0))
    assert link.visual[1].colour == pytest.approx((1.0, 0.0, 0.0, 0.5))
    assert has_note(found, "type Plane", "/ground")


def test_a_group_can_state_the_collision_of_its_instances(tmp_path: Path) -> None:
    """As importers of URDF write it: instances cannot state anything themselves."""
    prototype = create_stage(tmp_path / "shape.usda")
    prototype.SetDefaultPrim(UsdGeom.Xform.Define(prototype, "/shape").GetPrim())
    add_mesh(prototype, "/shape/mesh", trimesh.creation.icosphere(subdivisions=1))
    prototype.Save()
    stage = create_stage(tmp_path / "t.usda")
    add_body(stage, "/a")
    for number in range(2):
        group = UsdGeom.Xform.Define(stage, f"/a/collisions_{number}")
        set_matrix(group, pin.SE3(np.eye(3), np.array([number, 0.0, 0.0])).homogeneous)
        prim = group.GetPrim()
        prim.GetReferences().AddReference("shape.usda")
        prim.SetInstanceable(True)
        UsdPhysics.CollisionAPI.Apply(prim)
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr("boundingSphere")
    found = read(stage)
    assert [part.kind for part in found.links["a"].collision] == ["sphere", "sphere"]
    places = [part.placement.translation[0] for part in found.links["a"].collision]
    assert places == pytest.approx([0.0, 1.0], abs=1e-6)
    assert get_vertices(found.links["a"].visual[1])[:, 0].mean() == pytest.approx(1.0, abs=1e-6)


def test_bodies_inside_of_a_collider_do_not_collide_by_it(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    UsdPhysics.CollisionAPI.Apply(add_body(stage, "/a"))
    add_body(stage, "/a/b")
    for path in ("/a/one", "/a/b/two"):
        UsdGeom.Cube.Define(stage, path)
    found = read(stage)
    assert [part.name for part in found.links["a"].collision] == ["one"]
    assert found.links["b"].collision == ()
    assert [part.name for part in found.links["b"].visual] == ["two"]


# Masses


def report_collider(prim: Any) -> Any:
    """Return what usd-core's `ComputeMassProperties` asks for: of a cube, with its scale."""
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    body = prim.GetParent()
    in_body = UsdGeom.XformCache().GetLocalToWorldTransform(body).RemoveScaleShear()
    local = np.linalg.inv(np.array(in_body).T) @ matrix
    size = np.linalg.norm(local[:3, :3], axis=0)
    information = UsdPhysics.RigidBodyAPI.MassInformation()
    information.volume = float(size.prod())
    squares = size**2
    moments = information.volume / 12.0 * (squares.sum() - squares)
    information.inertia = Gf.Matrix3f(*np.diag(moments).ravel().tolist())
    information.centerOfMass = Gf.Vec3f(0.0)
    information.localPos = Gf.Vec3f(*map(float, local[:3, 3]))
    information.localRot = make_quaternion(local[:3, :3] / size)
    return information


MASSES = [
    {},
    {"mass": 3.0},
    {"density": 20.0},
    {"mass": 3.0, "density": 20.0},
    {"mass": 3.0, "centre": (0.1, -0.2, 0.3)},
    {"centre": (0.1, -0.2, 0.3)},
    {"mass": 3.0, "moments": (1.0, 2.0, 2.5), "axes": True},
    {"moments": (1.0, 2.0, 2.5), "axes": True, "centre": (0.1, 0.0, 0.0)},
    {"density": 20.0, "collider_density": 50.0},
    {"collider_mass": 2.0},
    {"mass": 3.0, "collider_mass": 2.0},
    {"material": 70.0},
    {"material": 70.0, "density": 20.0},
]


@pytest.mark.parametrize("stated", MASSES, ids=lambda stated: "-".join(stated) or "nothing")
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_masses_are_those_that_usd_core_computes(
    tmp_path: Path, stated: dict[str, Any], scale: float
) -> None:
    stage = create_stage(tmp_path / "t.usda")
    pose = pin.SE3(pin.exp3(np.array([0.2, 0.4, -0.6])), np.array([1.0, 2.0, 3.0])).homogeneous
    prim = add_body(stage, "/a", pose @ np.diag([scale, scale, scale, 1.0]))
    add_box(stage, "/a/one", (0.2, 0.4, 0.6))
    other = add_box(stage, "/a/two", (0.5, 0.1, 0.3), (0.4, 0.2, -0.1))
    mass = UsdPhysics.MassAPI.Apply(prim)
    if "mass" in stated:
        mass.CreateMassAttr(stated["mass"])
    if "density" in stated:
        mass.CreateDensityAttr(stated["density"])
    if "centre" in stated:
        mass.CreateCenterOfMassAttr(stated["centre"])
    if "moments" in stated:
        mass.CreateDiagonalInertiaAttr(stated["moments"])
        mass.CreatePrincipalAxesAttr(make_quaternion(pin.exp3(np.array([0.5, -0.3, 0.2]))))
    if "collider_mass" in stated:
        UsdPhysics.MassAPI.Apply(other).CreateMassAttr(stated["collider_mass"])
    if "collider_density" in stated:
        UsdPhysics.MassAPI.Apply(other).CreateDensityAttr(stated["collider_density"])
    if "material" in stated:
        material = UsdShade.Material.Define(stage, "/m")
        UsdPhysics.MaterialAPI.Apply(material.GetPrim()).CreateDensityAttr(stated["material"])
        binding = UsdShade.MaterialBindingAPI.Apply(other)
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    found = read(stage)
    expected = UsdPhysics.RigidBodyAPI(prim).ComputeMassProperties(report_collider)
    total, moments, centre, axes = expected
    inertia = found.links["a"].inertia
    assert inertia.mass == pytest.approx(total, rel=1e-4)
    assert np.allclose(inertia.lever, centre, atol=1e-5)
    quaternion = pin.Quaternion(axes.GetReal(), *axes.GetImaginary()).normalized()
    rotation = quaternion.toRotationMatrix()
    tensor = rotation @ np.diag(np.array(moments)) @ rotation.T
    assert np.allclose(inertia.inertia, tensor, rtol=1e-3, atol=1e-4 * max(moments))
    is_silent = not stated.keys() & {"mass", "density", "collider_density", "collider_mass"}
    assert has_note(found, "neither mass nor density") == (is_silent and "material" not in stated)


def test_principal_axes_that_are_not_stated_are_those_of_the_body(tmp_path: Path) -> None:
    """With a centre, usd-core 26.11 returns axes that it never set."""
    stage = create_stage(tmp_path / "t.usda")
    mass = UsdPhysics.MassAPI.Apply(add_body(stage, "/a"))
    mass.CreateMassAttr(3.0)
    mass.CreateDiagonalInertiaAttr((1.0, 2.0, 2.5))
    mass.CreateCenterOfMassAttr((0.1, 0.0, 0.0))
    add_box(stage, "/a/box")
    inertia = read(stage).links["a"].inertia
    assert np.allclose(inertia.inertia, np.diag([1.0, 2.0, 2.5]))
    assert np.allclose(inertia.lever, [0.1, 0.0, 0.0])


def test_negative_moments_count_as_not_stated(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    mass = UsdPhysics.MassAPI.Apply(add_body(stage, "/a"))
    mass.CreateMassAttr(6.0)
    mass.CreateDiagonalInertiaAttr((1.0, -2.0, 2.5))
    add_box(stage, "/a/box")
    found = read(stage)
    assert has_note(found, "body /a: negative moments")
    assert np.allclose(found.links["a"].inertia.inertia, np.eye(3))


def test_open_meshes_weigh_as_much_as_their_hulls(tmp_path: Path) -> None:
    stage = create_stage(tmp_path / "t.usda")
    add_body(stage, "/a")
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.update_faces(np.arange(len(box.faces)) > 1)
    UsdPhysics.CollisionAPI.Apply(add_mesh(stage, "/a/m", box))
    assert read(stage).links["a"].inertia.mass == pytest.approx(1000.0, rel=1e-4)


# Files that are wrong


BODY = 'def Xform "a" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {\n%s\n}\n'
CUBE = 'def Cube "c" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n}\n'
ERRORS = {
    "no physics": ('def Cube "c" {\n}\n', "the USD has no physics", None),
    "missing layer": (
        'def Xform "r" (references = @./gone.usda@) {\n}\n',
        r"missing: Could not open asset @.*gone.usda@ for reference introduced by .*</r>",
        None,
    ),
    "missing sublayer": ("", r"Could not load sublayer @.*nowhere.usda@", None),
    "missing prim": (
        'def Xform "r" (references = @./part.usda@</Gone>) {\n}\n',
        "Unresolved reference prim path",
        None,
    ),
    "encrypted layer": (
        'def Xform "r" (references = @./secret.usd@) {\n}\n',
        "a layer that t.usda refers to cannot be read",
        "./secret.usd",
    ),
    "outside": (
        'def Xform "r" (payload = @../outside.usda@) {\n}\n',
        "t.usda refers to a layer elsewhere",
        "../outside.usda",
    ),
    "network": (
        'def Xform "r" (references = @https://example.com/a.usd@) {\n}\n',
        "nothing is fetched",
        "https://example.com/a.usd",
    ),
    "value clips": (
        'def Xform "r" (clips = {\ndictionary default = {\nstring primPath = "/r"\n}\n}) {\n}\n',
        "value clips are not read",
        "/r",
    ),
    "no such body": (
        BODY % CUBE + 'def PhysicsFixedJoint "j" {\nrel physics:body0 = </gone>\n'
        "rel physics:body1 = </a>\n}\n",
        "physics:body0 names a prim that does not exist .*got /gone",
        "/j",
    ),
    "two bodies": (
        BODY % CUBE + 'def PhysicsFixedJoint "j" {\nrel physics:body1 = [</a>, </a/c>]\n}\n',
        "physics:body1 names several prims",
        "/j",
    ),
    "nan limits": (
        BODY % CUBE + 'def PhysicsRevoluteJoint "j" {\nrel physics:body1 = </a>\n'
        "float physics:lowerLimit = nan\n}\n",
        "wrong limits",
        "/j",
    ),
    "no rotation": (
        BODY % CUBE + 'def PhysicsFixedJoint "j" {\nrel physics:body1 = </a>\n'
        "quatf physics:localRot1 = (0, 0, 0, 0)\n}\n",
        "wrong frame of a joint",
        "/j",
    ),
    "negative mass": (
        'def Xform "a" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {\n'
        "float physics:mass = -1\n}\n",
        r"wrong physics:mass \(expected 0 or more, got -1",
        "/a",
    ),
    "flat body": (
        BODY % 'float3 xformOp:scale = (1, 0, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]',
        "a body without volume",
        "/a",
    ),
    "nan transform": (
        BODY % "double3 xformOp:translate = (nan, 0, 1)\n"
        'uniform token[] xformOpOrder = ["xformOp:translate"]',
        "the transform is not finite",
        "/a",
    ),
    "wrong faces": (
        BODY % 'def Mesh "m" {\npoint3f[] points = [(0, 0, 0)]\nint[] faceVertexCounts = [3]\n'
        "int[] faceVertexIndices = [0, 1, 2]\n}",
        "wrong faces",
        "/a/m",
    ),
    "far away": (
        BODY
        % (
            "double3 xformOp:translate = (1e9, 0, 0)\n"
            'uniform token[] xformOpOrder = ["xformOp:translate"]'
        ),
        r"too large or too far away \(expected at most 10000 m \(metersPerUnit is 1\)",
        "/a",
    ),
    "large": (
        BODY % 'def Sphere "s" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {\n'
        "double radius = 20000\n}",
        "too large",
        "/a/s",
    ),
    "wrong type": (
        'def Xform "a" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {\n'
        'string physics:mass = "heavy"\n}\n',
        "a value of a wrong type: could not convert string to float",
        "/a",
    ),
    "point instancer": (
        f'def PointInstancer "p" {{\nrel prototypes = </p/c>\n{CUBE}}}\n' + BODY % CUBE,
        "a point instancer places colliders",
        "/p",
    ),
    "not USD": ("garbage {", "USD cannot read the file", None),
}


@pytest.mark.parametrize("name", ERRORS)
def test_wrong_files_name_the_prim_or_the_layer(tmp_path: Path, name: str) -> None:
    text, message, field = ERRORS[name]
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "part.usda").write_text(f'#usda 1.0\n(defaultPrim = "a")\n{BODY % CUBE}')
    (tmp_path / "outside.usda").write_text(f'#usda 1.0\n(defaultPrim = "a")\n{BODY % CUBE}')
    (folder / "secret.usd").write_bytes(bytes(range(256)))
    file = folder / "t.usda"
    sublayers = "subLayers = [@./nowhere.usda@]\n" if name == "missing sublayer" else ""
    file.write_text(f'#usda 1.0\n(\nmetersPerUnit = 1\nupAxis = "Z"\n{sublayers})\n{text}')
    with pytest.raises(InputError, match=message) as caught:
        read_description(file)
    assert caught.value.file == file
    assert caught.value.field == field


def test_renamed_files_need_their_suffix(tmp_path: Path) -> None:
    (tmp_path / "t.urdf").write_text("#usda 1.0\n" + BODY % CUBE)
    with pytest.raises(InputError, match=r"expected the suffix \.usd, .*got \.urdf"):
        read_description(tmp_path / "t.urdf")


def test_layers_of_stated_folders_are_read(tmp_path: Path) -> None:
    text = f'#usda 1.0\n(defaultPrim = "a"\nmetersPerUnit = 1\nupAxis = "Z")\n{BODY % CUBE}'
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "part.usda").write_text(text)
    (tmp_path / "scene").mkdir()
    file = tmp_path / "scene" / "t.usda"
    reference = 'def "b" (references = @../assets/part.usda@) {\n}\n'
    file.write_text(f'#usda 1.0\n(metersPerUnit = 1\nupAxis = "Z")\n{reference}')
    with pytest.raises(InputError, match=r"--package NAME=FOLDER"):
        read_description(file)
    found = read_description(file, packages={"assets": tmp_path / "assets"})
    assert list(found.links) == ["world", "b"]
    # A link in the folder leads outside as well.
    (tmp_path / "scene" / "part.usda").symlink_to(tmp_path / "assets" / "part.usda")
    file.write_text(file.read_text().replace("../assets/", "./"))
    with pytest.raises(InputError, match="refers to a layer elsewhere"):
        read_description(file)


def test_layers_of_other_variants_may_be_missing(tmp_path: Path) -> None:
    variants = 'variants = {\nstring v = "here"\n}\nprepend variantSets = "v"\n'
    sets = 'variantSet "v" = {\n"here" {\n%s}\n"gone" (references = @./gone.usda@) {\n}\n}\n'
    found = read_text(tmp_path, f'def Xform "r" (\n{variants}) {{\n{sets % (BODY % CUBE)}}}\n')
    assert list(found.links) == ["world", "a"]


def test_packages_are_read(tmp_path: Path) -> None:
    from pxr import UsdUtils

    stage = make_pair(tmp_path)
    add_joint(stage, "/j", "Revolute", "/a", "/b", at0=(1.0, 0.0, 0.0))
    stage.Save()
    archive = tmp_path / "t.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "t.usda"), str(archive))
    assert read_description(archive).joints["b"].kind == "revolute"
    archive.write_bytes(archive.read_bytes()[:200])
    with pytest.raises(InputError, match="USD cannot read the file"):
        read_description(archive)


def test_units_that_are_not_stated_are_noted(tmp_path: Path) -> None:
    file = tmp_path / "t.usda"
    file.write_text("#usda 1.0\n" + BODY % CUBE)
    found = read_description(file)
    assert has_note(found, "no metersPerUnit: centimetres")
    assert has_note(found, "no upAxis: Y")
    assert found.links["a"].collision[0].size == pytest.approx((0.02, 0.02, 0.02))


def test_animated_stages_are_read_at_their_first_time(tmp_path: Path) -> None:
    samples = "double3 xformOp:translate.timeSamples = {\n3: (1, 2, 3),\n5: (9, 9, 9),\n}\n"
    order = 'uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    found = read_text(tmp_path, BODY % (samples + order + CUBE))
    assert np.allclose(found.compute_placements()["a"].translation, [1.0, 2.0, 3.0])
    assert has_note(found, "animated", "/a")


def test_missing_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(optional_imports, "import_module", fail)
    with pytest.raises(InputError, match=r"needs the Python package pxr .*the extra `usd`"):
        read_text(tmp_path, BODY % CUBE)


def test_plugins_and_search_paths_of_the_environment_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "search").mkdir()
    (tmp_path / "search" / "part.usda").write_text(f'#usda 1.0\n(defaultPrim = "a")\n{BODY % CUBE}')
    monkeypatch.setenv("PXR_AR_DEFAULT_SEARCH_PATH", str(tmp_path / "search"))
    from vkc_pin.utils import isolation

    monkeypatch.setattr(isolation, "_LOCAL", isolation.threading.local())
    with pytest.raises(InputError, match=r"missing: Could not open asset @part.usda@"):
        read_text(tmp_path, 'def Xform "r" (references = @part.usda@) {\n}\n')
    assert os.environ["PXR_AR_DEFAULT_SEARCH_PATH"]


# Imports


def write_home(file: Path) -> None:
    """Write a room with a cupboard with a door, a cup, a floor and a table, in centimetres."""
    stage = create_stage(file, metres=0.01, up="Y")

    def place(x: float, y: float, z: float) -> np.ndarray:
        """Return a frame at a place with z up [cm]."""
        return pin.SE3(np.eye(3), UP["Y"].T @ np.array([x, y, z])).homogeneous

    def turn(values: Any) -> np.ndarray:
        x, y, z = values
        return np.array([x, z, y])

    for name, size, at in (
        ("north", (600, 10, 240), (0, 300, 120)),
        ("south", (600, 10, 240), (0, -300, 120)),
        ("slab", (600, 600, 10), (0, 0, -5)),
        ("table", (60, 60, 70), (-150, 150, 35)),
    ):
        prim = UsdGeom.Xform.Define(stage, f"/home/{name}")
        set_matrix(prim, place(*at))
        add_box(stage, f"/home/{name}/{name}", turn(size))
    add_body(stage, "/home/cupboard", place(250, 0, 40))
    add_box(stage, "/home/cupboard/box", turn((40, 60, 80)))
    add_body(stage, "/home/leaf", place(225, -30, 40))
    add_box(stage, "/home/leaf/leaf", turn((2, 60, 80)), turn((0, 30, 0)) * [1, 1, -1])
    add_box(stage, "/home/leaf/handle", turn((2, 2, 30)), turn((-8, 50, 0)) * [1, 1, -1])
    add_joint(stage, "/home/stands", "Fixed", None, "/home/cupboard")
    add_joint(
        stage,
        "/home/hinge",
        "Revolute",
        "/home/cupboard",
        "/home/leaf",
        at0=UP["Y"].T @ np.array([-25.0, -30.0, 0.0]),
        axis="Y",
        limits=(-90.0, 0.0),
    )
    add_body(stage, "/home/cup", place(-150, 150, 75))
    cup = UsdGeom.Cylinder.Define(stage, "/home/cup/body")
    cup.CreateAxisAttr("Y")
    cup.CreateRadiusAttr(3.0)
    cup.CreateHeightAttr(10.0)
    UsdPhysics.CollisionAPI.Apply(cup.GetPrim())
    stage.Save()


def test_homes_are_imported(tmp_path: Path) -> None:
    write_home(tmp_path / "flat.usda")
    imported = vkc.importing.import_home(tmp_path / "flat.usda", tmp_path / "flat", most=1)
    assert imported.shapes == {"file": 8, "obstacles": 3, "objects": 4, "floor": 1}
    objects = imported.scene.objects
    assert set(objects) == {"cupboard", "cup"}
    assert objects["cupboard"].object.coordinates.names == ("hinge",)
    assert objects["cupboard"].object.attachments
    assert set(imported.scene.obstacle_names) >= {"north", "south", "table"}


def test_objects_are_imported(tmp_path: Path) -> None:
    original = read_description(CABINET)
    file = tmp_path / "cabinet.usdc"
    write_description(original, file, metres=0.01, up="Y", kilograms=1.0)
    imported = vkc.importing.import_object(file, tmp_path / "out", most=1)
    same = vkc.importing.import_object(CABINET, tmp_path / "same", most=1)
    assert imported.size == pytest.approx(same.size, abs=1e-5)
    assert len(imported.object.coordinates.names) == len(same.object.coordinates.names)
    assert len(imported.proposals.found) == len(same.proposals.found)


def test_robots_are_read(tmp_path: Path) -> None:
    urdf = write_arms(tmp_path)
    file = tmp_path / "arm.usdc"
    write_description(read_description(urdf), file, metres=0.01, up="Y", kilograms=1.0)
    limits = dict[str, np.ndarray]()
    for source in (urdf, file):
        found = read_source(source, tmp_path / "scratch")
        for joint in found.file.root.findall("joint"):
            limit = joint.find("limit")
            if joint.get("type") in ("revolute", "prismatic") and limit is not None:
                name = joint.get("name", "").removeprefix("joint_")
                ends = np.array([limit.get("lower", ""), limit.get("upper", "")], float)
                assert np.allclose(limits.setdefault(name, ends), ends, atol=1e-5)
                limits[f"{name}_{source.suffix}"] = ends
    assert len(limits) % 3 == 0  # in both
    assert len(limits) > 12


def test_robots_are_imported(tmp_path: Path) -> None:
    """A robot of a stage is the one of the URDF: joints, limits, hand; and it moves."""
    urdf = write_arms(tmp_path)
    file = tmp_path / "arm.usdc"
    write_description(read_description(urdf), file, metres=0.01, up="Y", kilograms=1.0)
    robots = []
    for source in (urdf, file):
        target = tmp_path / source.suffix[1:]
        robots.append(vkc.importing.import_robot(source, target, samples=500).robot)
    same, robot = robots
    assert robot.coordinates.names == tuple(
        name if name.startswith("base_") else f"joint_{name}" for name in same.coordinates.names
    )
    np.testing.assert_allclose(robot.lower[3:], same.lower[3:], atol=1e-5)
    np.testing.assert_allclose(robot.upper[3:], same.upper[3:], atol=1e-5)
    assert robot.touch_links == same.touch_links
    assert robot.gripper is not None
    rng = np.random.default_rng(2)
    for _ in range(5):
        z = np.concatenate([rng.uniform(-1.0, 1.0, 3), rng.uniform(same.lower[3:], same.upper[3:])])
        tools = []
        for one in robots:
            data = one.model.createData()
            pin.framesForwardKinematics(one.model, data, one.coordinates.q(z))
            tools.append(data.oMf[one.model.getFrameId(one.tool_frame)])
        apart = tools[0].actInv(tools[1])
        assert np.linalg.norm(apart.translation) < 1e-4
    scene = vkc.load_scene(tmp_path / "usdc" / "scene.yaml")
    plan = vkc.plan(scene, [vkc.GoTo(1.0, 0.5, 0.7)])
    assert plan.success, plan.summary()
