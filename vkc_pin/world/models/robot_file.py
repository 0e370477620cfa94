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
    known = {
        path.parent.name: path
        for path in sorted(resources.find_resource_folder("robots").glob("*/robot.yaml"))
    }
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
    if isinstance(name, Path) or path.suffix.lower() in (".urdf", ".yaml", ".yml") or "/" in name:
        file = path / "robot.yaml" if path.is_dir() else path
        if not file.is_file():
            raise InputError(
                "this robot file does not exist",
                file=file,
                expected="a URDF file, a robot.yaml, or a robot's name",
            )
        return file
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
    locked_joints, home = _check_arguments(base, pairs, tool_frame, arm, locked_joints, home)
    files = _read_files(
        name,
        check_mapping(
            {} if packages is None else packages, "packages", "packages, each with its folder"
        ),
    )
    urdf, settings = files.urdf, files.settings
    srdf_path = check_path(srdf, "srdf") if srdf is not None else files.find_srdf()
    group = files.find_group(arm, tool_frame)
    semantics = files.read_semantics(srdf_path, pairs, group)
    full = build_full_model(urdf)
    tool = tool_frame
    if tool is None:
        tool = files.find_tool_frame(semantics, group, srdf_path)
    if tool is None:
        tool = find_default_tool_frame(full, urdf)
    if pairs != "srdf":
        semantics = None
    if tool not in (frames := dict.fromkeys(frame.name for frame in full.frames)):
        raise UnknownNameError("frame", tool, frames, file=urdf.path, field="tool_frame")
    full = tighten_coupled_limits(full, urdf, tool)
    _warn_of_misplaced_axle(full, urdf, tool, base)
    base_joints = find_base_joints(full, urdf) if base != "fixed" else ()
    fingers = {joint: finger.open for joint, finger in settings.gripper.items()}
    stated_positions = {**settings.locked_joints, **locked_joints}
    locked = {**fingers, **dict.fromkeys(base_joints, 0.0), **stated_positions}
    known_positions = {**settings.home, **home, **locked}
    rest = compute_rest_positions(full, urdf, known_positions)
    files.check_names(rest)
    for joint in known_positions:
        field = "home" if joint in home else "locked_joints"
        if joint not in rest:
            raise UnknownNameError("joint", joint, rest, file=urdf.path, field=field)
        if joint in stated_positions or joint not in (*base_joints, *fingers):
            files.check_limits(full, joint, known_positions[joint], field)
    if unstated := ", ".join(joint for joint in base_joints if joint not in stated_positions):
        problem = "the virtual base replaces the joints of the robot's base, which are locked"
        warnings.warn(f"{urdf.path}: {problem}: {unstated}", stacklevel=2)
    root_height = settings.base.height if height is None else check_coordinate(height, "height")
    rest = {**rest, **locked}
    model = build_planned_model(full, urdf, tool, rest, locked, height=root_height)
    coordinates, lower, upper, velocity, acceleration = apply_robot_limits(
        full, model, settings, base
    )
    given = dict.fromkeys((*settings.home, *home), "home")
    files.check_followers(rest, given | dict.fromkeys(stated_positions, "locked_joints"))
    state = _read_rest_state(model, coordinates.names[3:], semantics, group, known_positions)
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
        home=np.clip(
            [{**rest, **state}[joint] for joint in coordinates.names[3:]], lower[3:], upper[3:]
        ),
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
        loose_joints = [
            joint
            for joint in coordinates.names[3:]
            if joint not in known_positions and joint not in state
        ]
        robot = apply_self_collision_analysis(robot, semantics, loose_joints, samples=_SAMPLES)
    _check_pairs_left(robot, semantics)
    return robot


def _check_arguments(
    base: Base,
    pairs: str,
    tool_frame: str | None,
    arm: str | None,
    locked_joints: Mapping[str, float] | None,
    home: Mapping[str, float] | None,
) -> tuple[Mapping[str, float], Mapping[str, float]]:
    """Check arguments of `load_robot`, and return locked joints and home positions."""
    for value, field, choices, kind in (
        (base, "base", _BASES, "kind of base"),
        (pairs, "pairs", _PAIRS, "source of pairs"),
    ):
        if not isinstance(value, str) or value not in choices:
            raise InputError(
                f"wrong {kind}", field=field, expected=" or ".join(choices), got=format_value(value)
            )
    for field, given_name, kind in (
        ("tool_frame", tool_frame, "the name of a frame"),
        ("arm", arm, "the name of a group"),
    ):
        if given_name is not None:
            check_text(given_name, field, kind)
    if arm is not None and tool_frame is not None:
        raise InputError(
            "`arm` and `tool_frame` exclude each other",
            field="arm, tool_frame",
            expected="one of them",
            got=f"{arm}, {tool_frame}",
        )
    positions = {}
    for field, values in (("locked_joints", locked_joints), ("home", home)):
        checked = check_mapping(
            {} if values is None else values, field, "joints, each with its position"
        )
        positions[field] = {
            joint: check_coordinate(value, f"{field}.{joint}") for joint, value in checked.items()
        }
    return positions["locked_joints"], positions["home"]


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
        return (
            self.source.resolve().parent.name
            if self.source.name == "robot.yaml"
            else self.source.stem
        )

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
        """Return the SRDF if its pairs or groups are needed; warn of what it names in vain."""
        if srdf is None or (pairs != "srdf" and group is None):
            return None
        semantics = read_srdf(srdf, self.urdf.root)
        for note in semantics.notes:
            warnings.warn(f"{srdf}: {note}", stacklevel=3)
        return semantics

    def find_tool_frame(
        self, semantics: Srdf | None, group: str | None, srdf: Path | None
    ) -> str | None:
        """Return the tip of the group that is planned, or the frame of robot.yaml, or None.

        Raises:
            UnknownNameError: There is no such group, or no SRDF.
        """
        if group is None:
            return self.settings.tool_frame
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
    document = Document({})
    settings = RobotSchema(urdf=source.name)
    if source.suffix != ".yaml" and (source.parent / "robot.yaml").is_file():
        srdf_path, _ = read_robot(source.parent / "robot.yaml")
        source = source.parent / "robot.yaml" if srdf_path.urdf == source.name else source
    if source.suffix == ".yaml":
        settings, document = read_robot(source)
    folders = {
        key: check_path(folder, f"packages.{key}", "a folder") for key, folder in packages.items()
    }
    folders = {
        **find_python_packages(tuple(p for p in settings.packages if p not in folders), document),
        **folders,
    }
    urdf = read_urdf(source.parent / settings.urdf, folders)
    apply_couplings(urdf, settings.couplings, document)
    return _RobotFiles(source, settings, document, urdf)


def find_robot_files(name: str | Path) -> tuple[Path | None, Path | None]:
    """Return the robot.yaml and the SRDF that `load_robot` reads for a robot, or None each."""
    files = _read_files(name, {})
    return files.source if files.source.suffix == ".yaml" else None, files.find_srdf()


def _check_pairs_left(robot: Robot, semantics: Srdf | None) -> None:
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
        text = f"{urdf.path}: {describe_misplaced_axle(drive)}"
        warnings.warn(
            f"{text}: its wheels will slide sideways; `vkc-pin doctor` names the axle", stacklevel=3
        )


def _read_rest_state(
    model: pin.Model,
    arm: Sequence[str],
    semantics: Srdf | None,
    group: str | None,
    known_positions: Collection[str],
) -> dict[str, float]:
    """Return the home positions of an arm's joints in an SRDF, without those already known."""
    state = {} if semantics is None else semantics.find_home(arm, group)
    return {
        joint: find_nearest_position(model, joint, state[joint])
        for joint in arm
        if joint in state and joint not in known_positions
    }
