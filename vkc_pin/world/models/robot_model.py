"""Builds the Pinocchio model of a robot: planar base, planned joints, and shapes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Set

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.meshes import load_parts, make_bvh
from vkc_pin.world.files.urdf import UrdfFile, UrdfShape, build_model
from vkc_pin.world.models.couplings import (
    JointCoupling,
    add_mimics,
    find_coupled_groups,
    find_followers,
    find_joint_path,
    sort_joints,
)
from vkc_pin.world.models.grafting import add_joint, round_placement

BASE_JOINT = "base"  # name of the planar joint
# [m] and entries of rotations: URDFs often have quarter turns with nine digits; exact ones make
# expressions sparse
_ROUNDING = 1e-9
_AXIS_TOLERANCE = 1e-3  # sine of the largest angle at which axes count as horizontal or vertical
_MAX_FINGER_JOINTS = 7  # joints of the longest finger of a hand
_MIN_ARM_JOINTS = 4  # minimum number of joints that carry a hand
_MESH_DETAIL = 0.0015  # resolution of displayed meshes [m]
_GREY = (0.6, 0.6, 0.62, 1.0)


def build_full_model(file: UrdfFile) -> pin.Model:
    """Return the model of all joints of `file` on a planar joint."""
    return build_model(file, pin.JointModelPlanar(), BASE_JOINT)


def build_planned_model(
    full: pin.Model,
    file: UrdfFile,
    tool_frame: str,
    rest: Mapping[str, float],
    locked: Mapping[str, float],
    *,
    height: float = 0.0,
) -> pin.Model:
    """Return the model of the planned joints, with all other joints of `full` locked.

    Planned joints are those between base and `tool_frame`, and those coupled to them. Followers
    become `pinocchio.JointModelMimic` and have no coordinate.

    Args:
        full: The robot with all joints; see `build_full_model`.
        file: The robot's URDF.
        tool_frame: The tool frame.
        rest: Position of each locked joint, [m] or [rad]; see `compute_rest_positions`.
        locked: Positions of planned joints to lock as well, [m] or [rad].
        height: Height of the root link above the base joint [m].
    """
    couplings = find_followers(file.root)
    groups = find_coupled_groups(full, file, tool_frame)
    groups = {leader: group for leader, group in groups.items() if leader not in locked}
    for leader, group in groups.items():
        for joint in group:
            if joint in locked:
                raise InputError(
                    "a locked joint follows one that is not locked",
                    file=file.path,
                    field=f"locked_joints.{joint}",
                    expected="the joint that it follows in `locked_joints`",
                    got=f"'{leader}' is not locked",
                )
    path = {str(full.names[j]) for j in find_joint_path(full, tool_frame) if j > 1}
    uncoupled = path - {*locked, *couplings}
    moving = uncoupled.union(groups, *groups.values())
    planned = {1}  # the base
    for j in range(2, full.njoints):
        if full.names[j] in moving and full.names[j] in rest:
            planned.add(j)
    if len(planned) == 1:
        raise InputError(
            "no joint moves the tool frame",
            file=file.path,
            field="tool_frame",
            expected="a frame moved by an arm",
            got=tool_frame,
        )
    q = make_configuration(full, {**rest, **locked})
    return _lock_joints(full, planned, q, height, couplings)


def build_unlocked_model(
    full: pin.Model,
    file: UrdfFile,
    model: pin.Model,
    joints: Collection[str],
    rest: Mapping[str, float],
    height: float,
) -> pin.Model:
    """Return a model with the joints of `model` followed by additional `joints`.

    Mimic joints among them become independent. For the other arguments, see `build_planned_model`.
    """
    own = [full.getJointId(str(name)) for name in list(model.names)[1:]]
    last = [full.getJointId(str(name)) for name in joints]
    couplings = find_followers(file.root)
    for joint in joints:
        couplings.pop(joint, None)
    q = make_configuration(full, rest)
    return _lock_joints(full, {*own, *last}, q, height, couplings, last)


def compute_rest_positions(
    full: pin.Model, file: UrdfFile, given: Mapping[str, float]
) -> dict[str, float]:
    """Return the rest position of each joint of one degree of freedom, [m] or [rad].

    Positions in `given` come first, then those implied by couplings. The default is 0, or the
    middle of the limits if these exclude 0.
    """
    rest = {}
    for j in range(2, full.njoints):
        name = full.names[j]
        if full.joints[j].nv == 1:
            low, high = find_joint_limits(full, name)
            default = 0.0 if low <= 0.0 <= high else 0.5 * (low + high)
            rest[name] = float(given.get(name, default))
    for name, coupling in find_followers(file.root).items():
        if name in rest and coupling.leader in rest and name not in given:
            rest[name] = coupling.factor * rest[coupling.leader] + coupling.offset
    return rest


def find_joint_limits(model: pin.Model, joint: str) -> tuple[float, float]:
    """Return the position limits of a joint [m] or [rad]; infinite for continuous joints."""
    moving = model.joints[model.getJointId(joint)]
    if moving.nq != 1:
        return -np.inf, np.inf
    return model.lowerPositionLimit[moving.idx_q], model.upperPositionLimit[moving.idx_q]


def find_nearest_position(model: pin.Model, joint: str, position: float) -> float:
    """Return the feasible position nearest to `position` [m] or [rad].

    Positions outside the limits are shifted by ±2π for revolute joints, or else clamped.
    """
    moving = model.joints[model.getJointId(joint)]
    is_continuous = moving.nq == 2
    if is_continuous:
        return position
    low, high = find_joint_limits(model, joint)
    is_prismatic = "JointModelP" in moving.shortname()
    turns = (0.0,) if is_prismatic else (0.0, 2.0 * np.pi, -2.0 * np.pi)
    for turn in turns:
        if low <= position + turn <= high:
            return float(position + turn)
    return float(np.clip(position, low, high))


def find_neighbours(
    file: UrdfFile, links: Collection[str]
) -> tuple[Set[tuple[str, str]], Set[tuple[str, str]]]:
    """Return adjacent pairs of `links`, and pairs of adjacent rigid bodies, each pair sorted.

    Two links are adjacent if only links outside `links` lie between them. Two rigid bodies (links
    connected by fixed joints) are adjacent if a movable joint connects them.
    """
    parents = dict[str, tuple[str, str]]()  # link → parent link, type of the joint between them
    for joint in file.root.findall("joint"):
        parent = joint.find("parent")
        child = joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = (parent.get("link", ""), joint.get("type", ""))
    adjacent = set[tuple[str, str]]()
    # Rigid bodies are named after their root links.
    bodies = dict[str, str]()
    parent_bodies = dict[str, str]()
    for link in links:
        ancestor, _ = parents.get(link, ("", ""))
        while ancestor and ancestor not in links:
            ancestor, _ = parents.get(ancestor, ("", ""))
        if ancestor:
            adjacent.add((min(link, ancestor), max(link, ancestor)))
        body = _find_rigid_root(link, parents)
        bodies[link] = body
        if body in parents:
            parent_link, _ = parents[body]
            parent_bodies[link] = _find_rigid_root(parent_link, parents)
    adjacent_bodies = set[tuple[str, str]]()
    for link, parent_body in parent_bodies.items():
        for other in links:
            if bodies[other] == parent_body:
                adjacent_bodies.add((min(link, other), max(link, other)))
    return adjacent, adjacent_bodies


def _find_rigid_root(link: str, parents: Mapping[str, tuple[str, str]]) -> str:
    """Return the root of the rigid body that a link belongs to."""
    while link in parents and parents[link][1] == "fixed":
        link, _ = parents[link]
    return link


def find_base_joints(full: pin.Model, file: UrdfFile) -> tuple[str, ...]:
    """Return the joints of a planar base in the URDF, or no joints if it has none.

    A planar base is a chain of the first three joints: two prismatic ones along different
    horizontal axes and a revolute or continuous one about the vertical axis, in any order, without
    collision shapes before the last one.
    """
    data = full.createData()
    pin.computeJointJacobians(full, data, pin.neutral(full))
    links_with_shapes = {shape.link for shape in file.read_shapes("collision")}
    joints_with_shapes = set[int]()
    for frame in full.frames:
        if frame.type == pin.FrameType.BODY and frame.name in links_with_shapes:
            joints_with_shapes.add(frame.parentJoint)
    directions = list[Floats]()
    found = list[str]()
    joint = 1
    while len(found) < 3:
        children = [j for j in range(2, full.njoints) if full.parents[j] == joint]
        if joint in joints_with_shapes or len(children) != 1:
            return ()
        (joint,) = children
        if full.joints[joint].nv != 1:
            return ()
        # Twist of the joint at unit velocity: linear velocity, then angular, in the axes of the
        # world. A horizontal slide has (x, y, 0, 0, 0, 0), a vertical axis (·, ·, ·, 0, 0, ±1).
        jacobian = pin.getJointJacobian(full, data, joint, pin.LOCAL_WORLD_ALIGNED)
        twist = jacobian[:, full.joints[joint].idx_v]
        is_slide = np.abs(twist[3:]).max() < _AXIS_TOLERANCE
        if is_slide and abs(twist[2]) < _AXIS_TOLERANCE:
            directions.append(twist[:2])
        elif abs(twist[5]) < 1.0 - _AXIS_TOLERANCE:
            return ()
        found.append(full.names[joint])
    if len(directions) != 2:
        return ()
    first, second = directions
    sine = abs(first[0] * second[1] - first[1] * second[0])
    return tuple(found) if sine > _AXIS_TOLERANCE else ()


def make_configuration(model: pin.Model, positions: Mapping[str, float]) -> Floats:
    """Return the configuration with joints at `positions`, the others neutral, shape (nq,)."""
    q: Floats = pin.neutral(model)
    for j in range(1, model.njoints):
        joint = model.joints[j]
        value = positions.get(model.names[j])
        if value is None or joint.nv != 1:
            continue
        if joint.nq == 1:
            q[joint.idx_q] = value
        else:  # a continuous joint
            q[joint.idx_q] = np.cos(value)
            q[joint.idx_q + 1] = np.sin(value)
    return q


def find_default_tool_frame(full: pin.Model, file: UrdfFile) -> str:
    """Return the last frame of the longest chain of joints, before it branches into fingers."""
    couplings = find_followers(file.root)
    children: dict[int, list[int]] = {j: [] for j in range(full.njoints)}
    # Number of independent joints on the longest chain below each joint.
    depth = np.zeros(full.njoints, int)
    for j in range(full.njoints - 1, 1, -1):
        parent = full.parents[j]
        children[parent].insert(0, j)
        is_independent = full.joints[j].nv == 1 and full.names[j] not in couplings
        depth[parent] = max(depth[parent], depth[j] + is_independent)
    joint = 1
    joint_count = 0
    while children[joint]:
        is_hand = len(children[joint]) > 1 and depth[joint] <= _MAX_FINGER_JOINTS
        if is_hand and joint_count >= _MIN_ARM_JOINTS:
            break
        joint = max(children[joint], key=lambda j: depth[j] + (full.joints[j].nv == 1))
        joint_count += 1
    frames = [frame.name for frame in full.frames if frame.parentJoint == joint]
    names = [name for name in frames if name != full.names[joint]]
    return str(names[-1])


def load_collision_geometry(model: pin.Model, file: UrdfFile) -> pin.GeometryModel:
    """Return the convex collision shapes of `file` on the joints of `model`, named `<link>_<k>`."""
    geometry = pin.GeometryModel()
    for shape in file.read_shapes_for_model("collision"):
        solid = shape.make_solid()
        copy = _make_geometry_object(model, shape, shape.name, solid, _GREY)
        geometry.addGeometryObject(copy)
    if len(geometry.geometryObjects) == 0:
        raise InputError(
            "this robot has no collision geometry",
            file=file.path,
            expected="<collision> elements",
            got="none",
        )
    return geometry


def load_visual_geometry(model: pin.Model, file: UrdfFile) -> pin.GeometryModel:
    """Return the visual geometry of `file` on the joints of `model`, one shape per colour.

    Meshes are simplified for display in a browser. `meshPath` is empty, so that viewers draw the
    triangles of the shapes.
    """
    geometry = pin.GeometryModel()
    for shape in file.read_shapes_for_model("visual"):
        if shape.file is None:
            solid = shape.make_solid()
            colour = shape.colour or _GREY
            copy = _make_geometry_object(model, shape, shape.name, solid, colour)
            geometry.addGeometryObject(copy)
            continue
        parts = load_parts(shape.file, shape.size, detail=_MESH_DETAIL)
        for k, part in enumerate(parts):
            name = shape.name if len(parts) == 1 else f"{shape.name}_{k}"
            colour = shape.colour or part.colour or _GREY
            copy = _make_geometry_object(model, shape, name, make_bvh(part), colour)
            geometry.addGeometryObject(copy)
    return geometry


def _lock_joints(
    full: pin.Model,
    planned: Collection[int],
    q: Floats,
    height: float,
    couplings: Mapping[str, JointCoupling],
    last: Collection[int] = (),
) -> pin.Model:
    """Return `full` with all joints but `planned` locked at `q`; joints in `last` come last."""
    coupled = dict[int, JointCoupling]()
    before = dict[int, set[int]]()  # joint → joints that precede it in the model
    for j in sorted(planned):
        coupling = couplings.get(full.names[j])
        if coupling is None:
            continue
        leader = full.getJointId(coupling.leader)
        if leader in planned:
            coupled[j] = coupling
            before[j] = {leader}
    for j in last:
        before[j] = {*planned} - {*last}
    data = full.createData()
    pin.forwardKinematics(full, data, q)
    model = pin.Model()
    model.name = full.name
    # Joint of `full` → the joint of the model that carries it, and its placement on that joint.
    placed = {0: (0, pin.SE3.Identity())}
    for j in sort_joints(full, before):
        parent, placement = placed[full.parents[j]]
        if j in planned:
            joint_placement = round_placement(placement * full.jointPlacements[j], _ROUNDING)
            carrier = add_joint(model, parent, full.joints[j], joint_placement, like=(full, j))
            offset = np.array([0.0, 0.0, height if j == 1 else 0.0])
            on_carrier = pin.SE3(np.eye(3), offset)
        else:
            carrier = parent
            on_carrier = placement * data.liMi[j]
        placed[j] = (carrier, on_carrier)
        model.appendBodyToJoint(carrier, full.inertias[j], on_carrier)
    links = {frame.name for frame in full.frames if frame.type == pin.FrameType.BODY}
    for frame in full.frames[1:]:
        if frame.type == pin.FrameType.BODY or frame.name not in links:
            carrier, on_carrier = placed[frame.parentJoint]
            frame_placement = round_placement(on_carrier * frame.placement)
            model.addFrame(pin.Frame(frame.name, carrier, 0, frame_placement, frame.type))
    mimics = [placed[j][0] for j in coupled]
    return add_mimics(model, list(coupled.values()), mimics)


def _make_geometry_object(
    model: pin.Model,
    shape: UrdfShape,
    name: str,
    solid: coal.CollisionGeometry,
    colour: tuple[float, ...],
) -> pin.GeometryObject:
    """Return `solid` as a geometry object on the joint of the URDF element's link."""
    frame = model.getFrameId(shape.link, pin.FrameType.BODY)
    link = model.frames[frame]
    placement = round_placement(link.placement * shape.placement)
    geometry_object = pin.GeometryObject(name, link.parentJoint, frame, placement, solid)
    geometry_object.meshColor = np.array(colour)
    return geometry_object
