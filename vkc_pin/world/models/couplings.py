"""Couples joints, from <mimic> in a URDF or `couplings` in a robot.yaml."""

from __future__ import annotations

import itertools
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass

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


def find_followers(root: ElementTree.Element) -> dict[str, JointCoupling]:
    """Return the coupling of each joint of a URDF that follows another one.

    Chains of couplings are resolved to their leader. If a leader is a descendant of one of its
    followers, the follower nearest to the root becomes the leader. Couplings to joints that do not
    exist or do not move, and circular ones, are ignored; `check_followers` reports them.
    """
    mimics, movable = _read_mimics(root), _find_movable_joints(root)
    found = {
        joint: coupling
        for joint in mimics
        if joint in movable and (coupling := _resolve_coupling(joint, mimics, movable)) is not None
    }
    for leader in dict.fromkeys(coupling.leader for coupling in found.values()):
        group = {
            joint
            for joint, coupling in found.items()
            if coupling.leader == leader and coupling.factor
        }
        ancestors = [joint for joint in _find_ancestors(root, leader) if joint in group]
        if ancestors:
            first, coupling = ancestors[0], found.pop(ancestors[0])
            found[leader] = JointCoupling(leader, 1.0, 0.0)
            for joint, other in [item for item in found.items() if item[1].leader == leader]:
                factor = other.factor / coupling.factor
                found[joint] = JointCoupling(first, factor, other.offset - factor * coupling.offset)
    return found


def check_followers(full: pin.Model, file: UrdfFile, tool_frame: str) -> None:
    """Check that the leaders of all joints on the path to the tool exist and can move."""
    mimics = _read_mimics(file.root)
    movable = _find_movable_joints(file.root)
    found = find_followers(file.root)
    leaders = {coupling.leader for coupling in found.values()}
    for joint in (str(full.names[j]) for j in find_joint_path(full, tool_frame)):
        if joint in mimics and joint in movable and joint not in found and joint not in leaders:
            element, expected = mimics[joint][3], "a revolute, continuous or prismatic joint"
            chain = [joint]
            while chain[-1] in mimics and chain[-1] in movable and chain[-1] not in chain[:-1]:
                chain.append(mimics[chain[-1]][0])
            if chain[-1] in chain[:-1]:
                problem, got = "couplings are circular", " → ".join(chain)
            else:
                kinds = {j.get("name"): j.get("type") for j in file.root.findall("joint")}
                kind = kinds.get(chain[-1])
                problem = "this joint on the path to the tool follows one that cannot move"
                got = (
                    f"'{chain[-1]}', which does not exist"
                    if kind is None
                    else f"'{chain[-1]}', which is {kind}"
                )
            raise make_element_error(
                file.path, element, problem, field=joint, expected=expected, got=got
            )


def find_coupled_groups(
    full: pin.Model, file: UrdfFile, tool_frame: str
) -> dict[str, dict[str, JointCoupling]]:
    """Return leader → its followers, for all groups with a joint on the path to the tool."""
    follows = find_followers(file.root)
    path = {str(full.names[j]) for j in find_joint_path(full, tool_frame)}
    groups: dict[str, dict[str, JointCoupling]] = {}
    for joint, coupling in follows.items():
        if coupling.factor:
            groups.setdefault(coupling.leader, {})[joint] = coupling
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
        for name in (joint, coupling.joint):
            if name not in movable:
                raise document.make_unknown_name_error(
                    ("couplings", joint), "joint that turns or slides", name, movable
                )
        for mimic in movable[joint].findall("mimic"):
            movable[joint].remove(mimic)
        multiplier, offset = repr(coupling.multiplier), repr(coupling.offset)
        ElementTree.SubElement(
            movable[joint], "mimic", joint=coupling.joint, multiplier=multiplier, offset=offset
        )
    mimics = _read_mimics(file.root)
    for joint, coupling in couplings.items():
        if _resolve_coupling(joint, mimics, movable, any_leader=True) is None:
            problem, expected = "couplings are circular", "a leader that follows no joint"
            raise document.make_error(
                ("couplings", joint), problem, expected=expected, got=coupling.joint
            )


def find_joint_path(full: pin.Model, frame: str) -> list[int]:
    """Return the indices of the joints from the world to a frame of a robot."""
    named = [other for other in full.frames if other.name == frame]
    # A link is preferred over a joint of the same name.
    link = next((other for other in named if other.type == pin.FrameType.BODY), named[0])
    return list(full.supports[link.parentJoint])


def _read_mimics(
    root: ElementTree.Element,
) -> dict[str, tuple[str, float, float, ElementTree.Element]]:
    """Return joint → (leader, factor, offset, <mimic> element)."""
    found = {}
    for joint in root.findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            factor, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            found[joint.get("name", "")] = (mimic.get("joint", ""), factor, offset, mimic)
    return found


def _find_movable_joints(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    return {
        joint.get("name", ""): joint
        for joint in root.findall("joint")
        if joint.get("type") in _MOVING
    }


def _resolve_coupling(
    joint: str,
    mimics: Mapping[str, tuple[str, float, float, ElementTree.Element]],
    movable: Mapping[str, ElementTree.Element],
    *,
    any_leader: bool = False,
) -> JointCoupling | None:
    """Return the coupling of a joint to its leader at the end of the chain."""
    leader, factor, offset, visited = joint, 1.0, 0.0, set[str]()
    while leader in mimics and leader in movable:
        if leader in visited:
            return None
        visited.add(leader)
        next_leader, multiplier, added_offset, _ = mimics[leader]
        leader, factor, offset = next_leader, factor * multiplier, offset + factor * added_offset
    return JointCoupling(leader, factor, offset) if any_leader or leader in movable else None


def _find_ancestors(root: ElementTree.Element, joint: str) -> list[str]:
    """Return the ancestors of a joint, from the root on."""
    ends = {
        key: {
            other.get("name", ""): end.get("link", "")
            for other in root.findall("joint")
            if (end := other.find(key)) is not None
        }
        for key in ("parent", "child")
    }
    carries = {link: name for name, link in ends["child"].items()}
    found: list[str] = []
    while (parent := carries.get(ends["parent"][found[0] if found else joint])) is not None:
        found.insert(0, parent)
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
        model = pin.transformJointIntoMimic(
            model, model.getJointId(coupling.leader), joint, coupling.factor, coupling.offset
        )
    return model


def sort_joints(full: pin.Model, before: Mapping[int, Collection[int]]) -> list[int]:
    """Return the joint indices of a model in topological order, otherwise unchanged.

    Args:
        full: The model; its universe is omitted.
        before: Joint → joints that must come before it, such as its leader.
    """
    order, waiting = list[int](), list(range(1, full.njoints))
    while waiting:
        ready = set[int]({0, *order})
        later = []
        for j in waiting:
            if full.parents[j] in ready and ready.issuperset(before.get(j, ())):
                ready.add(j)
                order.append(j)
            else:
                later.append(j)
        if len(later) == len(waiting):
            names = ", ".join(str(full.names[j]) for j in later if j in before)
            raise InputError(
                "leaders are descendants of each other's followers",
                field=names,
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
    model = _bound_continuous_joints(
        full, {*groups, *itertools.chain.from_iterable(groups.values())}
    )
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    for leader, group in groups.items():
        index = model.joints[model.getJointId(leader)].idx_q
        for joint, coupling in group.items():
            i = model.joints[model.getJointId(joint)].idx_q
            low, high = sorted(
                (bound - coupling.offset) / coupling.factor + 0.0 for bound in (lower[i], upper[i])
            )
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
            # A sum with +0.0 has no negative zero, which would lie below a lower limit of 0.
            lower[index] = common_low + 0.0
            upper[index] = max(common_low, common_high) + 0.0
    model.lowerPositionLimit, model.upperPositionLimit = lower, upper
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
    low, high = (
        np.array(settings.base.position).T if base != "fixed" else (np.zeros(2), np.zeros(2))
    )
    position_low, position_high = model.lowerPositionLimit, model.upperPositionLimit
    position_low[:2], position_high[:2] = low, high
    model.lowerPositionLimit, model.upperPositionLimit = position_low, position_high
    velocity, acceleration = np.full(model.nv, np.inf), np.full(model.nv, np.inf)
    velocity[:3], acceleration[:3] = settings.base.velocity, settings.base.acceleration
    coordinates = Coordinates(model)
    # Rates at which the fastest joint moves at 1 m/s or 1 rad/s.
    unit_rates = coordinates.compute_max_steps(1.0, 1.0)
    default_velocity = coordinates.compute_max_steps(DEFAULT_SLIDE_VELOCITY, DEFAULT_JOINT_VELOCITY)
    for move in coordinates.moves[3:]:
        name, k, factor = model.names[move.joint], move.coordinate, abs(move.factor)
        joint_settings = settings.joints.get(name)
        urdf_velocity = float(full.velocityLimit[full.joints[full.getJointId(name)].idx_v])
        if joint_settings is not None and joint_settings.velocity is not None:
            velocity[k] = min(velocity[k], joint_settings.velocity / factor)
        # Pinocchio stores the largest float for joints without a limit.
        elif 0.0 < urdf_velocity < 1e3:
            velocity[k] = min(velocity[k], urdf_velocity / factor)
        if joint_settings is not None and joint_settings.acceleration is not None:
            acceleration[k] = min(acceleration[k], joint_settings.acceleration / factor)
    velocity = np.where(np.isinf(velocity), default_velocity, velocity)
    acceleration = np.where(
        np.isinf(acceleration), _DEFAULT_JOINT_ACCELERATION * unit_rates, acceleration
    )
    model.velocityLimit = velocity
    model.effortLimit = _read_torque_limits(model, coordinates, settings)
    lower, upper = coordinates.lower.copy(), coordinates.upper.copy()
    if base == "fixed":
        lower[:3] = upper[:3] = 0.0
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


def _bound_continuous_joints(full: pin.Model, joints: Set[str]) -> pin.Model:
    """Return a copy of a model in which some continuous joints are revolute, without limits."""
    model, data = pin.Model(), full.createData()
    model.name = full.name
    pin.forwardKinematics(full, data, pin.neutral(full))
    for j in range(1, full.njoints):
        joint = full.joints[j]
        name = str(full.names[j])
        limits = (full.lowerPositionLimit, full.upperPositionLimit)
        parts = [bound[joint.idx_q : joint.idx_q + joint.nq] for bound in limits]
        if name in joints and joint.nq == 2:
            axis = np.asarray(data.joints[j].S, float).ravel()[3:]
            joint = pin.JointModelRevoluteUnaligned(axis)
            parts = [np.array([-np.inf]), np.array([np.inf])]
        v = slice(full.joints[j].idx_v, full.joints[j].idx_v + full.joints[j].nv)
        model.addJoint(
            full.parents[j],
            joint,
            full.jointPlacements[j],
            name,
            full.effortLimit[v],
            full.velocityLimit[v],
            *parts,
        )
        model.appendBodyToJoint(j, full.inertias[j], pin.SE3.Identity())
    for frame in full.frames[1:]:
        model.addFrame(frame, False)
    return model
