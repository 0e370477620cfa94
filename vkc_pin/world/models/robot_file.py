"""Loads robots from their files: URDF, robot.yaml and SRDF."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.utils.arguments import check_coordinate, check_mapping, check_text
from vkc_pin.utils.system import is_file
from vkc_pin.world.files import resources
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.srdf import Srdf, find_srdf, read_srdf
from vkc_pin.world.files.urdf import UrdfFile, read_urdf
from vkc_pin.world.models.couplings import (
    apply_couplings,
    apply_robot_limits,
    find_followers,
    find_joint_path,
    tighten_coupled_limits,
)
from vkc_pin.world.models.gripper import build_gripper
from vkc_pin.world.models.robot import Base, Robot
from vkc_pin.world.models.robot_model import (
    build_full_model,
    build_planned_model,
    compute_rest_positions,
    find_base_joints,
    find_default_tool_frame,
    find_joint_limits,
    find_nearest_position,
    load_collision_geometry,
)
from vkc_pin.world.models.robot_schema import (
    RobotSchema,
    find_python_packages,
    read_robot,
    read_wheels,
)
from vkc_pin.world.models.self_collisions import apply_self_collision_analysis, set_collision_pairs
from vkc_pin.world.models.shapes import LIMIT_SLACK
from vkc_pin.world.models.wheels import describe_misplaced_axle, find_drive, is_on_axle

_BASES = get_args(Base)
_PAIRS = ("srdf", "sampled", "all")
_SAMPLES = 1000  # configurations sampled for allowed pairs when a robot is loaded
# Names under which example-robot-data loads URDF files of other names.
_ALIASES = {
    "anymal_kinova": "anymal-kinova",
    "asr_twodof": "TwoDofs",
    "b1_z1": "b1-z1",
    "hyq": "hyq_no_sensors",
    "solo8": "solo",
}


def list_robots() -> dict[str, Path]:
    """Return robot name → file: robots in robots/, then those of example-robot-data."""
    own_folder = resources.find_resource_folder("robots")
    known = {path.parent.name: path for path in sorted(own_folder.glob("*/robot.yaml"))}
    folder = resources.find_example_robot_data()
    if folder is not None:
        files = sorted(folder.glob("robots/*/*/*.urdf"))
        stems = {file.stem: file for file in reversed(files)}
        for stem, file in stems.items():
            known.setdefault(stem, file)
            known.setdefault(stem.removesuffix("_robot"), file)
        for name, stem in _ALIASES.items():
            if stem in stems:
                known.setdefault(name, stems[stem])
    return known


def find_robot(name: str | Path) -> Path:
    """Return the robot.yaml or URDF file of a robot.

    Args:
        name: A name in `list_robots`, or the path of a URDF file, a robot.yaml, or a folder with a
            robot.yaml. Strings with a slash or the suffix of such a file are paths.
    """
    path = Path(name)
    has_suffix = path.suffix.lower() in (".urdf", ".yaml", ".yml")
    if isinstance(name, Path) or has_suffix or "/" in name:
        file = path / "robot.yaml" if path.is_dir() else path
        if not file.is_file():
            raise InputError(
                "this robot file does not exist",
                file=file,
                expected="a URDF file, a robot.yaml, or a robot's name",
            )
        return file
    own_file = resources.find_resource_folder("robots") / str(name) / "robot.yaml"
    if is_file(own_file):
        return own_file
    known = list_robots()
    if name not in known:
        raise UnknownNameError("robot", str(name), known)
    return known[str(name)]


def load_robot(  # noqa: PLR0913 - keyword options of a public call
    name: str | Path,
    *,
    base: Base = "omni",
    tool_frame: str | None = None,
    arm: str | None = None,
    locked_joints: Mapping[str, float] | None = None,
    home: Mapping[str, float] | None = None,
    srdf: str | Path | None = None,
    pairs: Literal["srdf", "sampled", "all"] = "srdf",
    packages: Mapping[str, str | Path] | None = None,
    height: float | None = None,
    turning_radius: float | None = None,
) -> Robot:
    """Load a robot and put it on a planar virtual base.

    The joints between the root and the tool frame are planned. All others (wheels, heads, other
    arms, fingers) are locked, as are joints of a type other than revolute, continuous and
    prismatic. Joints coupled to a planned one (<mimic>, or `couplings` in robot.yaml) move with it,
    wherever they are; coupled joints share the coordinate of their leader.

    Limits come from the URDF and from a `robot.yaml` beside it. Defaults of velocity and
    acceleration limits are π rad/s or 0.1 m/s and 1.4 rad/s² (m/s²) for joints, and 1 m/s, 2 rad/s,
    3 m/s² and 6 rad/s² for the base. The default range of the base is ±20 m.

    The virtual base replaces the joints of a planar base in the URDF, unless `base` is "fixed".
    These are locked at 0, with a warning unless their positions are given.

    The SRDF lists the pairs of links that may touch. Without an SRDF, these are adjacent links and
    pairs that sampling finds always or never in collision. In both cases, neighbours that are
    always close, links that always overlap, and links that overlap at home are exempt from
    collision checks, with a warning if they are not neighbours; see
    `vkc_pin.world.models.self_collisions`.

    Args:
        name: Name of a robot in robots/ or in example-robot-data ("panda", "tiago", "ur5"), or path
            of a URDF.
        base: "omni", "differential" (no lateral motion), "ackermann" (differential, with
            `turning_radius`) or "fixed" (limits of 0).
        tool_frame: Frame that grasps. Default: that of robot.yaml, or else the last frame of the
            longest chain.
        arm: Group of the SRDF whose last link grasps; an alternative to `tool_frame`.
        locked_joints: Positions of additional joints to lock, [m] or [rad]. Other locked joints are
            at 0 or at the middle of limits that exclude 0.
        home: Home positions of joints, [m] or [rad]. Default: those of robot.yaml, or else a group
            state of the SRDF that covers all planned joints (preferably one named home), or else 0,
            or the middle of limits that exclude 0. If links overlap there, joints without a stated
            position are moved, with a warning.
        srdf: Path of the SRDF. Default: the one named in robot.yaml, or one beside the URDF.
        pairs: Source of the allowed pairs: "srdf"; "sampled", even if there is an SRDF; "all" to
            make every pair of links in relative motion a collision pair, even adjacent ones, for
            inspection of the geometry.
        packages: Package → folder, to resolve `package://` addresses. Other packages are searched
            for around the file.
        height: Height of the root link above the floor [m]. Default: that of robot.yaml, or else 0.
        turning_radius: Minimum turning radius of the root link of an "ackermann" base [m].
            Default: that of robot.yaml.

    Raises:
        UnknownNameError: A robot, frame, joint or link does not exist; the error suggests the
            nearest name.
        InputError: A file or value is invalid, no joint can be planned, or the SRDF exempts all
            pairs of links that can collide.
    """
    _check_choice(base, _BASES, "base", "kind of base")
    _check_choice(pairs, _PAIRS, "pairs", "source of pairs")
    _check_tool(tool_frame, arm)
    locked_joints = _check_positions(locked_joints, "locked_joints")
    home = _check_positions(home, "home")
    folders = check_mapping(
        {} if packages is None else packages, "packages", "packages, each with its folder"
    )
    files = _read_files(name, folders)
    urdf = files.urdf
    settings = files.settings
    srdf_path = files.find_srdf() if srdf is None else check_path(srdf, "srdf")
    group = files.find_group(arm, tool_frame)
    semantics = files.read_semantics(srdf_path, pairs, group)
    full = build_full_model(urdf)
    tool = tool_frame
    if tool is None:
        tool = files.find_tool_frame(semantics, group, srdf_path, full)
    if pairs != "srdf":
        semantics = None
    frames = dict.fromkeys(frame.name for frame in full.frames)
    if tool not in frames:
        raise UnknownNameError("frame", tool, frames, file=urdf.path, field="tool_frame")
    full = tighten_coupled_limits(full, urdf, tool)
    _warn_of_misplaced_axle(full, urdf, tool, base)
    base_joints = find_base_joints(full, urdf) if base != "fixed" else ()
    positions = _collect_positions(files, full, base_joints, locked_joints, home)
    unstated = [joint for joint in base_joints if joint not in positions.stated_locked]
    if unstated:
        problem = "the virtual base replaces the joints of the robot's base, which are locked"
        warnings.warn(f"{urdf.path}: {problem}: {', '.join(unstated)}", stacklevel=2)
    root_height = settings.base.height if height is None else check_coordinate(height, "height")
    rest = positions.rest
    model = build_planned_model(full, urdf, tool, rest, positions.locked, height=root_height)
    coordinates, lower, upper, velocity, acceleration = apply_robot_limits(
        full, model, settings, base
    )
    arm_joints = coordinates.names[3:]
    stated_fields = dict.fromkeys(positions.stated_home, "home")
    stated_fields.update(dict.fromkeys(positions.stated_locked, "locked_joints"))
    files.check_followers(rest, stated_fields)
    known = {*positions.stated_home, *positions.locked}
    state = _read_rest_state(model, arm_joints, semantics, group, known)
    home_positions = [state.get(joint, rest[joint]) for joint in arm_joints]
    collision = load_collision_geometry(model, urdf)
    robot = Robot(
        name=files.name,
        urdf=urdf.path,
        model=model,
        collision=collision,
        coordinates=coordinates,
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        # Clipping removes rounding errors.
        home=np.clip(home_positions, lower[3:], upper[3:]),
        tool_frame=tool,
        base=base,
        touch_links=settings.touch_links,
        payload=settings.payload,
        height=root_height,
        **read_wheels(base, turning_radius, settings, files.source),
        gripper=build_gripper(
            full,
            urdf,
            model,
            collision,
            tool,
            rest,
            settings.gripper,
            files.document,
            height=root_height,
        ),
        file=urdf,
    )
    if pairs == "all":
        robot = set_collision_pairs(robot, ())
    else:
        loose_joints = [joint for joint in arm_joints if joint not in {*known, *state}]
        robot = apply_self_collision_analysis(robot, semantics, loose_joints, samples=_SAMPLES)
    _check_remaining_pairs(robot, semantics)
    return robot


@dataclass(frozen=True, eq=False)
class _Positions:
    """Positions of a robot's joints, [m] or [rad].

    Attributes:
        stated_home: Home positions in arguments, or else in the robot.yaml.
        stated_locked: Positions of locked joints in arguments, or else in the robot.yaml.
        locked: Positions of all joints to lock: also of open fingers, and of the joints that the
            virtual base replaces.
        rest: Position of each joint; see `robot_model.compute_rest_positions`.
    """

    stated_home: Mapping[str, float]
    stated_locked: Mapping[str, float]
    locked: Mapping[str, float]
    rest: Mapping[str, float]


def _collect_positions(
    files: _RobotFiles,
    full: pin.Model,
    base_joints: Collection[str],
    locked_joints: Mapping[str, float],
    home: Mapping[str, float],
) -> _Positions:
    """Collect and check the positions of all joints.

    Args:
        files: Files of the robot.
        full: The robot with all joints.
        base_joints: Joints that the virtual base replaces.
        locked_joints: Positions of locked joints in arguments.
        home: Home positions in arguments.
    """
    settings = files.settings
    stated_home = {**settings.home, **home}
    stated_locked = {**settings.locked_joints, **locked_joints}
    open_fingers = {joint: finger.open for joint, finger in settings.gripper.items()}
    locked = {**open_fingers, **dict.fromkeys(base_joints, 0.0), **stated_locked}
    known = {**stated_home, **locked}
    rest = compute_rest_positions(full, files.urdf, known)
    files.check_names(rest)
    for joint, position in known.items():
        field = "home" if joint in home else "locked_joints"
        if joint not in rest:
            raise UnknownNameError("joint", joint, rest, file=files.urdf.path, field=field)
        if joint in stated_locked or joint not in (*base_joints, *open_fingers):
            files.check_limits(full, joint, position, field)
    rest.update(locked)
    return _Positions(stated_home, stated_locked, locked, rest)


def _check_choice(value: object, choices: Sequence[str], field: str, kind: str) -> None:
    if not isinstance(value, str) or value not in choices:
        expected = " or ".join(choices)
        raise InputError(f"wrong {kind}", field=field, expected=expected, got=format_value(value))


def _check_tool(tool_frame: str | None, arm: str | None) -> None:
    """Check that at most one of the two arguments that name the tool is given."""
    if tool_frame is not None:
        check_text(tool_frame, "tool_frame", "the name of a frame")
    if arm is not None:
        check_text(arm, "arm", "the name of a group")
    if arm is not None and tool_frame is not None:
        raise InputError(
            "`arm` and `tool_frame` exclude each other",
            field="arm, tool_frame",
            expected="one of them",
            got=f"{arm}, {tool_frame}",
        )


def _check_positions(values: Mapping[str, float] | None, field: str) -> dict[str, float]:
    """Return the positions of joints that an argument states."""
    stated = check_mapping(
        {} if values is None else values, field, "joints, each with its position"
    )
    positions = {}
    for joint, value in stated.items():
        positions[joint] = check_coordinate(value, f"{field}.{joint}")
    return positions


@dataclass(frozen=True, eq=False)
class _RobotFiles:
    """Parsed files of a robot; `source` is its robot.yaml, or its URDF if there is none."""

    source: Path
    settings: RobotSchema
    document: Document
    urdf: UrdfFile

    @property
    def name(self) -> str:
        """Name of the robot, which is that of its folder or its file."""
        if self.source.name == "robot.yaml":
            return self.source.resolve().parent.name
        return self.source.stem

    def find_srdf(self) -> Path | None:
        """Return the path of the SRDF named in robot.yaml, or of one beside the URDF, or None."""
        if self.settings.srdf is not None:
            return self.source.parent / self.settings.srdf
        return find_srdf(self.urdf.path)

    def find_group(self, arm: str | None, tool_frame: str | None) -> str | None:
        """Return the group of the SRDF that is planned: that of an argument or of robot.yaml."""
        if arm is not None or tool_frame is not None:
            return arm
        return self.settings.arm

    def read_semantics(self, srdf: Path | None, pairs: str, group: str | None) -> Srdf | None:
        """Return the SRDF if its pairs or groups are needed; warn with its notes."""
        if srdf is None or (pairs != "srdf" and group is None):
            return None
        semantics = read_srdf(srdf, self.urdf.root)
        for note in semantics.notes:
            warnings.warn(f"{srdf}: {note}", stacklevel=3)
        return semantics

    def find_tool_frame(
        self, semantics: Srdf | None, group: str | None, srdf: Path | None, full: pin.Model
    ) -> str:
        """Return the tip of the group that is planned, the frame of robot.yaml, or the default.

        Raises:
            UnknownNameError: There is no such group, or no SRDF.
        """
        if group is None:
            stated = self.settings.tool_frame
            return find_default_tool_frame(full, self.urdf) if stated is None else stated
        groups = {} if semantics is None else semantics.groups
        if group not in groups:
            raise UnknownNameError("group of an SRDF", group, groups, file=srdf, field="arm")
        return groups[group].tip

    def check_names(self, joints: Collection[str]) -> None:
        """Check that the joints and links named in robot.yaml exist."""
        settings = self.settings
        for key in ("home", "locked_joints", "gripper", "joints"):
            for joint in getattr(settings, key):
                if joint not in joints:
                    raise self.document.make_unknown_name_error(
                        (key, joint), "joint", joint, joints
                    )
        for link in settings.touch_links:
            if link not in self.urdf.links:
                raise self.document.make_unknown_name_error(
                    ("touch_links",), "link", link, self.urdf.links
                )

    def check_limits(self, full: pin.Model, joint: str, position: float, field: str) -> None:
        """Check that a home or locked position is within the joint's limits."""
        low, high = find_joint_limits(full, joint)
        if low - LIMIT_SLACK <= position <= high + LIMIT_SLACK:
            return
        problem = "this position is outside the joint's limits"
        details: dict[str, Any] = {"expected": f"between {low:g} and {high:g}", "got": position}
        for key in ("locked_joints", "home"):
            if getattr(self.settings, key).get(joint) == position:
                raise self.document.make_error((key, joint), problem, **details)
        raise InputError(problem, file=self.urdf.path, field=f"{field}.{joint}", **details)

    def check_followers(self, rest: Mapping[str, float], given: Mapping[str, str]) -> None:
        """Check that given positions of joints agree with the couplings of these joints.

        Args:
            rest: Position of each joint.
            given: Joints whose position was given → field, "home" or "locked_joints".
        """
        for joint, coupling in find_followers(self.urdf.root).items():
            if joint not in given or coupling.leader not in rest:
                continue
            follows = coupling.factor * rest[coupling.leader] + coupling.offset
            if abs(rest[joint] - follows) <= LIMIT_SLACK:
                continue
            problem = f"this joint follows '{coupling.leader}'"
            details: dict[str, Any] = {"expected": f"{follows:g}, or no value", "got": rest[joint]}
            field = given[joint]
            if joint in getattr(self.settings, field):
                raise self.document.make_error((field, joint), problem, **details)
            raise InputError(problem, file=self.urdf.path, field=f"{field}.{joint}", **details)


def _read_files(name: str | Path, packages: Mapping[str, str | Path]) -> _RobotFiles:
    """Find and read a robot's URDF and its robot.yaml, if there is one."""
    check_path(name, "name", "a robot's name, or a path")
    source = find_robot(name)
    settings_file = source.parent / "robot.yaml"
    if source.suffix != ".yaml" and settings_file.is_file():
        # The robot.yaml may describe another URDF of its folder.
        neighbour_settings, _ = read_robot(settings_file)
        if neighbour_settings.urdf == source.name:
            source = settings_file
    if source.suffix == ".yaml":
        settings, document = read_robot(source)
    else:
        settings = RobotSchema(urdf=source.name)
        document = Document({})
    stated_folders = {}
    for package, folder in packages.items():
        stated_folders[package] = check_path(folder, f"packages.{package}", "a folder")
    missing = [package for package in settings.packages if package not in stated_folders]
    folders = {**find_python_packages(tuple(missing), document), **stated_folders}
    urdf = read_urdf(source.parent / settings.urdf, folders)
    apply_couplings(urdf, settings.couplings, document)
    return _RobotFiles(source, settings, document, urdf)


def find_robot_files(name: str | Path) -> tuple[Path | None, Path | None]:
    """Return the robot.yaml and the SRDF that `load_robot` reads for a robot, or None each."""
    files = _read_files(name, {})
    settings_file = files.source if files.source.suffix == ".yaml" else None
    return settings_file, files.find_srdf()


def _check_remaining_pairs(robot: Robot, semantics: Srdf | None) -> None:
    """Check that an SRDF leaves a pair of links to check, unless none can collide."""
    if len(robot.collision.collisionPairs) or semantics is None:
        return
    sampled = apply_self_collision_analysis(robot, None, (), samples=_SAMPLES)
    if len(sampled.collision.collisionPairs):
        raise InputError(
            "no pair of links is left to check for self-collision",
            file=robot.urdf,
            expected="an SRDF that leaves some of the pairs that can collide",
        )


def _warn_of_misplaced_axle(full: pin.Model, urdf: UrdfFile, tool: str, base: Base) -> None:
    """Warn if wheels would slide sideways because the root is not on their axle."""
    if base not in ("differential", "ackermann"):
        return
    path = [str(full.names[joint]) for joint in find_joint_path(full, tool)]
    drive = find_drive(full, urdf, path)
    if drive is not None and not is_on_axle(drive):
        problem = describe_misplaced_axle(drive)
        consequence = "its wheels will slide sideways; `vkc-pin doctor` names the axle"
        warnings.warn(f"{urdf.path}: {problem}: {consequence}", stacklevel=3)


def _read_rest_state(
    model: pin.Model,
    arm: Sequence[str],
    semantics: Srdf | None,
    group: str | None,
    known_positions: Collection[str],
) -> dict[str, float]:
    """Return the home positions of an arm's joints in an SRDF, without those already known."""
    if semantics is None:
        return {}
    state = semantics.find_home(arm, group)
    positions = {}
    for joint in arm:
        if joint in state and joint not in known_positions:
            positions[joint] = find_nearest_position(model, joint, state[joint])
    return positions
