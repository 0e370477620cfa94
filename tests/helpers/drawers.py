"""Provides the drawer scene, poses of its handle, a grasping robot, and clearances by coal."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin

from helpers.carrying import solve_reach
from vkc_pin.options import Options
from vkc_pin.world.models.shapes import compute_shape_distance, get_link_name
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene, load_scene

MARGIN = 0.02  # [m] Options.dist_safe
HAND_CLEARANCE = 0.005  # [m] Options.grasp_clearance
SHORT = Options(reach_waypoints=5, turn_waypoints=3, move_waypoints=8)
# The hand is near the handle of the closed drawer.
NEAR_HANDLE = np.array([0.63, 0.08, 0.42, 2.288, -0.13, -0.55, 0.681, 1.141, 1.571])


@cache
def load_drawer_scene() -> Scene:
    return load_scene("drawer")


def add_boxes(scene: Scene, **boxes: tuple[Sequence[float], Sequence[float]]) -> Scene:
    """Return the scene with more boxes: name → (size, position of the centre)."""
    added = [
        {"name": n, "type": "box", "size": list(size), "position": list(at)}
        for n, (size, at) in boxes.items()
    ]
    return replace_scene_fields(scene, obstacles=[*scene.document["obstacles"], *added])


def replace_scene_fields(scene: Scene, **fields: Any) -> Scene:
    """Return the scene with other fields of its document."""
    return Scene.from_document({**scene.document, **fields}, scene.folder)


def make_drawer_scene(*obstacles: dict[str, Any], base: str = "omni") -> Scene:
    """Return the drawer's scene with other obstacles."""
    return replace_scene_fields(
        load_drawer_scene(), obstacles=list(obstacles), robot={"name": "husky_ur5e", "base": base}
    )


def compute_handle_pose(slide: float = 0.0, *, tilt: float = 0.0) -> pin.SE3:
    """Return the tool's grasp pose at the handle, with numbers of the drawer's URDF."""
    # The tool's z axis (approach) is along x, its x axis (closing direction) upwards.
    grasp = pin.SE3(
        np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([1.93 - 0.115 - slide, 0.0, 0.755]),
    )
    return grasp * pin.SE3(pin.utils.rotate("y", tilt), np.zeros(3))


def compute_tool_pose(scene: Scene, row: np.ndarray) -> pin.SE3:
    """Return the tool's pose by numeric Pinocchio; `row` begins with the robot's coordinates."""
    return dataclasses.replace(scene, start=np.array(row[: len(scene.start)])).tool_placement()


def compute_pose_error(scene: Scene, row: np.ndarray, target: pin.SE3) -> float:
    """Return the largest coordinate of the error between the tool and its target, [m] or [rad]."""
    error = compute_tool_pose(scene, row).inverse() * target
    return float(np.abs(np.concatenate([error.translation, pin.log3(error.rotation)])).max())


@cache
def _solve_grasp() -> np.ndarray:
    return solve_reach(compute_handle_pose(), NEAR_HANDLE)


def make_grasping_scene(scene: Scene | None = None, attachment: str = "handle") -> Scene:
    """Return the scene with the robot grasping the closed drawer, its base 1.2 m in front of it."""
    scene = scene or load_drawer_scene()
    row = _solve_grasp()
    return scene.with_start(base=row[:3], arm=row[3:]).with_held({"drawer": attachment})


def compute_spare_clearance(
    scene: Scene, row: np.ndarray, *, slide: float = 0.0, held: bool = False
) -> float:
    """Return the smallest difference between distance and margin over all pairs [m].

    Pairs are those within the robot, of the robot and the scene, and, if `held`, of the grasped
    tray and other objects and obstacles. `row` begins with the robot's coordinates.
    """
    robot = scene.robot
    state = {"drawer": {"slide": slide}}
    model = robot.model
    data = robot.model.createData()
    shapes = robot.collision.createData()
    pin.updateGeometryPlacements(
        model, data, robot.collision, shapes, robot.coordinates.q(np.array(row[: model.nv]))
    )
    links = list(robot.collision.geometryObjects)
    own = [(pair.first, pair.second) for pair in robot.collision.collisionPairs]
    found = [
        _compute_gap(links[i], shapes.oMg[i], links[j], shapes.oMg[j]) - MARGIN for i, j in own
    ]
    labelled = _get_shapes(scene, state)
    for i, link in enumerate(links):
        for label, shape in labelled:
            wheels = label == FLOOR and link.parentJoint == 1
            touching = label == "drawer.tray" and get_link_name(link.name) in robot.touch_links
            if not wheels and not (touching and held):
                gap = _compute_gap(link, shapes.oMg[i], shape, shape.placement)
                found.append(gap - (HAND_CLEARANCE if touching else MARGIN))
    if held:
        tray = [shape for label, shape in labelled if label == "drawer.tray"]
        others = [
            shape for label, shape in labelled if not label.startswith("drawer.") and label != FLOOR
        ]
        found += [
            _compute_gap(one, one.placement, other, other.placement) - MARGIN
            for one in tray
            for other in others
        ]
    return min(found)


def _get_shapes(
    scene: Scene, state: Mapping[str, Mapping[str, float]]
) -> list[tuple[str, pin.GeometryObject]]:
    labelled = list(zip(scene.obstacle_labels, scene.obstacles, strict=True))
    for name, placed in scene.objects.items():
        labelled += [
            (f"{name}.{get_link_name(s.name)}", s)
            for s in make_world_shapes(placed.with_state(state.get(name, {})))
        ]
    return labelled


def _compute_gap(
    first: pin.GeometryObject,
    first_placement: pin.SE3,
    second: pin.GeometryObject,
    second_placement: pin.SE3,
) -> float:
    return compute_shape_distance(
        first.geometry, first_placement, second.geometry, second_placement
    )
