"""Finds the arms of a robot from the structure of its joint tree and from names."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.description import MOVING_KINDS
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.words import list_words, split_words
from vkc_pin.world.files.srdf import SrdfGroup
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.robot_model import build_full_model, find_joint_limits
from vkc_pin.world.models.wheels import has_wheel_name

_FINGER = 7  # largest number of joints of a finger
_ARM = 3  # smallest number of joints of an arm with a hand; one more without a hand
_BESIDE = 0.5  # smallest length of a palm beside a jaw, relative to the jaw's
_JAW_ANGLES = np.linspace(-0.8, 0.8, 9)  # [rad]
_POINTS = 120  # sampled points of a link
_LEVEL = 0.01  # sine of the largest slope of a floor, and of an axis that counts as vertical
_PARALLEL = 1.0 - 1e-6  # smallest cosine between the axes of a telescope's segments
_HAND_WORDS = list_words("finger thumb gripper jaw knuckle claw fngr grip")
_ARM_WORDS = list_words("arm openarm xarm shoulder elbow wrist hand gripper ur panda lift flange")
_TRUNK_WORDS = list_words("shoulder elbow arm neck head hip")
_WRIST_WORDS = list_words("wrist yaw roll pitch")
_OTHER_WORDS = list_words(
    "leg hip knee ankle foot feet thigh calf shank haa hfe kfe hx hy kn toe wheel caster castor "
    "head neck eye ear camera antenna tail propeller propellor rotor laser"
)
_SIDES = {"left": {"left", "l"}, "right": {"right", "r"}}
_LONGEST_LIFT = 10.0  # [m] travel beyond which a vertical slide is no lift


@dataclass(eq=False)
class Body:
    """Links that fixed joints connect rigidly.

    Attributes:
        links: Names of the links, the one nearest to the root first.
        joint: Parent joint, None for the root.
        parent: Parent body.
        children: Child bodies.
    """

    links: list[str]
    joint: ElementTree.Element | None = None
    parent: Body | None = None
    children: list[Body] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name of the parent joint, "" for the root."""
        return "" if self.joint is None else self.joint.get("name", "")

    @property
    def is_planned(self) -> bool:
        """Whether the parent joint can be planned: it moves by one independent coordinate."""
        return (
            self.joint is not None
            and self.joint.get("type") in MOVING_KINDS
            and self.joint.find("mimic") is None
        )

    def path(self) -> list[Body]:
        """Return the bodies from the first one below the root to this one."""
        return [] if self.parent is None else [*self.parent.path(), self]

    def subtree(self) -> list[Body]:
        """Return this body and all its descendants."""
        return [self, *(body for child in self.children for body in child.subtree())]

    def depth(self) -> int:
        """Return the largest number of planned joints on a path below this body."""
        return max((child.is_planned + child.depth() for child in self.children), default=0)


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm.

    Attributes:
        name: "left", "right", the name of its SRDF group, or that of the body with the hand.
        joints: Planned joints from the root on, without those of a base in the file.
        palm: Body at its end, to which the fingers are attached.
        fingers: First body of each finger.
        sure: Confidence: "sure", "likely" or "guess".
        why: Evidence.
        score: Rank among the arms.
    """

    name: str
    joints: tuple[str, ...]
    palm: Body
    fingers: tuple[Body, ...]
    sure: str
    why: str
    score: float


def build_body_tree(file: UrdfFile) -> Body:
    """Return the root of a robot's tree of bodies."""
    below: dict[str, list[ElementTree.Element]] = {}
    children = set()
    for joint in file.root.findall("joint"):
        below.setdefault(_get_link(joint, "parent"), []).append(joint)
        children.add(_get_link(joint, "child"))
    root = Body([next(link for link in file.links if link not in children)])
    waiting = [root]
    while waiting:
        body = waiting.pop(0)
        for link in body.links:  # the list grows in the loop
            for joint in below.get(link, ()):
                if joint.get("type") == "fixed":
                    body.links.append(_get_link(joint, "child"))
                else:
                    body.children.append(Body([_get_link(joint, "child")], joint, body))
        waiting += body.children
    return root


def find_own_base(file: UrdfFile, root: Body, solid: Set[str]) -> tuple[str, ...]:
    """Return the joints of a mobile base in the robot's file.

    These are at least two joints in sequence from the root whose parent links have no shapes, and
    that slide along the floor, slide without a lift's limits, or rotate about the vertical. Lifts
    belong to the arm. If the robot has wheels, all joints in that sequence belong to the base, as
    they carry the wheels.
    """
    full = build_full_model(file)
    data, joints, body = full.createData(), list[str](), root
    pin.computeJointJacobians(full, data, pin.neutral(full))
    carries_wheels = any(has_wheel_name(joint) for joint in file.root.findall("joint"))
    while len(body.children) == 1 and not solid & set(body.links):
        body = body.children[0]
        number = full.getJointId(body.name)
        if full.joints[number].nv != 1:
            break
        jacobian = pin.getJointJacobian(full, data, number, pin.LOCAL_WORLD_ALIGNED)
        slide, turn = np.split(np.abs(jacobian[:, full.joints[number].idx_v]), 2)
        slides_level = not turn.any() and slide[2] < _LEVEL
        slides_far = not turn.any() and np.ptp(find_joint_limits(full, body.name)) > _LONGEST_LIFT
        turns_upright = turn[2] > 1.0 - _LEVEL
        if not (slides_level or slides_far or turns_upright or carries_wheels):
            break
        joints.append(body.name)
    return tuple(joints) if len(joints) > 1 or carries_wheels else ()


def find_arms(
    file: UrdfFile, root: Body, groups: Mapping[str, SrdfGroup], solid: Set[str]
) -> list[Arm]:
    """Find the arms of a robot, best first.

    A hand is a body below at least three joints with fingers: at least two of at most seven joints
    each, or one that is named as a jaw. Chains without a hand are arms if they have four joints and
    are not named as legs, heads or wheels.
    """
    base = find_own_base(file, root, solid)
    everything, arms = root.subtree(), []
    palms: list[Body] = []
    for body in everything:
        if (
            any(above in palms for above in body.path()[:-1])
            or len(_find_planned_joints(body, base)) < _ARM
        ):
            continue
        if _is_palm(body, file):
            palms.append(body)
    inside = {id(below) for palm in palms for below in palm.subtree()}
    carrying = {id(above) for palm in palms for above in palm.path()}
    tips = [body for body in everything if not body.children and id(body) not in inside | carrying]
    for body in palms + tips:
        fingers = _find_fingers(body, solid)
        joints = _find_planned_joints(body, base)
        own = [*joints[-5:], *body.links[:2]]
        other = sum(_has_word(name, _OTHER_WORDS) for name in own)
        words = sum(_has_word(name, _ARM_WORDS) for name in own)
        if not joints or other > words or (body in tips and (len(joints) <= _ARM or other)):
            continue
        score = 3.0 * bool(fingers) + 2.0 * bool(words) + min(len(joints), 7) / 7.0
        sure = (
            "sure"
            if fingers and words and len(joints) > _ARM
            else "likely"
            if fingers or words
            else "guess"
        )
        why = f"{len(joints)} joints, " + (f"{len(fingers)} fingers" if fingers else "no fingers")
        why += ", named as an arm" if words else ""
        arms.append(
            Arm(_choose_name(joints, body, groups), joints, body, fingers, sure, why, score)
        )
    if sum(arm.sure == "guess" for arm in arms) > 2:  # fingers of a hand, legs
        arms = [arm for arm in arms if arm.sure != "guess"]
    arms.sort(key=lambda arm: -arm.score)
    names = [arm.name for arm in arms]
    return [
        arm if names.count(arm.name) == 1 else replace(arm, name=arm.palm.links[0]) for arm in arms
    ]


def choose_arm(
    arms: Sequence[Arm],
    name: str | None,
    file: UrdfFile,
    root: Body,
    groups: Mapping[str, SrdfGroup],
    solid: Set[str],
) -> Arm:
    """Choose the arm with a name, of an SRDF group, whose name contains it, or the best one.

    Args:
        arms: The arms that were found.
        name: The name, or None.
        file: The robot's file.
        root: Its tree, see `build_body_tree`.
        groups: The groups of its SRDF.
        solid: Links with collision shapes.
    """
    group = None if name is None else groups.get(name)
    if not arms and group is None:
        expected = (
            "at least four joints in a chain, or a hand after three; or the name of a tool_frame"
        )
        raise InputError("no arm was found", file=file.path, expected=expected)
    if name is None:
        return arms[0]
    fitting = [arm for arm in arms if arm.name == name]
    if group is not None:
        members = set(group.joints)
        fitting = fitting or [arm for arm in arms if _get_last_joints(arm.joints) <= members]
        stated = _make_arm_of_group(name, group, file, root, solid)
        fitting = fitting or [arm for arm in arms if stated and arm.palm.links == stated.palm.links]
        if stated is not None:
            fitting.append(stated)
    fitting = fitting or [arm for arm in arms if name.lower() in arm.name.lower()]
    if not fitting:
        also = [
            other
            for other, listed in groups.items()
            if any(_get_last_joints(arm.joints) <= set(listed.joints) for arm in arms)
        ]
        raise UnknownNameError(
            "arm",
            name,
            dict.fromkeys([*(arm.name for arm in arms), *also]),
            file=file.path,
            field="arm",
        )
    return fitting[0]


def _make_arm_of_group(
    name: str, group: SrdfGroup, file: UrdfFile, root: Body, solid: Set[str]
) -> Arm | None:
    """Return the arm that ends at the tip of a group, or with the hand around it, if it moves."""
    tip = next(body for body in root.subtree() if group.tip in body.links)
    palms = [body for body in tip.path() if _is_palm(body, file)]
    palm = palms[0] if palms else tip
    joints = _find_planned_joints(palm, find_own_base(file, root, solid))
    if not joints:
        return None
    fingers = _find_fingers(palm, solid) if palms else ()
    count = f"{len(fingers)} fingers" if fingers else "no fingers"
    why = f"{len(joints)} joints, {count}, a group of the SRDF"
    return Arm(name, joints, palm, fingers, "sure", why, 0.0)


def _find_fingers(palm: Body, solid: Set[str]) -> tuple[Body, ...]:
    """Return the first bodies of the fingers with shapes."""
    return tuple(
        child
        for child in palm.children
        if any(solid & set(below.links) for below in child.subtree())
    )


def find_telescopes(full: pin.Model, joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Find telescopes: consecutive prismatic joints of an arm with equal axes and limits.

    One motor moves all segments of a telescope.
    """
    data, telescopes = full.createData(), list[list[str]]()
    pin.forwardKinematics(full, data, pin.neutral(full))
    before, along = 0, np.zeros(3)
    for name in joints:
        number = full.getJointId(name)
        # The axis is zero for revolute joints.
        axis = data.oMi[number].rotation @ np.asarray(data.joints[number].S, float).ravel()[:3]
        bounds = (full.lowerPositionLimit, full.upperPositionLimit)
        if (
            full.parents[number] == before
            and axis @ along > _PARALLEL
            and all(
                np.isclose(bound[full.joints[number].idx_q], bound[full.joints[before].idx_q])
                for bound in bounds
            )
        ):
            telescopes[-1].append(name)
        else:
            telescopes.append([name])
        before, along = number, axis
    return [tuple(group) for group in telescopes if len(group) > 1]


def _get_last_joints(joints: Sequence[str]) -> set[str]:
    """Return the joints that identify an arm."""
    return set(joints[-4:])


def _is_palm(body: Body, file: UrdfFile) -> bool:
    """Return whether a body has fingers: two or more, or one that is named as a jaw."""
    if (
        not body.children
        or body.depth() > _FINGER
        or not any(below.is_planned for below in body.subtree()[1:])
    ):
        return False
    names = [f"{child.name} {child.links[0]}" for child in body.children]
    # A finger may have its arm's name before its own.
    if any(_has_word(name, _TRUNK_WORDS) and not _has_word(name, _HAND_WORDS) for name in names):
        return False
    if len(body.children) == 1:
        jaw = body.children[0]
        return (
            _has_word(names[0], _HAND_WORDS)
            and not _has_word(jaw.name, _WRIST_WORDS)
            and not jaw.children
            and _has_jaw_beside(body, jaw, file)
        )
    named = any(_has_word(name, _HAND_WORDS) for name in names)
    return named or not any(_has_word(name, _OTHER_WORDS) for name in names)


def _has_word(name: str, words: Set[str]) -> bool:
    return not words.isdisjoint(split_words(name))


def _has_jaw_beside(palm: Body, jaw: Body, file: UrdfFile) -> bool:
    """Return whether a palm extends beside a jaw, which closes against it, rather than behind it.

    What turns about its own length, such as the last link of a wrist, is no jaw.
    """
    full = build_full_model(file)
    data = full.createData()
    pin.framesForwardKinematics(full, data, pin.neutral(full))
    points = {
        link: corners @ place.rotation.T + place.translation
        for link, corners in sample_points(file, [*palm.links, *jaw.links]).items()
        for place in (data.oMf[full.getFrameId(link, pin.FrameType.BODY)],)
    }
    own, others = ([points[link] for link in body.links if link in points] for body in (jaw, palm))
    if not (own and others):
        return False
    number = full.getJointId(jaw.name)
    base, motion = data.oMi[number], np.asarray(data.joints[number].S, float).ravel()
    axis = base.rotation @ (motion[3:] if motion[3:].any() else np.zeros(3))
    ahead = np.vstack(own) - base.translation
    centre = ahead.mean(axis=0)
    across = centre - (centre @ axis) * axis
    if np.linalg.norm(across) < abs(centre @ axis):
        return False
    across /= np.linalg.norm(across)
    reach = float((ahead @ across).max())
    beside = np.vstack(others) - base.translation
    # A palm lies where the jaw turns to rather than where it is.
    towards = [pin.exp3(angle * axis) @ across for angle in _JAW_ANGLES]
    return max(float((beside @ one).max()) for one in towards) > _BESIDE * reach


def _find_planned_joints(body: Body, base: Collection[str]) -> tuple[str, ...]:
    return tuple(above.name for above in body.path() if above.is_planned and above.name not in base)


def _choose_name(joints: Sequence[str], palm: Body, groups: Mapping[str, SrdfGroup]) -> str:
    """Return an arm's name: that of the smallest group with its joints, its side, or its palm."""
    last = _get_last_joints(joints)
    fitting = [name for name, group in groups.items() if last <= set(group.joints)]
    if fitting:
        return min(fitting, key=lambda name: (len(groups[name].joints), name))
    for side, words in _SIDES.items():
        if sum(_has_word(name, words) for name in [*joints[-3:], palm.links[0]]) >= 2:
            return side
    return palm.links[0]


def sample_points(file: UrdfFile, links: Sequence[str]) -> dict[str, Floats]:
    """Return points on links, shape (n, 3) in the link's frame [m]."""
    from trimesh.sample import sample_surface

    points_by_link: dict[str, Floats] = {}
    for kind in ("collision", "visual"):
        new: dict[str, list[Floats]] = {}
        for shape in file.read_shapes(kind):
            if shape.link in links and shape.link not in points_by_link:
                try:
                    mesh = shape.make_mesh()
                except InputError:
                    continue
                corners = np.asarray(mesh.vertices)
                # `Trimesh.sample` takes a seed from trimesh 5 on only.
                sampled = np.asarray(sample_surface(mesh, _POINTS, seed=0)[0])
                step = max(1, len(corners) // _POINTS)
                new.setdefault(shape.link, []).append(np.vstack([corners[::step], sampled]))
        points_by_link.update({link: np.vstack(points) for link, points in new.items()})
    return points_by_link


def _get_link(joint: ElementTree.Element, key: str) -> str:
    element = joint.find(key)
    return "" if element is None else element.get("link", "")
