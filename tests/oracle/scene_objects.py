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
    """The kinematics of a URDF, by Pinocchio, on a planar joint at a height [m] if it drives."""

    def __init__(self, urdf: Urdf, *, drives: bool, height: float = 0.0) -> None:
        self.urdf = urdf
        self.model = pin.buildModelFromXML(
            urdf.text, *((pin.JointModelPlanar(), "base") if drives else ())
        )
        if drives:
            self.model.jointPlacements[1] = pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
        self.data = self.model.createData()

    def links(
        self, values: Mapping[str, np.ndarray | float], base: np.ndarray | None, wanted: list[str]
    ) -> dict[str, Poses]:
        """Return where links (or other frames) are in the frame of the root's parent.

        Args:
            values: Joint → values, shape (S,) or one number [m] or [rad]; all others are neutral.
            base: x, y [m] and yaw [rad] of one that drives, shape (S, 3).
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
        frames = {name: self.frame(name) for name in wanted}
        joints = sorted({frame.parentJoint for frame in frames.values()})
        found = np.empty((rows, len(joints), 4, 4))
        placements = [self.data.oMi[joint] for joint in joints]
        for k in range(rows):
            pin.forwardKinematics(self.model, self.data, q[k])
            for column, placement in enumerate(placements):
                found[k, column] = placement.homogeneous
        of_joint = {
            joint: Poses(found[:, i, :3, :3], found[:, i, :3, 3]) for i, joint in enumerate(joints)
        }
        return {
            name: of_joint[frame.parentJoint]
            @ make_pose(frame.placement.translation, frame.placement.rotation)
            for name, frame in frames.items()
        }

    def frame(self, name: str) -> Any:
        """The frame of a link, or else of another of that name."""
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
    """An attachment: the tool's pose in a link is place · J(v) · standoff along the tool's −z.

    `freedoms` are (name of the coordinate in the object, slides or not, axis, lower, upper); those
    that turn do so about an axis through a point of `through`. Of a grasp that is `pushed`, the
    hand's foremost point is where the tool would be. One that is measured is `off` by a pose.
    """

    name: str
    link: str
    place: Poses
    freedoms: tuple[tuple[str, bool, np.ndarray, float, float], ...]
    through: tuple[np.ndarray, ...]
    standoff: float
    firm: bool
    clearance: float | None
    pushed: bool
    opening: float | None
    off: Poses | None = None

    def tool(self, values: Mapping[str, np.ndarray]) -> Poses:
        """Return the tool in the link's frame at values of the freedoms, shape (S,) each."""
        found = self.place
        for (name, slides, axis, _, _), point in zip(self.freedoms, self.through, strict=True):
            value = np.atleast_1d(values[name])
            if slides:
                found = found @ Poses(np.tile(np.eye(3), (len(value), 1, 1)), value[:, None] * axis)
            else:
                turn = rotate_about_axis(axis, value)
                found = found @ Poses(turn, point - turn @ point)
        found = found @ make_pose((0.0, 0.0, -self.standoff))
        return found if self.off is None else found @ self.off


@dataclass(frozen=True)
class SceneObject:
    """An object: placement, kinematics, joint limits (lower, upper, velocity, acceleration)."""

    name: str
    tree: Tree
    free: bool
    at: Poses
    state: dict[str, float]
    limits: dict[str, tuple[float, float, float, float]]
    grasps: dict[str, Grasp]
    latches: list[dict[str, Any]]
    resists: dict[str, dict[str, float]]
    mass: float | None

    def grasp(self, name: str | None) -> Grasp:
        return next(iter(self.grasps.values())) if name is None else self.grasps[name]

    def slides(self, joint: str) -> bool:
        return self.tree.urdf.kind(joint) == "prismatic"


@dataclass(frozen=True)
class Robot:
    """A robot: planned joints `arm`; pairs of links `exempt` from checks; finger joints `gripper`.

    `coupled` joints move with one of `arm`: joint → (that one, factor, offset).
    """

    tree: Tree
    base: str
    tool: str
    touch: set[str]
    arm: list[str]
    locked: dict[str, float]
    limits: dict[str, tuple[float, float, float, float]]
    home: dict[str, float]
    exempt: set[frozenset[str]]
    gripper: dict[str, tuple[float, float]]
    coupled: dict[str, tuple[str, float, float]]
    wheels: dict[str, float] | None
    turning_radius: float
    efforts: dict[str, float]

    def moved(self, arm: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return where all joints are that move with the arm, of values of its planned ones."""
        return {
            **arm,
            **{
                joint: factor * arm[by] + offset
                for joint, (by, factor, offset) in self.coupled.items()
            },
        }

    @cached_property
    def moved_by(self) -> dict[str, tuple[str, ...]]:
        """Link → the planned joints between it and the base."""
        urdf = self.tree.urdf
        return {
            link: tuple(
                joint for joint in urdf.path_to(link) if joint in self.arm or joint in self.coupled
            )
            for link in urdf.links
        }

    def apart(self, one: str, other: str) -> bool:
        """Return whether two links move relative to each other and must not collide."""
        return (
            self.moved_by[one] != self.moved_by[other]
            and frozenset((one, other)) not in self.exempt
        )

    @cached_property
    def on_the_floor(self) -> set[str]:
        """The links that no planned joint moves: wheels stand on the floor."""
        return {link for link, joints in self.moved_by.items() if not joints}


def load_object(item: Mapping[str, Any], folder: Path) -> SceneObject:
    """Return the object of an entry in a scene's `objects`."""
    kind = item["type"]
    if isinstance(kind, str):
        by_path = kind.endswith((".yaml", ".yml")) or "/" in kind
        file = folder / kind if by_path else ROOT / "scenes" / "objects" / f"{kind}.yaml"
        about = read_yaml(file)
        folder = file.parent
    else:
        about = kind
    inside = about["urdf"].lstrip().startswith("<")
    urdf = Urdf(folder / "urdf", about["urdf"]) if inside else read_urdf(folder / about["urdf"])
    joints = [joint for joint in urdf.joints if urdf.moves(joint)]
    limits, rest = {}, {}
    for joint in joints:
        low, high, fastest = urdf.limits(joint)
        own = (about.get("joints") or {}).get(joint, {})
        fastest = own.get("velocity", fastest if np.isfinite(fastest) else 1.0)
        limits[joint] = (low, high, float(fastest), float(own.get("acceleration", 2.0)))
        rest[joint] = float(np.clip(0.0, low, high))
    free = bool(about.get("free", False))
    grasps = {
        entry["name"]: _read_grasp(entry, free, item.get("reversed") or ())
        for entry in about["attachments"]
    }
    return SceneObject(
        name=item["name"],
        tree=Tree(urdf, drives=False),
        free=free,
        at=make_pose(item["position"], read_orientation(item)),
        state={**rest, **(item.get("state") or {})},
        limits=limits,
        grasps=grasps,
        latches=[{"held_at": 0.0, **latch} for latch in about.get("latches") or ()],
        resists={
            joint: _read_resistance(urdf, joint, (about.get("joints") or {}).get(joint, {}))
            for joint in joints
        },
        mass=about.get("mass"),
    )


def _read_resistance(urdf: Urdf, joint: str, said: Mapping[str, Any]) -> dict[str, float]:
    """Return friction, damping, stiffness and springref of an object's joint."""
    dynamics = urdf.joints[joint].find("dynamics")
    found = {"friction": 0.0, "damping": 0.0, "stiffness": 0.0, "springref": 0.0}
    found |= (
        {}
        if dynamics is None
        else {key: float(value) for key, value in dynamics.attrib.items() if key in found}
    )
    return found | {key: float(said[key]) for key in found if key in said}


def _read_grasp(entry: Mapping[str, Any], free: bool, reversed_ones: Sequence[str]) -> Grasp:
    if "approach" in entry:
        z, x = (
            np.array(entry[key], float) / np.linalg.norm(entry[key])
            for key in ("approach", "closing")
        )
        turn = np.column_stack([x, np.cross(z, x), z])
    else:
        turn = read_orientation(entry)
    name, joint = entry["name"], entry.get("joint", "fixed")
    axis = (
        np.array(entry["axis"], float) / np.linalg.norm(entry["axis"])
        if "axis" in entry
        else np.zeros(3)
    )
    freedoms: list[tuple[str, bool, np.ndarray, float, float]] = []
    through = [
        np.array(own.get("through", (0.0, 0.0, 0.0)), float) for own in entry.get("freedoms", ())
    ]
    for own in entry.get("freedoms", ()):
        direction = np.array(own["slide"] if "slide" in own else own["turn"], float)
        freedoms.append(
            (
                f"{name}_{own['name']}",
                "slide" in own,
                direction / np.linalg.norm(direction),
                *own["limits"],
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
    if (
        name in reversed_ones
    ):  # the fingers close along the same line, the hand comes from the other side
        turn = np.column_stack([turn[:, 0], -turn[:, 1], -turn[:, 2]])
        freedoms = [
            (*freedom[:2], np.array([1.0, -1.0, -1.0]) * freedom[2], *freedom[3:])
            for freedom in freedoms
        ]
    place = make_pose(entry.get("position", (0.0, 0.0, 0.0)), turn)
    standoff, firm = float(entry.get("standoff", 0.0)), bool(entry.get("firm", free))
    through = through or [np.zeros(3) for _ in freedoms]
    pushed = entry.get("contact") == "push"
    own = entry.get("clearance"), pushed, entry.get("opening")
    return Grasp(name, entry["link"], place, tuple(freedoms), tuple(through), standoff, firm, *own)


def _load_robot_settings(file: Path) -> tuple[dict[str, Any], Path]:
    """Return the contents of a robot.yaml, and it, or of the one beside a URDF that names it."""
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
    """Return lower, upper, velocity and acceleration of a joint and of those that follow it."""
    members = {joint: (joint, 1.0, 0.0)} | {
        name: how for name, how in coupled.items() if how[0] == joint
    }
    low, high, fastest, strongest = -np.inf, np.inf, np.inf, np.inf
    for name, (_, factor, offset) in members.items():
        least, most, fast = urdf.limits(name)
        ends = [(end - offset) / factor for end in (least, most)]
        low, high, said = max(low, min(ends)), min(high, max(ends)), joints.get(name, {})
        fast = said.get("velocity", fast if 0.0 < fast < 1e3 else np.inf)
        fastest = min(fastest, fast / abs(factor))
        strongest = min(strongest, said.get("acceleration", np.inf) / abs(factor))
    most = max(abs(factor) for _, factor, _ in members.values())
    fastest = fastest if fastest < np.inf else np.pi / most
    strongest = strongest if strongest < np.inf else 1.4 / most
    return low, high, fastest, strongest


def _compute_locked_values(
    urdf: Urdf, joints: list[str], locked: Mapping[str, float]
) -> dict[str, float]:
    """Return the values at which joints are locked."""
    rest = {}
    for joint in joints:
        low, high, _ = urdf.limits(joint)
        rest[joint] = locked.get(joint, 0.0 if low <= 0.0 <= high else (low + high) / 2)
    for joint in rest:
        if (mimic := urdf.mimics(joint)) is not None and joint not in locked and mimic[0] in rest:
            rest[joint] = mimic[1] * rest[mimic[0]] + mimic[2]
    return rest


def load_robot(
    item: Mapping[str, Any] | str, folder: Path, arm: list[str], height: float | None
) -> Robot:
    """Return a scene's robot; `arm` are its planned joints, which a saved plan names."""
    about = {"name": item} if isinstance(item, str) else dict(item)
    file = _find_robot_file(about["name"], folder)
    own, file = _load_robot_settings(file)
    urdf = read_urdf(file.parent / own["urdf"])
    tool = about.get("tool_frame") or own.get("tool_frame")
    if tool is None:
        raise NotJudged("no file names the robot's tool frame")
    if about.get("base", "omni") not in ("omni", "differential", "ackermann", "fixed"):
        raise NotJudged(f"base {about['base']}")
    semantics = _read_srdf(urdf.path, file.parent, own.get("srdf"))
    if semantics is None:
        raise NotJudged("no SRDF says which links of the robot may touch")
    base, joints = own.get("base") or {}, own.get("joints") or {}
    height = float(base.get("height", 0.0)) if height is None else height
    speeds, strengths = (
        base.get("velocity", (1.0, 1.0, 2.0)),
        base.get("acceleration", (3.0, 3.0, 6.0)),
    )
    (x, y) = base.get("position", ((-20.0, 20.0), (-20.0, 20.0)))
    spans = (x, y, (-np.inf, np.inf))
    limits = {
        f"base_{k}": (*span, v, a)
        for k, span, v, a in zip(("x", "y", "yaw"), spans, speeds, strengths, strict=True)
    }
    coupled = _find_coupled_joints(urdf, own.get("couplings") or {}, arm)
    for joint in arm:
        limits[joint] = _compute_joint_limits(urdf, joint, coupled, joints)
    gripper = {
        joint: (said["closed"], said["open"]) for joint, said in (own.get("gripper") or {}).items()
    }
    wide = {joint: opened for joint, (_, opened) in gripper.items()}
    locked = {**own.get("home", {}), **wide, **own.get("locked_joints", {})}
    others = [j for j in urdf.joints if urdf.moves(j) and j not in arm and j not in coupled]
    rest = _compute_locked_values(urdf, others, locked)
    for joint, (master, factor, offset) in (
        (joint, urdf.mimics(joint) or ("", 0.0, 0.0)) for joint in rest
    ):
        if master in gripper:
            closed, opened = (factor * end + offset for end in gripper[master])
            gripper[joint] = (closed, opened)
    return Robot(
        tree=Tree(urdf, drives=True, height=height),
        base=about.get("base", "omni"),
        tool=tool,
        touch=set(own.get("touch_links", ())),
        arm=arm,
        locked=rest,
        limits=limits,
        home={
            **_read_home(semantics, arm),
            **{joint: value for joint, value in own.get("home", {}).items() if joint in arm},
        },
        exempt={
            frozenset((pair.get("link1", ""), pair.get("link2", "")))
            for pair in semantics.findall("disable_collisions")
        },
        gripper=gripper,
        coupled=coupled,
        wheels=base.get("wheels"),
        turning_radius=float(about.get("turning_radius") or base.get("turning_radius") or 0.0),
        efforts={
            joint: float(joints.get(joint, {}).get("effort", urdf.effort(joint))) for joint in arm
        },
    )


def _find_coupled_joints(
    urdf: Urdf, stated: Mapping[str, Any], arm: list[str]
) -> dict[str, tuple[str, float, float]]:
    """Return mimicking joint → (planned joint, factor, offset)."""
    follows = {joint: how for joint in urdf.joints if (how := urdf.mimics(joint)) is not None}
    for joint, said in stated.items():
        about = {"joint": said} if isinstance(said, str) else said
        follows[joint] = (
            about["joint"],
            float(about.get("multiplier", 1.0)),
            float(about.get("offset", 0.0)),
        )
    of_leader: dict[str, tuple[str, float, float]] = {}
    for joint in (name for name in urdf.joints if urdf.moves(name)):
        leader, factor, offset = joint, 1.0, 0.0
        for _ in follows:  # more often than once each would be a circle
            if leader in follows:
                above, multiplier, shift = follows[leader]
                leader, factor, offset = above, factor * multiplier, offset + factor * shift
        of_leader[joint] = leader, factor, offset
    planned = {of_leader[joint][0]: joint for joint in arm}
    found = {}
    for joint, (leader, factor, offset) in of_leader.items():
        if leader in planned and joint not in arm and factor:
            by = planned[leader]
            share = factor / of_leader[by][1]
            found[joint] = by, share, offset - share * of_leader[by][2]
    return found


def _find_robot_file(name: str, folder: Path) -> Path:
    if name.endswith((".urdf", ".yaml", ".yml")) or "/" in name:
        file = folder / name
        return file / "robot.yaml" if file.is_dir() else file
    file = ROOT / "robots" / name / "robot.yaml"
    if not file.is_file():
        raise NotJudged(f"{name} is no robot of this repository")
    return file


def _read_srdf(urdf: Path, folder: Path, named: str | None) -> ElementTree.Element | None:
    stems = dict.fromkeys((urdf.stem, urdf.stem.removesuffix("_robot")))
    places = (
        [folder / named]
        if named
        else [p / f"{s}.srdf" for s in stems for p in (urdf.parent, urdf.parent.parent / "srdf")]
    )
    file = next((place for place in places if place.is_file()), None)
    return None if file is None else ElementTree.parse(file).getroot()


def _read_home(semantics: ElementTree.Element, arm: list[str]) -> dict[str, float]:
    """Return where an SRDF says that all planned joints rest, a state called home first."""
    states = sorted(semantics.findall("group_state"), key=lambda state: state.get("name") != "home")
    for state in states:
        values = {
            joint.get("name", ""): float(joint.get("value", "0").split()[0])
            for joint in state.findall("joint")
        }
        if set(arm) <= set(values):
            return {joint: values[joint] for joint in arm}
    return dict.fromkeys(arm, 0.0)
