"""Defines which shapes may be close to each other, and for how long.

The planner and the independent validation both implement these rules.

- A hand keeps the attachment's clearance from the whole object that it grasps, during the grasp and
  for `CONTACT_WINDOW` before and after. Without a clearance of its own that is
  `Options.grasp_clearance`. An object held through another link needs no clearance from that link.
  A hand whose measured grasp deviates from the attachment may be as close to the object, or overlap
  it as much, as in that grasp.
- The hand and the grasped link are rigidly connected, unless the grasp has a freedom.
- A hand that pushes touches the link with its foremost point. It needs no clearance from that link,
  never overlaps it, and moves it forward only.
- Objects that are lifted or put down, and objects that begin or cease to rest on a moving link, may
  be as close to their surroundings as they are at that moment, for `CONTACT_WINDOW`. The same holds
  for a link that touches a target, and the shapes at that target.
- A supported object and its support are rigidly connected.
- Shapes of articulated objects that are closer than `Options.dist_safe` to other fixed shapes, in
  the initial state or with all joints at zero, keep no clearance until their joints have moved them
  that far apart. They may overlap only as deep as in the initial state, or by a small error of the
  model; see `clearance_exemptions`.
- A free object that overlaps its surroundings where it is first lifted may leave them within
  `CONTACT_WINDOW`.
- An object grasped at the start counts as lifted there: it may leave shapes that it touches or
  overlaps within `CONTACT_WINDOW`.
- Pairs that the scene allows keep the scene's margin, or none; see `Scene.allowed`.

The gripper opening is that of the attachment it holds or grasps next. It changes where an object is
grasped or released, and before the motion; after the last grasp it stays.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import compute_clearance, get_link_name, list_placed_shapes
from vkc_pin.world.scene.clearance_exemptions import CONTACT_DEPTH, get_cached, make_state_key
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene

PlacedShape = tuple[coal.CollisionGeometry, pin.SE3]

CONTACT_WINDOW = 1.0
"""Time before and after a contact in which shapes may be close [s]."""


def _get_attachment(scene: Scene, hold: Hold) -> Attachment:
    return get_attachment(scene.objects, hold)


def find_grasped_link(scene: Scene, hold: Hold) -> str:
    """Return the label of the grasped link, "<object>.<link>"."""
    return f"{hold.object}.{_get_attachment(scene, hold).link}"


def find_touch_links(scene: Scene, hold: Hold) -> Collection[str]:
    """Return the labels of the grasping links: the robot's touch links, or `hold.frame`."""
    return scene.robot.touch_links if hold.frame is None else (hold.frame,)


def compute_hand_clearance(scene: Scene, hold: Hold, link: str, options: Options) -> float:
    """Return the clearance that the grasping links keep from a link of the grasped object [m].

    It applies during the grasp and shortly before and after. It is negative where a measured grasp
    overlaps the link.
    """
    attachment = _get_attachment(scene, hold)
    if (hold.by or attachment.contact == "push") and link == find_grasped_link(scene, hold):
        nominal = 0.0
    else:
        own = options.grasp_clearance if attachment.clearance is None else attachment.clearance
        nominal = min(own, options.dist_safe)
    if not hold.deviation:
        return nominal
    measured = _measure_hand_distances(scene, hold).get(link, np.inf)
    return min(nominal, measured - CONTACT_DEPTH)


def find_grasp_distances(scene: Scene, hold: Hold) -> Mapping[str, float]:
    """Return the distances that a grasp without freedoms fixes, with the object as at the start.

    Returns:
        Link of the object → its distance from the grasping links [m]; empty for other grasps.
    """
    attachment = _get_attachment(scene, hold)
    if hold.by is not None or attachment.freedoms or attachment.contact == "push":
        return {}
    placed = scene.objects[hold.object]
    links = find_touch_links(scene, hold)

    def compute() -> Mapping[str, float]:
        return _compute_distances(_place_hand(scene, hold, placed, links), placed)

    key = (hold.object, hold.attachment, "grasp", make_state_key(placed))
    return get_cached(scene, key, compute)


def _measure_hand_distances(scene: Scene, hold: Hold) -> Mapping[str, float]:
    """Return link → distance of the grasping links in a measured grasp of the scene's start [m].

    The distance is the smaller one of those at the start and in the grasp, if they differ.
    """
    (start_hold,) = (one for one in scene.holds if one == hold)
    placed = scene.objects[hold.object]
    links = find_touch_links(scene, hold)
    key = (hold, start_hold.at, scene.start.tobytes(), make_state_key(placed))
    compute = partial(_compute_hand_distances, scene, start_hold, placed, links)
    return get_cached(scene, key, compute)


def _compute_hand_distances(
    scene: Scene, hold: Hold, placed: PlacedObject, links: Collection[str]
) -> Mapping[str, float]:
    if hold.by is None:
        grasping = _place_hand(scene, hold, placed, links, include_start=True)
        return _compute_distances(grasping, placed)
    # The object that grasps is placed in the hand.
    carrier = hold.by.object
    shapes = make_world_shapes(scene.objects[carrier])
    grasping_shapes = [
        shape for shape in shapes if f"{carrier}.{get_link_name(shape.name)}" in links
    ]
    return _compute_distances(list_placed_shapes(grasping_shapes), placed)


def _place_hand(
    scene: Scene,
    hold: Hold,
    placed: PlacedObject,
    links: Collection[str],
    *,
    include_start: bool = False,
) -> list[PlacedShape]:
    """Return the shapes of the grasping links in the grasp, and as at the start if asked to."""
    robot = scene.robot
    attachment = get_attachment(scene.objects, hold)
    grasp = placed.link_placement(attachment.link) * attachment.tool(hold.at)
    # Displacement in the world frame that takes the hand from the start to the grasp.
    to_grasp = grasp * scene.tool_placement().inverse()
    geometry = robot.opened(compute_grasp_opening(scene, hold)).collision
    model_data = robot.model.createData()
    geometry_data = geometry.createData()
    q = robot.coordinates.q(scene.start)
    pin.updateGeometryPlacements(robot.model, model_data, geometry, geometry_data, q)
    displacements = [pin.SE3.Identity(), to_grasp] if include_start else [to_grasp]
    placed_shapes = list[PlacedShape]()
    for i, at_start in enumerate(geometry_data.oMg):
        if robot.link_of(i) in links:
            solid = geometry.geometryObjects[i].geometry
            for displacement in displacements:
                placed_shapes.append((solid, displacement * at_start))
    return placed_shapes


def _compute_distances(
    grasping: Sequence[PlacedShape], placed: PlacedObject
) -> Mapping[str, float]:
    """Return link of an object → its distance from some shapes [m]."""
    shapes_by_link: dict[str, list[pin.GeometryObject]] = {}
    for shape in make_world_shapes(placed):
        shapes = shapes_by_link.setdefault(get_link_name(shape.name), [])
        shapes.append(shape)
    distances = {}
    for link, shapes in shapes_by_link.items():
        distance = compute_clearance(grasping, list_placed_shapes(shapes))
        distances[f"{placed.name}.{link}"] = distance
    return distances


def compute_hand_frame(robot: Robot, attachment: Attachment) -> pin.SE3:
    """Return the frame that is brought to an attachment, in the tool frame.

    It is the tool frame itself, or, for a push, the foremost point of the hand.
    """
    if attachment.contact != "push":
        return pin.SE3.Identity()
    return robot.opened(robot.opening(attachment.opening)).front


def is_rigid_grasp(scene: Scene, hold: Hold) -> bool:
    """Return whether the grasping link does not move relative to the grasped link."""
    attachment = _get_attachment(scene, hold)
    return attachment.contact != "push" and (attachment.firm or not attachment.freedoms)


def find_gripper_hold(holds: Iterable[Hold]) -> Hold | None:
    """Return the hold of the gripper itself, not one through a grasped object; None: none."""
    for hold in holds:
        if hold.by is None:
            return hold
    return None


def compute_grasp_opening(scene: Scene, hold: Hold) -> float | None:
    """Return the gripper opening of a hold [m]; None: as in the robot's rest configuration."""
    return scene.robot.opening(_get_attachment(scene, hold).opening)


def compute_start_opening(scene: Scene) -> float | None:
    """Return the gripper opening at the start of a scene [m]; None: as in the rest state."""
    hold = find_gripper_hold(scene.holds)
    if hold is None:
        return scene.robot.opening(scene.opening)
    return compute_grasp_opening(scene, hold)
