"""Couples joints, from <mimic> in a URDF or `couplings` in a robot.yaml."""

from __future__ import annotations

import itertools
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.files.xml import make_element_error
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.robot_schema import CouplingSchema, RobotSchema
from vkc_pin.world.models.shapes import LIMIT_SLACK

_MOVING = ("revolute", "continuous", "prismatic")
DEFAULT_JOINT_VELOCITY = np.pi
"""Velocity limit of revolute joints for which no file states one [rad/s]."""
DEFAULT_SLIDE_VELOCITY = 0.1
"""Velocity limit of prismatic joints for which no file states one [m/s]; most of them are lifts."""
_DEFAULT_JOINT_ACCELERATION = 1.4  # [rad/s²] or [m/s²]
_MAX_URDF_VELOCITY = 1e3  # [rad/s] or [m/s]; larger values mean that there is no limit


@dataclass(frozen=True)
class JointCoupling:
    """Coupling of a joint to a leader: position = factor · leader position + offset.

    Attributes:
        leader: Name of the leader, which follows no other joint.
        factor: Factor; 0 only for a joint that does not move.
        offset: Offset [m] or [rad].
    """

    leader: str
    factor: float
    offset: float


class _Mimic(NamedTuple):
    """The `element` <mimic> of a joint, whose leader may follow another joint."""

    leader: str
    factor: float
    offset: float
    element: ElementTree.Element


def find_followers(root: ElementTree.Element) -> dict[str, JointCoupling]:
    """Return the coupling of each joint of a URDF that follows another one.

    Chains of couplings are resolved to their leader. If a leader is a descendant of one of its
    followers, the follower nearest to the root becomes the leader. Couplings to joints that do not
    exist or do not move, and circular ones, are ignored; `check_followers` reports them.
    """
    mimics = _read_mimics(root)
    movable = _find_movable_joints(root)
    found = dict[str, JointCoupling]()
    for joint in mimics:
        coupling = _resolve_coupling(joint, mimics, movable) if joint in movable else None
        if coupling is not None:
            found[joint] = coupling
    leaders = dict.fromkeys(coupling.leader for coupling in found.values())
    for leader in leaders:
        ancestors = [joint for joint in _find_ancestors(root, leader) if joint in found]
        for joint in ancestors:
            if found[joint].leader == leader and found[joint].factor:
                _replace_leader(found, leader, joint)
                break
    return found


def _replace_leader(found: dict[str, JointCoupling], leader: str, follower: str) -> None:
    """Make a follower the leader of its group.

    With p = f l + o the position p of the follower at the position l of its leader, the position
    g l + c of another joint becomes (g / f) p + (c − (g / f) o). That of the leader itself has
    g = 1 and c = 0.

    Args:
        found: Joint → coupling; changed in place.
        leader: The leader.
        follower: The follower, whose factor is not 0.
    """
    coupling = found.pop(follower)
    found[leader] = JointCoupling(leader, 1.0, 0.0)
    for joint, other in found.items():
        if other.leader == leader:
            factor = other.factor / coupling.factor
            offset = other.offset - factor * coupling.offset
            found[joint] = JointCoupling(follower, factor, offset)


def check_followers(full: pin.Model, file: UrdfFile, tool_frame: str) -> None:
    """Check that the leaders of all joints on the path to the tool exist and can move."""
    mimics = _read_mimics(file.root)
    movable = _find_movable_joints(file.root)
    found = find_followers(file.root)
    leaders = {coupling.leader for coupling in found.values()}
    for index in find_joint_path(full, tool_frame):
        joint = str(full.names[index])
        is_coupled = joint in found or joint in leaders
        if joint in mimics and joint in movable and not is_coupled:
            raise _make_coupling_error(joint, mimics, movable, file)


def _make_coupling_error(
    joint: str,
    mimics: Mapping[str, _Mimic],
    movable: Mapping[str, ElementTree.Element],
    file: UrdfFile,
) -> InputError:
    """Return the error for a joint whose couplings are circular, or end at a fixed joint."""
    chain = [joint]
    while chain[-1] in mimics and chain[-1] in movable and chain[-1] not in chain[:-1]:
        chain.append(mimics[chain[-1]].leader)
    end = chain[-1]
    if end in chain[:-1]:
        problem = "couplings are circular"
        got = " → ".join(chain)
    else:
        problem = "this joint on the path to the tool follows one that cannot move"
        kinds = {other.get("name"): other.get("type") for other in file.root.findall("joint")}
        kind = kinds.get(end)
        state = "does not exist" if kind is None else f"is {kind}"
        got = f"'{end}', which {state}"
    return make_element_error(
        file.path,
        mimics[joint].element,
        problem,
        field=joint,
        expected="a revolute, continuous or prismatic joint",
        got=got,
    )


def find_coupled_groups(
    full: pin.Model, file: UrdfFile, tool_frame: str
) -> dict[str, dict[str, JointCoupling]]:
    """Return leader → its followers, for all groups with a joint on the path to the tool."""
    groups = dict[str, dict[str, JointCoupling]]()
    for joint, coupling in find_followers(file.root).items():
        if coupling.factor:
            group = groups.setdefault(coupling.leader, {})
            group[joint] = coupling
    path = {str(full.names[j]) for j in find_joint_path(full, tool_frame)}
    return {leader: group for leader, group in groups.items() if path & {leader, *group}}


def apply_couplings(
    file: UrdfFile, couplings: Mapping[str, CouplingSchema], document: Document
) -> None:
    """Replace <mimic> elements of a URDF by the couplings of a robot.yaml.

    Args:
        file: The URDF, changed in place.
        couplings: Follower → coupling.
        document: The robot.yaml, for error messages.
    """
    movable = _find_movable_joints(file.root)
    for joint, coupling in couplings.items():
        field = ("couplings", joint)
        for name in (joint, coupling.joint):
            if name not in movable:
                kind = "joint that turns or slides"
                raise document.make_unknown_name_error(field, kind, name, movable)
        element = movable[joint]
        for mimic in element.findall("mimic"):
            element.remove(mimic)
        ElementTree.SubElement(
            element,
            "mimic",
            joint=coupling.joint,
            multiplier=repr(coupling.multiplier),
            offset=repr(coupling.offset),
        )
    mimics = _read_mimics(file.root)
    for joint, coupling in couplings.items():
        if _resolve_coupling(joint, mimics, movable, any_leader=True) is None:
            raise document.make_error(
                ("couplings", joint),
                "couplings are circular",
                expected="a leader that follows no joint",
                got=coupling.joint,
            )


def find_joint_path(full: pin.Model, frame: str) -> list[int]:
    """Return the indices of the joints from the world to a frame of a robot."""
    named = [other for other in full.frames if other.name == frame]
    # A link is preferred over a joint of the same name.
    links = [other for other in named if other.type == pin.FrameType.BODY]
    chosen = links[0] if links else named[0]
    return list(full.supports[chosen.parentJoint])


def _read_mimics(root: ElementTree.Element) -> dict[str, _Mimic]:
    """Return the <mimic> element of each joint that has one."""
    found = {}
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            leader = mimic.get("joint", "")
            factor = float(mimic.get("multiplier", "1"))
            offset = float(mimic.get("offset", "0"))
            found[joint.get("name", "")] = _Mimic(leader, factor, offset, mimic)
    return found


def _find_movable_joints(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    found = {}
    for joint in root.findall("joint"):
        if joint.get("type") in _MOVING:
            found[joint.get("name", "")] = joint
    return found


def _resolve_coupling(
    joint: str,
    mimics: Mapping[str, _Mimic],
    movable: Mapping[str, ElementTree.Element],
    *,
    any_leader: bool = False,
) -> JointCoupling | None:
    """Return the coupling of a joint to its leader at the end of the chain, None for a circle.

    If p = f l + o, and l follows a joint at m with l = g m + c, then p = (f g) m + (o + f c).

    Args:
        joint: Name of the joint.
        mimics: Joint → its <mimic> element.
        movable: Movable joints.
        any_leader: Return the coupling even if its leader cannot move.
    """
    leader = joint
    factor = 1.0
    offset = 0.0
    visited = set[str]()
    while leader in mimics and leader in movable:
        if leader in visited:
            return None
        visited.add(leader)
        mimic = mimics[leader]
        offset = offset + factor * mimic.offset
        factor = factor * mimic.factor
        leader = mimic.leader
    return JointCoupling(leader, factor, offset) if any_leader or leader in movable else None


def _find_ancestors(root: ElementTree.Element, joint: str) -> list[str]:
    """Return the ancestors of a joint, from the root on."""
    parent_links = dict[str, str]()  # joint → link that carries it
    carrying_joints = dict[str, str]()  # link → joint that carries it
    for other in root.findall("joint"):
        name = other.get("name", "")
        parent = other.find("parent")
        child = other.find("child")
        if parent is not None:
            parent_links[name] = parent.get("link", "")
        if child is not None:
            carrying_joints[child.get("link", "")] = name
    found = list[str]()
    ancestor = carrying_joints.get(parent_links[joint])
    while ancestor is not None:
        found.insert(0, ancestor)
        ancestor = carrying_joints.get(parent_links[ancestor])
    return found


def add_mimics(
    model: pin.Model, couplings: Sequence[JointCoupling], joints: Sequence[int]
) -> pin.Model:
    """Return a model in which some joints are mimic joints.

    Args:
        model: A model in which they are ordinary joints.
        couplings: Coupling of each mimic joint.
        joints: Indices of the mimic joints, larger than those of their leaders.
    """
    for coupling, joint in zip(couplings, joints, strict=True):
        leader = model.getJointId(coupling.leader)
        model = pin.transformJointIntoMimic(model, leader, joint, coupling.factor, coupling.offset)
    return model


def sort_joints(full: pin.Model, before: Mapping[int, Collection[int]]) -> list[int]:
    """Return the joint indices of a model in topological order, otherwise unchanged.

    Args:
        full: The model; its universe is omitted.
        before: Joint → joints that must come before it, such as its leader.
    """
    order = list[int]()
    waiting = list(range(1, full.njoints))
    while waiting:
        ready = {0, *order}
        later = []
        for joint in waiting:
            if full.parents[joint] in ready and ready.issuperset(before.get(joint, ())):
                ready.add(joint)
                order.append(joint)
            else:
                later.append(joint)
        if len(later) == len(waiting):
            names = [str(full.names[joint]) for joint in later if joint in before]
            raise InputError(
                "leaders are descendants of each other's followers",
                field=", ".join(names),
                expected="leaders nearer to the base than their followers",
            )
        waiting = later
    return order


def tighten_coupled_limits(full: pin.Model, file: UrdfFile, tool_frame: str) -> pin.Model:
    """Return a model in which the limits of leaders respect the limits of their followers.

    Only groups with a joint on the path to the tool are considered. Continuous joints among them
    become revolute ones with infinite limits, since a full turn changes the followers' positions.

    Args:
        full: The robot with all joints.
        file: Its URDF.
        tool_frame: Name of the tool frame.
    """
    check_followers(full, file, tool_frame)
    groups = find_coupled_groups(full, file, tool_frame)
    if not groups:
        return full
    members = {*groups, *itertools.chain.from_iterable(groups.values())}
    model = _replace_continuous_joints(full, members)
    lower = model.lowerPositionLimit
    upper = model.upperPositionLimit
    for leader, group in groups.items():
        index = model.joints[model.getJointId(leader)].idx_q
        for joint, coupling in group.items():
            i = model.joints[model.getJointId(joint)].idx_q
            # p = f l + o at the position l of the leader; a negative f exchanges the bounds.
            # A sum with +0.0 has no negative zero, which would lie below a lower limit of 0.
            at_lower = (lower[i] - coupling.offset) / coupling.factor + 0.0
            at_upper = (upper[i] - coupling.offset) / coupling.factor + 0.0
            low, high = sorted((at_lower, at_upper))
            common_low = max(low, lower[index])
            common_high = min(high, upper[index])
            if common_low > common_high + LIMIT_SLACK:
                problem = f"no position satisfies the limits of its follower '{joint}'"
                expected = f"limits that overlap {low:g} to {high:g}"
                got = f"{lower[index]:g} to {upper[index]:g}"
                raise InputError(problem, file=file.path, field=leader, expected=expected, got=got)
            if common_low >= common_high and lower[index] < upper[index]:
                warnings.warn(
                    f"{file.path}: {leader}: the limits of its follower '{joint}' leave it at "
                    f"{common_low:g}: they allow {low:g} to {high:g}, its own "
                    f"{lower[index]:g} to {upper[index]:g}",
                    stacklevel=2,
                )
            lower[index] = common_low + 0.0
            upper[index] = max(common_low, common_high) + 0.0
    model.lowerPositionLimit = lower
    model.upperPositionLimit = upper
    return model


def apply_robot_limits(
    full: pin.Model, model: pin.Model, settings: RobotSchema, base: str
) -> tuple[Coordinates, Floats, Floats, Floats, Floats]:
    """Write the limits of a robot.yaml into a model, and return them.

    Args:
        full: The robot with all joints, see `tighten_coupled_limits`.
        model: The planned joints; changed in place.
        settings: The robot.yaml.
        base: Type of the base.

    Returns:
        Coordinates, lower and upper position limits, velocity and acceleration limits, shape (n,)
        each.
    """
    # The first two entries of q are the position of the base.
    position_lower = model.lowerPositionLimit
    position_upper = model.upperPositionLimit
    if base == "fixed":
        position_lower[:2] = 0.0
        position_upper[:2] = 0.0
    else:
        position_lower[:2], position_upper[:2] = np.array(settings.base.position).T
    model.lowerPositionLimit = position_lower
    model.upperPositionLimit = position_upper
    velocity = np.full(model.nv, np.inf)
    velocity[:3] = settings.base.velocity
    acceleration = np.full(model.nv, np.inf)
    acceleration[:3] = settings.base.acceleration
    coordinates = Coordinates(model)
    for move in coordinates.moves[3:]:
        name = model.names[move.joint]
        k = move.coordinate
        # A joint moves at `factor` times the rate of its coordinate.
        factor = abs(move.factor)
        joint_settings = settings.joints.get(name)
        urdf_velocity = float(full.velocityLimit[full.joints[full.getJointId(name)].idx_v])
        if joint_settings is not None and joint_settings.velocity is not None:
            velocity[k] = min(velocity[k], joint_settings.velocity / factor)
        # Pinocchio stores the largest float for joints without a limit.
        elif 0.0 < urdf_velocity < _MAX_URDF_VELOCITY:
            velocity[k] = min(velocity[k], urdf_velocity / factor)
        if joint_settings is not None and joint_settings.acceleration is not None:
            acceleration[k] = min(acceleration[k], joint_settings.acceleration / factor)
    default_velocity = coordinates.compute_max_steps(DEFAULT_SLIDE_VELOCITY, DEFAULT_JOINT_VELOCITY)
    velocity = np.where(np.isinf(velocity), default_velocity, velocity)
    # Rates at which the fastest joint moves at 1 m/s or 1 rad/s.
    unit_rates = coordinates.compute_max_steps(1.0, 1.0)
    default_acceleration = _DEFAULT_JOINT_ACCELERATION * unit_rates
    acceleration = np.where(np.isinf(acceleration), default_acceleration, acceleration)
    model.velocityLimit = velocity
    model.effortLimit = _read_torque_limits(model, coordinates, settings)
    lower = coordinates.lower.copy()
    upper = coordinates.upper.copy()
    if base == "fixed":
        lower[:3] = 0.0
        upper[:3] = 0.0
    return Coordinates(model), lower, upper, velocity.copy(), acceleration


def _read_torque_limits(
    model: pin.Model, coordinates: Coordinates, settings: RobotSchema
) -> Floats:
    """Return the effort limits, shape (n,) [N·m], [N]; coupled joints have that of their leader."""
    effort = model.effortLimit
    for k, joint in enumerate(coordinates.joints):
        joint_settings = settings.joints.get(model.names[joint])
        if joint_settings is not None and joint_settings.effort is not None:
            effort[k] = joint_settings.effort
    return np.asarray(effort)


def _replace_continuous_joints(full: pin.Model, joints: Set[str]) -> pin.Model:
    """Return a copy of a model in which some continuous joints are revolute, without limits."""
    model = pin.Model()
    model.name = full.name
    data = full.createData()
    pin.forwardKinematics(full, data, pin.neutral(full))
    for j in range(1, full.njoints):
        joint = full.joints[j]
        name = str(full.names[j])
        q = slice(joint.idx_q, joint.idx_q + joint.nq)
        v = slice(joint.idx_v, joint.idx_v + joint.nv)
        lower = full.lowerPositionLimit[q]
        upper = full.upperPositionLimit[q]
        # A continuous joint has (cos θ, sin θ) in q.
        if name in joints and joint.nq == 2:
            # The motion subspace S has the linear velocity, then the angular one.
            axis = np.asarray(data.joints[j].S, float).ravel()[3:]
            joint = pin.JointModelRevoluteUnaligned(axis)
            lower = np.array([-np.inf])
            upper = np.array([np.inf])
        model.addJoint(
            full.parents[j],
            joint,
            full.jointPlacements[j],
            name,
            full.effortLimit[v],
            full.velocityLimit[v],
            lower,
            upper,
        )
        model.appendBodyToJoint(j, full.inertias[j], pin.SE3.Identity())
    for frame in full.frames[1:]:
        model.addFrame(frame, False)
    return model
