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
    follows, groups = find_followers(file.root), find_coupled_groups(full, file, tool_frame)
    groups = {leader: group for leader, group in groups.items() if leader not in locked}
    if stuck_joints := [
        (joint, coupling.leader)
        for group in groups.values()
        for joint, coupling in group.items()
        if joint in locked
    ]:
        problem = "a locked joint follows one that is not locked"
        joint, leader = stuck_joints[0]
        expected = "the joint that it follows in `locked_joints`"
        raise InputError(
            problem,
            file=file.path,
            field=f"locked_joints.{joint}",
            expected=expected,
            got=f"'{leader}' is not locked",
        )
    uncoupled = {str(full.names[j]) for j in find_joint_path(full, tool_frame) if j > 1} - {
        *locked,
        *follows,
    }
    moving = uncoupled.union(groups, *groups.values())
    planned = [
        j for j in range(2, full.njoints) if full.names[j] in moving and full.names[j] in rest
    ]
    if not planned:
        expected = "a frame moved by an arm"
        raise InputError(
            "no joint moves the tool frame",
            file=file.path,
            field="tool_frame",
            expected=expected,
            got=tool_frame,
        )
    return _lock_joints(
        full, {1, *planned}, make_configuration(full, {**rest, **locked}), height, follows
    )


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
    own, last = (
        [full.getJointId(str(name)) for name in names] for names in (list(model.names)[1:], joints)
    )
    follows = {
        joint: coupling
        for joint, coupling in find_followers(file.root).items()
        if joint not in joints
    }
    return _lock_joints(full, {*own, *last}, make_configuration(full, rest), height, follows, last)


def compute_rest_positions(
    full: pin.Model, file: UrdfFile, given: Mapping[str, float]
) -> dict[str, float]:
    """Return the rest position of each joint of one degree of freedom, [m] or [rad].

    Positions in `given` come first, then those implied by couplings. The default is 0, or the
    middle of the limits if these exclude 0.
    """
    rest = {}
    for j in range(2, full.njoints):
        if full.joints[j].nv == 1:
            low, high = find_joint_limits(full, full.names[j])
            default = 0.0 if low <= 0.0 <= high else 0.5 * (low + high)
            rest[full.names[j]] = float(given.get(full.names[j], default))
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
    if moving.nq == 2:
        return position
    low, high = find_joint_limits(model, joint)
    turns = () if "JointModelP" in moving.shortname() else (2.0 * np.pi, -2.0 * np.pi)
    for turn in (0.0, *turns):
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
    parents = dict[str, tuple[str, str]]()
    for joint in file.root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = (parent.get("link", ""), joint.get("type", ""))
    adjacent, body, parent_body = set[tuple[str, str]](), dict[str, str](), dict[str, str]()
    for link in links:
        ancestor, _ = parents.get(link, ("", ""))
        while ancestor and ancestor not in links:
            ancestor, _ = parents.get(ancestor, ("", ""))
        if ancestor:
            adjacent.add((min(link, ancestor), max(link, ancestor)))
        body[link] = _find_rigid_root(link, parents)
        parent_body[link] = (
            _find_rigid_root(parents[body[link]][0], parents) if body[link] in parents else ""
        )
    return adjacent, {
        (min(a, b), max(a, b)) for a in links for b in links if parent_body[a] == body[b]
    }


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
    data, slides, found, joint = full.createData(), list[Floats](), list[str](), 1
    pin.computeJointJacobians(full, data, pin.neutral(full))
    solid = {shape.link for shape in file.read_shapes("collision")}
    carries = {
        frame.parentJoint
        for frame in full.frames
        if frame.type == pin.FrameType.BODY and frame.name in solid
    }
    while len(found) < 3:
        children = [j for j in range(2, full.njoints) if full.parents[j] == joint]
        if joint in carries or len(children) != 1 or full.joints[children[0]].nv != 1:
            return ()
        (joint,) = children
        twist = pin.getJointJacobian(full, data, joint, pin.LOCAL_WORLD_ALIGNED)[
            :, full.joints[joint].idx_v
        ]
        if np.abs(twist[3:]).max() < _AXIS_TOLERANCE and abs(twist[2]) < _AXIS_TOLERANCE:
            slides.append(twist[:2])
        elif abs(twist[5]) < 1.0 - _AXIS_TOLERANCE:
            return ()
        found.append(full.names[joint])
    has_two_directions = (
        len(slides) == 2
        and abs(slides[0][0] * slides[1][1] - slides[0][1] * slides[1][0]) > _AXIS_TOLERANCE
    )
    return tuple(found) if has_two_directions else ()


def make_configuration(model: pin.Model, positions: Mapping[str, float]) -> Floats:
    """Return the configuration with joints at `positions`, the others neutral, shape (nq,)."""
    q: Floats = pin.neutral(model)
    for j in range(1, model.njoints):
        joint, value = model.joints[j], positions.get(model.names[j])
        if value is not None and joint.nv == 1:
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                value if joint.nq == 1 else (np.cos(value), np.sin(value))
            )
    return q


def find_default_tool_frame(full: pin.Model, file: UrdfFile) -> str:
    """Return the last frame of the longest chain of joints, before it branches into fingers."""
    follows = find_followers(file.root)
    children: dict[int, list[int]] = {j: [] for j in range(full.njoints)}
    depth = np.zeros(full.njoints, int)
    for j in range(full.njoints - 1, 1, -1):
        children[full.parents[j]].insert(0, j)
        counts = full.joints[j].nv == 1 and full.names[j] not in follows
        depth[full.parents[j]] = max(depth[full.parents[j]], depth[j] + counts)
    joint, joint_count = 1, 0
    while children[joint]:
        hand = len(children[joint]) > 1 and depth[joint] <= _MAX_FINGER_JOINTS
        if hand and joint_count >= _MIN_ARM_JOINTS:
            break
        joint = max(children[joint], key=lambda j: depth[j] + (full.joints[j].nv == 1))
        joint_count = joint_count + 1
    return str(
        [
            frame.name
            for frame in full.frames
            if frame.parentJoint == joint and frame.name != full.names[joint]
        ][-1]
    )


def load_collision_geometry(model: pin.Model, file: UrdfFile) -> pin.GeometryModel:
    """Return the convex collision shapes of `file` on the joints of `model`, named `<link>_<k>`."""
    geometry = pin.GeometryModel()
    for shape in file.read_shapes_for_model("collision"):
        geometry.addGeometryObject(
            _make_geometry_object(model, shape, shape.name, shape.make_solid(), _GREY)
        )
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
            geometry.addGeometryObject(
                _make_geometry_object(
                    model, shape, shape.name, shape.make_solid(), shape.colour or _GREY
                )
            )
            continue
        parts = load_parts(shape.file, shape.size, detail=_MESH_DETAIL)
        for k, part in enumerate(parts):
            name = shape.name if len(parts) == 1 else f"{shape.name}_{k}"
            colour = shape.colour or part.colour or _GREY
            geometry.addGeometryObject(
                _make_geometry_object(model, shape, name, make_bvh(part), colour)
            )
    return geometry


def _lock_joints(
    full: pin.Model,
    planned: Collection[int],
    q: Floats,
    height: float,
    follows: Mapping[str, JointCoupling],
    last: Collection[int] = (),
) -> pin.Model:
    """Return `full` with all joints but `planned` locked at `q`; joints in `last` come last."""
    data = full.createData()
    pin.forwardKinematics(full, data, q)
    model = pin.Model()
    model.name = full.name
    placed = {0: (0, pin.SE3.Identity())}
    coupled = {
        j: coupling
        for j in sorted(planned)
        if (coupling := follows.get(full.names[j])) and full.getJointId(coupling.leader) in planned
    }
    before = {j: {full.getJointId(coupling.leader)} for j, coupling in coupled.items()} | {
        j: {*planned} - {*last} for j in last
    }
    for j in sort_joints(full, before):
        joint, (parent, placement) = full.joints[j], placed[full.parents[j]]
        if j in planned:
            index = add_joint(
                model,
                parent,
                joint,
                round_placement(placement * full.jointPlacements[j], _ROUNDING),
                like=(full, j),
            )
            placed[j] = (index, pin.SE3(np.eye(3), np.array([0.0, 0.0, height if j == 1 else 0.0])))
        else:
            placed[j] = (parent, placement * data.liMi[j])
        model.appendBodyToJoint(placed[j][0], full.inertias[j], placed[j][1])
    links = {frame.name for frame in full.frames if frame.type == pin.FrameType.BODY}
    for frame in full.frames[1:]:
        if frame.type == pin.FrameType.BODY or frame.name not in links:
            parent, placement = placed[frame.parentJoint]
            model.addFrame(
                pin.Frame(
                    frame.name, parent, 0, round_placement(placement * frame.placement), frame.type
                )
            )
    return add_mimics(model, [coupled[j] for j in coupled], [placed[j][0] for j in coupled])


def _make_geometry_object(
    model: pin.Model,
    shape: UrdfShape,
    name: str,
    solid: coal.CollisionGeometry,
    colour: tuple[float, ...],
) -> pin.GeometryObject:
    """Return `solid` as a geometry object on the joint of the URDF element's link."""
    frame = model.getFrameId(shape.link, pin.FrameType.BODY)
    parent = model.frames[frame]
    geometry_object = pin.GeometryObject(
        name, parent.parentJoint, frame, round_placement(parent.placement * shape.placement), solid
    )
    geometry_object.meshColor = np.array(colour)
    return geometry_object
