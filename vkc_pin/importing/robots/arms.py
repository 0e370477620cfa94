"""Finds the arms of a robot from the structure of its joint tree and from names."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import Counter
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
_MOST_GUESSES = 2  # arms without fingers or a name


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
        if self.joint is None:
            return False
        return self.joint.get("type") in MOVING_KINDS and self.joint.find("mimic") is None

    def path(self) -> list[Body]:
        """Return the bodies from the first one below the root to this one."""
        return [] if self.parent is None else [*self.parent.path(), self]

    def subtree(self) -> list[Body]:
        """Return this body and all its descendants."""
        bodies = [self]
        for child in self.children:
            bodies += child.subtree()
        return bodies

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
    below = dict[str, list[ElementTree.Element]]()
    children = set[str]()
    for joint in file.root.findall("joint"):
        below.setdefault(_get_link(joint, "parent"), []).append(joint)
        children.add(_get_link(joint, "child"))
    root = Body([next(link for link in file.links if link not in children)])
    waiting = [root]
    while waiting:
        body = waiting.pop(0)
        # The list grows in the loop.
        for link in body.links:
            for joint in below.get(link, ()):
                child = _get_link(joint, "child")
                if joint.get("type") == "fixed":
                    body.links.append(child)
                else:
                    body.children.append(Body([child], joint, body))
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
    data = full.createData()
    pin.computeJointJacobians(full, data, pin.neutral(full))
    carries_wheels = any(has_wheel_name(joint) for joint in file.root.findall("joint"))
    joints = list[str]()
    body = root
    while len(body.children) == 1 and not solid & set(body.links):
        body = body.children[0]
        number = full.getJointId(body.name)
        if full.joints[number].nv != 1:
            break
        # The joint's column of the Jacobian (v, ω) along the world's axes; the third one is up.
        jacobian = pin.getJointJacobian(full, data, number, pin.LOCAL_WORLD_ALIGNED)
        slide, turn = np.split(np.abs(jacobian[:, full.joints[number].idx_v]), 2)
        is_slide = not turn.any()
        slides_level = is_slide and slide[2] < _LEVEL
        slides_far = is_slide and np.ptp(find_joint_limits(full, body.name)) > _LONGEST_LIFT
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
    palms = _find_palms(root, base, file)
    tips = _find_tips(root, palms)
    arms = list[Arm]()
    for body in palms + tips:
        joints = _find_planned_joints(body, base)
        own_names = [*joints[-5:], *body.links[:2]]
        other_words = sum(_has_word(name, _OTHER_WORDS) for name in own_names)
        arm_words = sum(_has_word(name, _ARM_WORDS) for name in own_names)
        if not joints or other_words > arm_words:
            continue
        if body in tips and (len(joints) <= _ARM or other_words):
            continue
        fingers = _find_fingers(body, solid)
        arms.append(_rate_arm(joints, body, fingers, groups, is_named=arm_words > 0))
    # More of them are fingers of a hand, or legs.
    if sum(arm.sure == "guess" for arm in arms) > _MOST_GUESSES:
        arms = [arm for arm in arms if arm.sure != "guess"]
    arms.sort(key=lambda arm: -arm.score)
    counts = Counter(arm.name for arm in arms)
    for k, arm in enumerate(arms):
        if counts[arm.name] > 1:
            arms[k] = replace(arm, name=arm.palm.links[0])
    return arms


def _find_palms(root: Body, base: Collection[str], file: UrdfFile) -> list[Body]:
    """Return the first bodies with fingers below at least three joints of an arm."""
    palms = list[Body]()
    for body in root.subtree():
        is_inside = any(above in palms for above in body.path()[:-1])
        is_far = len(_find_planned_joints(body, base)) >= _ARM
        if not is_inside and is_far and _is_palm(body, file):
            palms.append(body)
    return palms


def _find_tips(root: Body, palms: Sequence[Body]) -> list[Body]:
    """Return the last bodies of chains without a palm."""
    of_palms = set[int]()
    for palm in palms:
        of_palms.update(map(id, palm.subtree()))
        of_palms.update(map(id, palm.path()))
    return [body for body in root.subtree() if not body.children and id(body) not in of_palms]


def _rate_arm(
    joints: tuple[str, ...],
    palm: Body,
    fingers: tuple[Body, ...],
    groups: Mapping[str, SrdfGroup],
    *,
    is_named: bool,
) -> Arm:
    """Return an arm with confidence, evidence and rank: fingers count most, then its name."""
    score = 0.0
    why = f"{len(joints)} joints, {_count_fingers(fingers)}"
    if fingers:
        score += 3.0
    if is_named:
        score += 2.0
        why += ", named as an arm"
    score += min(len(joints), 7) / 7.0
    sure = "guess"
    if fingers and is_named and len(joints) > _ARM:
        sure = "sure"
    elif fingers or is_named:
        sure = "likely"
    return Arm(_choose_name(joints, palm, groups), joints, palm, fingers, sure, why, score)


def _count_fingers(fingers: Sequence[Body]) -> str:
    return f"{len(fingers)} fingers" if fingers else "no fingers"


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
        stated = _make_arm_of_group(name, group, file, root, solid)
        if not fitting:
            fitting = [arm for arm in arms if _has_arm(group, arm)]
        if not fitting and stated is not None:
            fitting = [arm for arm in arms if arm.palm.links == stated.palm.links]
        if stated is not None:
            fitting.append(stated)
    if not fitting:
        fitting = [arm for arm in arms if name.lower() in arm.name.lower()]
    if not fitting:
        names = [arm.name for arm in arms]
        for other, listed in groups.items():
            if any(_has_arm(listed, arm) for arm in arms):
                names.append(other)
        known = dict.fromkeys(names)
        raise UnknownNameError("arm", name, known, file=file.path, field="arm")
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
    why = f"{len(joints)} joints, {_count_fingers(fingers)}, a group of the SRDF"
    return Arm(name, joints, palm, fingers, "sure", why, 0.0)


def _find_fingers(palm: Body, solid: Set[str]) -> tuple[Body, ...]:
    """Return the first bodies of the fingers with shapes."""
    fingers = list[Body]()
    for child in palm.children:
        if any(solid & set(below.links) for below in child.subtree()):
            fingers.append(child)
    return tuple(fingers)


def find_telescopes(full: pin.Model, joints: Sequence[str]) -> list[tuple[str, ...]]:
    """Find telescopes: consecutive prismatic joints of an arm with equal axes and limits.

    One motor moves all segments of a telescope.
    """
    data = full.createData()
    pin.forwardKinematics(full, data, pin.neutral(full))
    telescopes = list[list[str]]()
    before = 0
    axis_before = np.zeros(3)
    for name in joints:
        number = full.getJointId(name)
        # The joint's motion in its own frame is (v, ω), with v = 0 for revolute joints.
        motion = np.asarray(data.joints[number].S, float).ravel()
        axis = data.oMi[number].rotation @ motion[:3]
        is_next = full.parents[number] == before
        is_parallel = axis @ axis_before > _PARALLEL
        if is_next and is_parallel and _have_equal_limits(full, number, before):
            telescopes[-1].append(name)
        else:
            telescopes.append([name])
        before = number
        axis_before = axis
    return [tuple(group) for group in telescopes if len(group) > 1]


def _have_equal_limits(full: pin.Model, joint: int, other: int) -> bool:
    k = full.joints[joint].idx_q
    other_k = full.joints[other].idx_q
    for bound in (full.lowerPositionLimit, full.upperPositionLimit):
        if not np.isclose(bound[k], bound[other_k]):
            return False
    return True


def _has_arm(group: SrdfGroup, arm: Arm) -> bool:
    return _get_last_joints(arm.joints) <= set(group.joints)


def _get_last_joints(joints: Sequence[str]) -> set[str]:
    """Return the joints that identify an arm."""
    return set(joints[-4:])


def _is_palm(body: Body, file: UrdfFile) -> bool:
    """Return whether a body has fingers: two or more, or one that is named as a jaw."""
    if not body.children or body.depth() > _FINGER:
        return False
    if not any(below.is_planned for below in body.subtree()[1:]):
        return False
    names = [f"{child.name} {child.links[0]}" for child in body.children]
    # A finger may have its arm's name before its own.
    if any(_has_word(name, _TRUNK_WORDS) and not _has_word(name, _HAND_WORDS) for name in names):
        return False
    if len(body.children) == 1:
        (jaw,) = body.children
        is_named = _has_word(names[0], _HAND_WORDS) and not _has_word(jaw.name, _WRIST_WORDS)
        return is_named and not jaw.children and _has_jaw_beside(body, jaw, file)
    if any(_has_word(name, _HAND_WORDS) for name in names):
        return True
    return not any(_has_word(name, _OTHER_WORDS) for name in names)


def _has_word(name: str, words: Set[str]) -> bool:
    return not words.isdisjoint(split_words(name))


def _has_jaw_beside(palm: Body, jaw: Body, file: UrdfFile) -> bool:
    """Return whether a palm extends beside a jaw, which closes against it, rather than behind it.

    What turns about its own length, such as the last link of a wrist, is no jaw. With points from
    the jaw's joint on, d is the direction to the jaw's centre across its axis a; a palm extends at
    least half as far as the jaw in one of the directions to which the jaw turns, exp(θ a) d.
    """
    full = build_full_model(file)
    data = full.createData()
    pin.framesForwardKinematics(full, data, pin.neutral(full))
    points = sample_points(file, [*palm.links, *jaw.links])
    for link, corners in points.items():
        place = data.oMf[full.getFrameId(link, pin.FrameType.BODY)]
        points[link] = corners @ place.rotation.T + place.translation
    of_jaw = [points[link] for link in jaw.links if link in points]
    of_palm = [points[link] for link in palm.links if link in points]
    if not (of_jaw and of_palm):
        return False
    number = full.getJointId(jaw.name)
    base = data.oMi[number]
    motion = np.asarray(data.joints[number].S, float).ravel()
    if motion.size != 6:  # a free body, no jaw
        return False
    # It is zero for a jaw that slides.
    axis = base.rotation @ motion[3:]
    ahead = np.vstack(of_jaw) - base.translation
    centre = ahead.mean(axis=0)
    across = centre - (centre @ axis) * axis
    if np.linalg.norm(across) < abs(centre @ axis):
        return False
    across /= np.linalg.norm(across)
    reach = float((ahead @ across).max())
    beside = np.vstack(of_palm) - base.translation
    # A palm lies where the jaw turns to rather than where it is.
    extents = list[float]()
    for angle in _JAW_ANGLES:
        direction = pin.exp3(angle * axis) @ across
        extents.append(float((beside @ direction).max()))
    return max(extents) > _BESIDE * reach


def _find_planned_joints(body: Body, base: Collection[str]) -> tuple[str, ...]:
    return tuple(above.name for above in body.path() if above.is_planned and above.name not in base)


def _choose_name(joints: Sequence[str], palm: Body, groups: Mapping[str, SrdfGroup]) -> str:
    """Return an arm's name: that of the smallest group with its joints, its side, or its palm."""
    last = _get_last_joints(joints)
    fitting = [name for name, group in groups.items() if last <= set(group.joints)]
    if fitting:
        return min(fitting, key=lambda name: (len(groups[name].joints), name))
    for side, words in _SIDES.items():
        count = sum(_has_word(name, words) for name in [*joints[-3:], palm.links[0]])
        if count > 1:
            return side
    return palm.links[0]


def sample_points(file: UrdfFile, links: Sequence[str]) -> dict[str, Floats]:
    """Return points on links, shape (n, 3) in the link's frame [m]."""
    from trimesh.sample import sample_surface

    points_by_link = dict[str, Floats]()
    # Visual shapes count on links without collision shapes.
    for kind in ("collision", "visual"):
        new = dict[str, list[Floats]]()
        for shape in file.read_shapes(kind):
            if shape.link not in links or shape.link in points_by_link:
                continue
            try:
                mesh = shape.make_mesh()
            except InputError:
                continue
            corners = np.asarray(mesh.vertices)
            # `Trimesh.sample` takes a seed from trimesh 5 on only.
            sampled, _ = sample_surface(mesh, _POINTS, seed=0)
            step = max(1, len(corners) // _POINTS)
            points = np.vstack([corners[::step], np.asarray(sampled)])
            new.setdefault(shape.link, []).append(points)
        for link, parts in new.items():
            points_by_link[link] = np.vstack(parts)
    return points_by_link


def _get_link(joint: ElementTree.Element, key: str) -> str:
    element = joint.find(key)
    return "" if element is None else element.get("link", "")
