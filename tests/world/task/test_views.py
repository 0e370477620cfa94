"""Tests terms that keep a point in the view of a camera."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.expected_errors import expect_error
from helpers.judging import get_violation_names
from hypothesis import given, settings
from hypothesis import strategies as st

import vkc_pin as vkc
from vkc_pin.errors import UnknownNameError
from vkc_pin.utils.arrays import Floats
from vkc_pin.validation import compute_visibility
from vkc_pin.world.task.terms import trace_terms

STEPS = [vkc.Actuate("door", {"hinge": 0.6})]
REACH = "reach door.handle"
SIZE: dict[str, Any] = {"width": 640, "height": 480}
FRONT = vkc.Camera("front", "base", (0.3, 0.0, 1.2), (2.0, 0.0, 0.9), fov=58.0, **SIZE)
WRIST = vkc.Camera(
    "wrist", "hand", (0.0, -0.1, -0.05), (0.0, 0.0, 0.4), up=(0.0, -1.0, 0.0), fov=70.0, **SIZE
)


@cache
def load_facing_scene() -> vkc.Scene:
    """Return the door's scene with a robot that faces the door."""
    scene = vkc.load_scene("door")
    x, y, yaw = scene.start[:3].tolist()
    return scene.with_start(base=[x, y, yaw + np.pi])


def check(plan: vkc.Plan, term: vkc.Constraint) -> vkc.Report:
    """Validate a plan with a term."""
    return vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options, [term])


def project(plan: vkc.Plan, camera: vkc.Camera, time: float) -> Floats:
    """Return the handle in a camera's image: x and y in half sizes, and depth [m]."""
    placement = plan.pose(camera.find_frame(plan.scene.robot), time) * camera.placement
    attachment = plan.scene.objects["door"].object.attachment("handle")
    handle = plan.pose(f"door.{attachment.link}", time) * attachment.placement
    x, y, z = placement.actInv(handle.translation)
    half = -z * np.tan(np.radians(camera.fov) / 2.0)
    return np.array([x / half * camera.height / camera.width, y / half, -z])


@pytest.mark.parametrize("camera", [FRONT, WRIST], ids=["front", "wrist"])
def test_handle_stays_in_the_image_until_the_hand_is_near(camera: vkc.Camera) -> None:
    scene = load_facing_scene()
    term = vkc.keep_in_view(scene, camera, "door.handle", during=REACH)
    free = vkc.plan(scene, STEPS)
    assert get_violation_names(check(free, term)) == {("term", term.name)}
    plan = vkc.plan(scene, STEPS, terms=[term])
    assert plan.success, plan.summary()
    motion = plan.trajectory
    seen = []
    for waypoint in range(1, motion.phases[0].last + 1):
        time = motion.times[waypoint]
        hand = plan.pose(scene.robot.tool_frame, time).translation
        attachment = scene.objects["door"].object.attachment("handle")
        handle = plan.pose(f"door.{attachment.link}", time) * attachment.placement
        if np.linalg.norm(hand - handle.translation) > 0.3:
            seen.append(project(plan, camera, time))
    x, y, depth = np.array(seen).T
    assert len(seen) > 10
    assert (depth > 0.05).all()
    assert (np.abs(x) < 1.0).all()
    assert (np.abs(y) < 1.0).all()


def test_preferred_view_turns_the_camera_to_the_handle() -> None:
    scene = load_facing_scene()
    shares = []
    for terms in ([], [vkc.prefer_in_view(scene, FRONT, "door.handle", weight=0.3)]):
        plan = vkc.plan(scene, STEPS, terms=terms)
        assert plan.success, plan.summary()
        times = np.linspace(0.0, plan.trajectory.times[plan.trajectory.phases[0].last], 60)
        images = np.array([project(plan, FRONT, time) for time in times])
        is_inside = (np.abs(images[:, :2]) < 1.0).all(axis=1) & (images[:, 2] > 0.0)
        shares.append(is_inside.mean())
    assert shares[1] > shares[0] + 0.3


def test_arm_in_front_of_the_target_is_a_violation() -> None:
    """The target is on the line from the camera through the forearm, 1 m behind it."""
    scene = vkc.load_scene("door")
    plan = vkc.plan(scene, [vkc.GoTo(*scene.start[:2] + 0.05, scene.start[2])])
    assert plan.success
    start = plan.scene
    eye = plan.pose("base_link", 0.0).act(np.array([-0.6, 0.0, 0.8]))
    for link, is_hidden in (("forearm_link", True), ("nothing", False)):
        through = eye + np.array([0.0, 0.0, 1.0])
        if is_hidden:
            shape = next(one for one in start.robot.collision.geometryObjects if link in one.name)
            shape.geometry.computeLocalAABB()
            frame = plan.pose(link, 0.0)
            through = frame.act(shape.placement.act(shape.geometry.aabb_local.center()))
        direction = (through - eye) / np.linalg.norm(through - eye)
        target = through + direction
        camera = vkc.Camera(
            "rear",
            "base_link",
            (-0.6, 0.0, 0.8),
            tuple(plan.pose("base_link", 0.0).actInv(target).tolist()),
            up=(0.0, 1.0, 0.1),
            fov=90.0,
        )
        term = vkc.keep_in_view(start, camera, target, until=0.0)
        found = check(plan, term)
        texts = [one.detail for one in found.violations]
        assert any("in front of it" in text for text in texts) is is_hidden, texts


def is_hidden_by_robot(plan: vkc.Plan, eye: Floats, point: Floats, own: str, time: float) -> bool:
    """Return whether a small ball between an eye and a point touches another link."""
    robot = plan.scene.robot
    length = float(np.linalg.norm(point - eye))
    ball = coal.Sphere(1e-4)
    for shape in robot.collision.geometryObjects:
        joint = str(robot.model.names[shape.parentJoint])
        if joint == own:
            continue
        placement = plan.pose(joint, time) * shape.placement
        at = coal.Transform3s(placement.rotation, placement.translation)
        for share in np.arange(0.05, length - 0.1, 5e-3) / length:
            there = coal.Transform3s(np.eye(3), eye + share * (point - eye))
            answer = coal.CollisionResult()
            if coal.collide(shape.geometry, at, ball, there, coal.CollisionRequest(), answer):
                return True
    return False


@pytest.mark.parametrize("camera", [FRONT, WRIST], ids=["front", "wrist"])
def test_visibility_is_that_of_the_projection_and_of_rays(camera: vkc.Camera) -> None:
    scene = load_facing_scene()
    looks = vkc.prefer_in_view(scene, camera, "door.handle", weight=0.3)
    plan = vkc.plan(scene, STEPS, terms=[looks])
    times = np.linspace(0.0, float(plan.trajectory.times[-1]), 17)
    seen = compute_visibility(scene, plan.trajectory, camera, "door.handle", times)
    frame = camera.find_frame(scene.robot)
    joint = scene.robot.model.frames[scene.robot.model.getFrameId(frame)].parentJoint
    own = str(scene.robot.model.names[joint])
    attachment = scene.objects["door"].object.attachment("handle")
    expected = []
    for time in times:
        x, y, depth = project(plan, camera, time)
        is_inside = abs(x) <= 1.0 and abs(y) <= 1.0 and depth >= 0.05
        eye = (plan.pose(frame, time) * camera.placement).translation
        handle = plan.pose(f"door.{attachment.link}", time) * attachment.placement
        hidden = is_inside and is_hidden_by_robot(plan, eye, handle.translation, own, time)
        expected.append(bool(is_inside and not hidden))
    assert seen.tolist() == expected
    assert 0 < seen.sum() < len(seen)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_frustum_is_that_of_a_pinhole_camera(seed: int) -> None:
    """Rays through the four corners of the image bound it, here wider than high."""
    scene = load_facing_scene()
    rng = np.random.default_rng(seed)
    base, tool = (
        pin.SE3(pin.exp3(rng.normal(0.0, 2.0, 3)), rng.uniform(-2.0, 2.0, 3)) for _ in range(2)
    )
    depth = rng.uniform(-1.0, 3.0)
    point = (base * FRONT.placement).act(depth * np.array([*rng.uniform(-1.0, 1.0, 2), -1.0]))
    term = vkc.keep_in_view(scene, FRONT, point, margin=0.0, nearest=0.0, until=0.0)
    (traced,) = trace_terms(scene, [term])
    inputs = [np.concatenate([one.rotation.T.ravel(), one.translation]) for one in (base, tool)]
    frames = dict(zip((FRONT.find_frame(scene.robot), scene.robot.tool_frame), inputs, strict=True))
    now = np.concatenate([frames[name] for name in traced.formula.frames])
    (excess,) = traced.formula.evaluate(np.concatenate([now, now, [1.0]])[None])
    x, y, z = (base * FRONT.placement).actInv(point)
    focal_length = FRONT.height / 2.0 / np.tan(np.radians(FRONT.fov) / 2.0)  # [pixels]
    pixels = np.abs([x, y]) / -z * focal_length
    is_inside = z < 0.0 and (pixels < (FRONT.width / 2.0, FRONT.height / 2.0)).all()
    assert bool(excess.max() < 0.0) is bool(is_inside)


def test_plans_keep_the_line_of_sight_in_files(tmp_path: Path) -> None:
    scene = load_facing_scene()
    term = vkc.keep_in_view(scene, WRIST, "door.handle", during=REACH)
    plan = vkc.plan(scene, STEPS, terms=[term])
    assert plan.success
    (again,) = vkc.Plan.load(plan.save(tmp_path / "plan.npz")).terms
    assert again == plan.terms[0]
    assert isinstance(again, vkc.Constraint)
    assert again.sight == term.sight


def test_wrong_cameras_and_targets_are_named() -> None:
    scene = load_facing_scene()
    with pytest.raises(UnknownNameError, match=r"wrist_4"):
        vkc.keep_in_view(scene, replace(WRIST, frame="wrist_4_link"), "door.handle")
    with pytest.raises(UnknownNameError, match=r"door\.handle"):
        vkc.keep_in_view(scene, WRIST, "door.handel")
    with expect_error("wrong shape", field="target"):
        vkc.prefer_in_view(scene, WRIST, [1.0, 2.0])
    with expect_error("not finite", field="target[1]"):
        vkc.keep_in_view(scene, WRIST, [1.0, np.nan, 0.0])
    with expect_error(field="margin"):
        vkc.keep_in_view(scene, WRIST, "door.handle", margin=50.0)
