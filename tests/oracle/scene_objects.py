"""Reads the robot and the objects of a scene: kinematics, limits, grasps and latches."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from .plan import ROOT, NotJudged, read_yaml
from .poses import Poses, make_pose, read_orientation, rotate_about_axis
from .urdf import Urdf, read_urdf

__all__ = ["Grasp", "Robot", "SceneObject", "Tree", "load_object", "load_robot"]


class Tree:
    """Kinematics of a URDF, by Pinocchio; a mobile base adds a planar joint at a height [m]."""

    def __init__(self, urdf: Urdf, *, is_mobile: bool, height: float = 0.0) -> None:
        self.urdf = urdf
        self.model = pin.buildModelFromXML(
            urdf.text, *((pin.JointModelPlanar(), "base") if is_mobile else ())
        )
        if is_mobile:
            self.model.jointPlacements[1] = pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
        self.data = self.model.createData()

    def compute_links(
        self, values: Mapping[str, np.ndarray | float], base: np.ndarray | None, wanted: list[str]
    ) -> dict[str, Poses]:
        """Return the poses of links or other frames, relative to the parent of the root.

        Args:
            values: Joint → values [m] or [rad], shape (S,) or a number. Default: neutral.
            base: x, y [m] and yaw [rad] of a mobile base, shape (S, 3).
            wanted: Names of frames.
        """
        rows = max(
            [1 if base is None else len(base), *(np.size(value) for value in values.values())]
        )
        q = np.tile(pin.neutral(self.model), (rows, 1))
        if base is not None:
            q[:, :2], q[:, 2], q[:, 3] = base[:, :2], np.cos(base[:, 2]), np.sin(base[:, 2])
        for name, value in values.items():
            joint = self.model.joints[self.model.getJointId(name)]
            if joint.nq == 2:
                q[:, joint.idx_q], q[:, joint.idx_q + 1] = np.cos(value), np.sin(value)
            else:
                q[:, joint.idx_q] = value
        frames = {name: self.find_frame(name) for name in wanted}
        joints = sorted({frame.parentJoint for frame in frames.values()})
        matrices = np.empty((rows, len(joints), 4, 4))
        placements = [self.data.oMi[joint] for joint in joints]
        for k in range(rows):
            pin.forwardKinematics(self.model, self.data, q[k])
            for column, placement in enumerate(placements):
                matrices[k, column] = placement.homogeneous
        joint_poses = {
            joint: Poses(matrices[:, i, :3, :3], matrices[:, i, :3, 3])
            for i, joint in enumerate(joints)
        }
        return {
            name: joint_poses[frame.parentJoint]
            @ make_pose(frame.placement.translation, frame.placement.rotation)
            for name, frame in frames.items()
        }

    def find_frame(self, name: str) -> Any:
        """Return the frame of a link or, without such a link, another frame of that name."""
        for kind in (
            pin.FrameType.BODY,
            pin.FrameType.OP_FRAME,
            pin.FrameType.FIXED_JOINT,
            pin.FrameType.JOINT,
        ):
            if self.model.existFrame(name, kind):
                return self.model.frames[self.model.getFrameId(name, kind)]
        raise KeyError(f"{self.urdf.path.name} has no frame {name}")


@dataclass(frozen=True)
class Grasp:
    """An attachment: the tool's pose in a link is placement · J(v) · standoff along the tool's −z.

    `freedoms` are (name of the coordinate in the object, is prismatic, axis, lower, upper); axes of
    rotation pass through `points`. A `pushed` link touches the foremost point of the hand, not the
    tool. `deviation` is the pose error of a measured grasp.
    """

    name: str
    link: str
    placement: Poses
    freedoms: tuple[tuple[str, bool, np.ndarray, float, float], ...]
    points: tuple[np.ndarray, ...]
    standoff: float
    firm: bool
    clearance: float | None
    pushed: bool
    opening: float | None
    deviation: Poses | None = None

    def compute_tool(self, values: Mapping[str, np.ndarray]) -> Poses:
        """Return the tool's poses in the link's frame for values of the freedoms, shape (S,)."""
        pose = self.placement
        for (name, is_prismatic, axis, _, _), point in zip(self.freedoms, self.points, strict=True):
            value = np.atleast_1d(values[name])
            if is_prismatic:
                pose = pose @ Poses(np.tile(np.eye(3), (len(value), 1, 1)), value[:, None] * axis)
            else:
                rotation = rotate_about_axis(axis, value)
                pose = pose @ Poses(rotation, point - rotation @ point)
        pose = pose @ make_pose((0.0, 0.0, -self.standoff))
        return pose if self.deviation is None else pose @ self.deviation


@dataclass(frozen=True)
class SceneObject:
    """An object: placement, kinematics, joint limits (lower, upper, velocity, acceleration)."""

    name: str
    tree: Tree
    free: bool
    placement: Poses
    state: dict[str, float]
    limits: dict[str, tuple[float, float, float, float]]
    grasps: dict[str, Grasp]
    latches: list[dict[str, Any]]
    resistances: dict[str, dict[str, float]]
    mass: float | None

    def get_grasp(self, name: str | None) -> Grasp:
        return next(iter(self.grasps.values())) if name is None else self.grasps[name]

    def is_prismatic(self, joint: str) -> bool:
        return self.tree.urdf.get_joint_type(joint) == "prismatic"


@dataclass(frozen=True)
class Robot:
    """A robot: planned joints `arm`; pairs of links `exempt` from checks; finger joints `gripper`.

    `coupled` maps joints to the planned joints that they follow: (planned joint, factor, offset).
    """

    tree: Tree
    base: str
    tool: str
    touch_links: set[str]
    arm: list[str]
    locked: dict[str, float]
    limits: dict[str, tuple[float, float, float, float]]
    home: dict[str, float]
    exempt: set[frozenset[str]]
    gripper: dict[str, tuple[float, float]]
    coupled: dict[str, tuple[str, float, float]]
    wheels: dict[str, float] | None
    turning_radius: float
    torque_limits: dict[str, float]
    payload: float | None

    def compute_joint_values(self, arm: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the values of planned and coupled joints, from those of planned joints."""
        return {
            **arm,
            **{
                joint: factor * arm[leader] + offset
                for joint, (leader, factor, offset) in self.coupled.items()
            },
        }

    @cached_property
    def planned_joints(self) -> dict[str, tuple[str, ...]]:
        """Link → planned and coupled joints between the base and the link."""
        urdf = self.tree.urdf
        return {
            link: tuple(
                joint
                for joint in urdf.find_joint_path(link)
                if joint in self.arm or joint in self.coupled
            )
            for link in urdf.links
        }

    def is_checked_pair(self, one: str, other: str) -> bool:
        """Return whether two links move relative to each other and are not exempt from checks."""
        return (
            self.planned_joints[one] != self.planned_joints[other]
            and frozenset((one, other)) not in self.exempt
        )

    @cached_property
    def base_links(self) -> set[str]:
        """Links that move with the base alone; wheels touch the floor."""
        return {link for link, joints in self.planned_joints.items() if not joints}


def load_object(item: Mapping[str, Any], folder: Path) -> SceneObject:
    """Return the object of an entry in a scene's `objects`."""
    kind = item["type"]
    if isinstance(kind, str):
        by_path = kind.endswith((".yaml", ".yml")) or "/" in kind
        file = folder / kind if by_path else ROOT / "scenes" / "objects" / f"{kind}.yaml"
        description = read_yaml(file)
        folder = file.parent
    else:
        description = kind
    is_inline = description["urdf"].lstrip().startswith("<")
    urdf = (
        Urdf(folder / "urdf", description["urdf"])
        if is_inline
        else read_urdf(folder / description["urdf"])
    )
    for joint, measured in (item.get("measured") or {}).items():
        urdf = _displace_joint(urdf, joint, measured)
    joints = [joint for joint in urdf.joints if urdf.is_movable(joint)]
    limits, neutral = {}, {}
    for joint in joints:
        low, high, velocity = urdf.get_limits(joint)
        settings = (description.get("joints") or {}).get(joint, {})
        velocity = settings.get("velocity", velocity if np.isfinite(velocity) else 1.0)
        limits[joint] = (low, high, float(velocity), float(settings.get("acceleration", 2.0)))
        neutral[joint] = float(np.clip(0.0, low, high))
    free = bool(description.get("free", False))
    grasps = {
        entry["name"]: _read_grasp(entry, free, item.get("reversed") or ())
        for entry in description["attachments"]
    }
    return SceneObject(
        name=item["name"],
        tree=Tree(urdf, is_mobile=False),
        free=free,
        placement=make_pose(item["position"], read_orientation(item)),
        state={**neutral, **(item.get("state") or {})},
        limits=limits,
        grasps=grasps,
        latches=[{"held_at": 0.0, **latch} for latch in description.get("latches") or ()],
        resistances={
            joint: _read_resistance(urdf, joint, (description.get("joints") or {}).get(joint, {}))
            for joint in joints
        },
        mass=description.get("mass"),
    )


def _displace_joint(urdf: Urdf, joint: str, measured: Mapping[str, Any]) -> Urdf:
    """Return a URDF with a joint elsewhere: a fixed joint behind it carries its link."""
    root = ElementTree.fromstring(urdf.text)
    (moved,) = [one for one in root.findall("joint") if one.get("name") == joint]
    child = moved.find("child")
    assert child is not None
    link, between = child.get("link", ""), f"{joint} moves"
    ElementTree.SubElement(root, "link", name=between)
    fixed = ElementTree.SubElement(root, "joint", name=f"{joint} carries", type="fixed")
    ElementTree.SubElement(fixed, "parent", link=between)
    ElementTree.SubElement(fixed, "child", link=link)
    child.set("link", between)
    for element, pose in ((moved, measured["placement"]), (fixed, measured["link"])):
        for origin in element.findall("origin"):
            element.remove(origin)
        angles = pin.rpy.matrixToRpy(read_orientation(pose))
        xyz, rpy = (" ".join(map(repr, map(float, row))) for row in (pose["position"], angles))
        ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)
    return Urdf(urdf.path, ElementTree.tostring(root, encoding="unicode"))


def _read_resistance(urdf: Urdf, joint: str, settings: Mapping[str, Any]) -> dict[str, float]:
    """Return friction, damping, stiffness and spring reference of an object's joint."""
    dynamics = urdf.joints[joint].find("dynamics")
    resistance = {"friction": 0.0, "damping": 0.0, "stiffness": 0.0, "springref": 0.0}
    resistance |= (
        {}
        if dynamics is None
        else {key: float(value) for key, value in dynamics.attrib.items() if key in resistance}
    )
    return resistance | {key: float(settings[key]) for key in resistance if key in settings}


def _read_grasp(entry: Mapping[str, Any], free: bool, reversed_names: Sequence[str]) -> Grasp:
    if "approach" in entry:
        z, x = (
            np.array(entry[key], float) / np.linalg.norm(entry[key])
            for key in ("approach", "closing")
        )
        rotation = np.column_stack([x, np.cross(z, x), z])
    else:
        rotation = read_orientation(entry)
    name, joint = entry["name"], entry.get("joint", "fixed")
    axis = (
        np.array(entry["axis"], float) / np.linalg.norm(entry["axis"])
        if "axis" in entry
        else np.zeros(3)
    )
    freedoms: list[tuple[str, bool, np.ndarray, float, float]] = []
    points = [
        np.array(freedom.get("through", (0.0, 0.0, 0.0)), float)
        for freedom in entry.get("freedoms", ())
    ]
    for freedom in entry.get("freedoms", ()):
        direction = np.array(freedom["slide"] if "slide" in freedom else freedom["turn"], float)
        freedoms.append(
            (
                f"{name}_{freedom['name']}",
                "slide" in freedom,
                direction / np.linalg.norm(direction),
                *freedom["limits"],
            )
        )
    if joint == "spherical":
        low, high = entry.get("limits", (-np.pi, np.pi))
        freedoms = [
            (f"{name}_{letter}", False, np.eye(3)[i], low, high) for i, letter in enumerate("xyz")
        ]
    elif joint == "cylindrical":
        freedoms = [
            (f"{name}_slide", True, axis, *entry["limits"]),
            (f"{name}_turn", False, axis, *entry["turn"]),
        ]
    elif joint != "fixed":
        freedoms = [(name, joint == "prismatic", axis, *entry["limits"])]
    if name in reversed_names:  # same closing direction, opposite approach
        rotation = np.column_stack([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]])
        freedoms = [
            (*freedom[:2], np.array([1.0, -1.0, -1.0]) * freedom[2], *freedom[3:])
            for freedom in freedoms
        ]
    placement = make_pose(entry.get("position", (0.0, 0.0, 0.0)), rotation)
    standoff, firm = float(entry.get("standoff", 0.0)), bool(entry.get("firm", free))
    points = points or [np.zeros(3) for _ in freedoms]
    pushed = entry.get("contact") == "push"
    options = entry.get("clearance"), pushed, entry.get("opening")
    return Grasp(
        name, entry["link"], placement, tuple(freedoms), tuple(points), standoff, firm, *options
    )


def _load_robot_settings(file: Path) -> tuple[dict[str, Any], Path]:
    """Return the settings and path of a robot.yaml, or of the one that belongs to a URDF."""
    if file.suffix == ".yaml":
        return read_yaml(file), file
    settings = file.parent / "robot.yaml"
    if settings.is_file():
        beside = read_yaml(settings)
        if beside["urdf"] == file.name:
            return beside, settings
    return {"urdf": file.name}, file


def _compute_joint_limits(
    urdf: Urdf,
    joint: str,
    coupled: Mapping[str, tuple[str, float, float]],
    joints: Mapping[str, Any],
) -> tuple[float, float, float, float]:
    """Return the position, velocity and acceleration limits of a joint and its coupled joints."""
    members = {joint: (joint, 1.0, 0.0)} | {
        name: coupling for name, coupling in coupled.items() if coupling[0] == joint
    }
    low, high, velocity, acceleration = -np.inf, np.inf, np.inf, np.inf
    for name, (_, factor, offset) in members.items():
        least, most, speed = urdf.get_limits(name)
        ends = [(end - offset) / factor for end in (least, most)]
        low, high, settings = max(low, min(ends)), min(high, max(ends)), joints.get(name, {})
        speed = settings.get("velocity", speed if 0.0 < speed < 1e3 else np.inf)
        velocity = min(velocity, speed / abs(factor))
        acceleration = min(acceleration, settings.get("acceleration", np.inf) / abs(factor))
    most = max(abs(factor) for _, factor, _ in members.values())
    velocity = velocity if velocity < np.inf else np.pi / most
    acceleration = acceleration if acceleration < np.inf else 1.4 / most
    return low, high, velocity, acceleration


def _compute_locked_values(
    urdf: Urdf, joints: list[str], locked: Mapping[str, float]
) -> dict[str, float]:
    """Return the values at which joints are locked."""
    values = {}
    for joint in joints:
        low, high, _ = urdf.get_limits(joint)
        values[joint] = locked.get(joint, 0.0 if low <= 0.0 <= high else (low + high) / 2)
    for joint in values:
        if (
            (mimic := urdf.get_mimic(joint)) is not None
            and joint not in locked
            and mimic[0] in values
        ):
            values[joint] = mimic[1] * values[mimic[0]] + mimic[2]
    return values


def load_robot(
    item: Mapping[str, Any] | str, folder: Path, arm: list[str], height: float | None
) -> Robot:
    """Return a scene's robot, with the planned joints `arm` of a saved plan."""
    description = {"name": item} if isinstance(item, str) else dict(item)
    file = _find_robot_file(description["name"], folder)
    settings, file = _load_robot_settings(file)
    urdf = read_urdf(file.parent / settings["urdf"])
    tool = description.get("tool_frame") or settings.get("tool_frame")
    if tool is None:
        raise NotJudged("no file names the robot's tool frame")
    if description.get("base", "omni") not in ("omni", "differential", "ackermann", "fixed"):
        raise NotJudged(f"base {description['base']}")
    semantics = _read_srdf(urdf.path, file.parent, settings.get("srdf"))
    if semantics is None:
        raise NotJudged("no SRDF lists the links of the robot that may touch")
    if semantics.find("disable_default_collisions") is not None:
        raise NotJudged("an SRDF with defaults of links")
    base, joints = settings.get("base") or {}, settings.get("joints") or {}
    height = float(base.get("height", 0.0)) if height is None else height
    velocities = base.get("velocity", (1.0, 1.0, 2.0))
    accelerations = base.get("acceleration", (3.0, 3.0, 6.0))
    x, y = base.get("position", ((-20.0, 20.0), (-20.0, 20.0)))
    intervals = (x, y, (-np.inf, np.inf))
    limits = {
        f"base_{k}": (*interval, v, a)
        for k, interval, v, a in zip(
            ("x", "y", "yaw"), intervals, velocities, accelerations, strict=True
        )
    }
    coupled = _find_coupled_joints(urdf, settings.get("couplings") or {}, arm)
    for joint in arm:
        limits[joint] = _compute_joint_limits(urdf, joint, coupled, joints)
    gripper = {
        joint: (finger["closed"], finger["open"])
        for joint, finger in (settings.get("gripper") or {}).items()
    }
    open_fingers = {joint: opened for joint, (_, opened) in gripper.items()}
    locked = {**settings.get("home", {}), **open_fingers, **settings.get("locked_joints", {})}
    others = [j for j in urdf.joints if urdf.is_movable(j) and j not in arm and j not in coupled]
    locked_values = _compute_locked_values(urdf, others, locked)
    for joint, (master, factor, offset) in (
        (joint, urdf.get_mimic(joint) or ("", 0.0, 0.0)) for joint in locked_values
    ):
        if master in gripper:
            closed, opened = (factor * end + offset for end in gripper[master])
            gripper[joint] = (closed, opened)
    return Robot(
        tree=Tree(urdf, is_mobile=True, height=height),
        base=description.get("base", "omni"),
        tool=tool,
        touch_links=set(settings.get("touch_links", ())),
        arm=arm,
        locked=locked_values,
        limits=limits,
        home={
            **_read_home(semantics, arm),
            **{joint: value for joint, value in settings.get("home", {}).items() if joint in arm},
        },
        exempt={
            frozenset((pair.get("link1", ""), pair.get("link2", "")))
            for pair in semantics.findall("disable_collisions")
        },
        gripper=gripper,
        coupled=coupled,
        wheels=base.get("wheels"),
        turning_radius=float(
            description.get("turning_radius") or base.get("turning_radius") or 0.0
        ),
        torque_limits={
            joint: float(joints.get(joint, {}).get("effort", urdf.get_effort_limit(joint)))
            for joint in arm
        },
        payload=settings.get("payload"),
    )


def _find_coupled_joints(
    urdf: Urdf, settings: Mapping[str, Any], arm: list[str]
) -> dict[str, tuple[str, float, float]]:
    """Return coupled joint → (planned joint, factor, offset)."""
    leaders = {
        joint: mimic for joint in urdf.joints if (mimic := urdf.get_mimic(joint)) is not None
    }
    for joint, setting in settings.items():
        description = {"joint": setting} if isinstance(setting, str) else setting
        leaders[joint] = (
            description["joint"],
            float(description.get("multiplier", 1.0)),
            float(description.get("offset", 0.0)),
        )
    chains: dict[str, tuple[str, float, float]] = {}
    for joint in (name for name in urdf.joints if urdf.is_movable(name)):
        leader, factor, offset = joint, 1.0, 0.0
        for _ in leaders:  # a longer chain would be a cycle
            if leader in leaders:
                next_leader, multiplier, shift = leaders[leader]
                leader, factor, offset = next_leader, factor * multiplier, offset + factor * shift
        chains[joint] = leader, factor, offset
    planned = {chains[joint][0]: joint for joint in arm}
    coupled = {}
    for joint, (leader, factor, offset) in chains.items():
        if leader in planned and joint not in arm and factor:
            planned_joint = planned[leader]
            ratio = factor / chains[planned_joint][1]
            coupled[joint] = planned_joint, ratio, offset - ratio * chains[planned_joint][2]
    return coupled


def _find_robot_file(name: str, folder: Path) -> Path:
    if name.endswith((".urdf", ".yaml", ".yml")) or "/" in name:
        file = folder / name
        return file / "robot.yaml" if file.is_dir() else file
    file = ROOT / "robots" / name / "robot.yaml"
    if not file.is_file():
        raise NotJudged(f"{name} is not a robot of this repository")
    return file


def _read_srdf(urdf: Path, folder: Path, file_name: str | None) -> ElementTree.Element | None:
    stems = dict.fromkeys((urdf.stem, urdf.stem.removesuffix("_robot")))
    paths = (
        [folder / file_name]
        if file_name
        else [p / f"{s}.srdf" for s in stems for p in (urdf.parent, urdf.parent.parent / "srdf")]
    )
    file = next((path for path in paths if path.is_file()), None)
    return None if file is None else ElementTree.parse(file).getroot()


def _read_home(semantics: ElementTree.Element, arm: list[str]) -> dict[str, float]:
    """Return an SRDF group state of all planned joints, preferably "home"; default: zeros."""
    states = sorted(semantics.findall("group_state"), key=lambda state: state.get("name") != "home")
    for state in states:
        values = {
            joint.get("name", ""): float(joint.get("value", "0").split()[0])
            for joint in state.findall("joint")
        }
        if set(arm) <= set(values):
            return {joint: values[joint] for joint in arm}
    return dict.fromkeys(arm, 0.0)
