"""Reads a robot from its files: a URDF, a robot.yaml that says what a URDF cannot, and an SRDF."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, shown
from vkc_pin.utils.arguments import mapping, quantity, text
from vkc_pin.world.files import resources
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.resources import file_path
from vkc_pin.world.files.srdf import Srdf, group_tip, read_srdf
from vkc_pin.world.files.urdf import UrdfFile, read_urdf
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings.coupled_joints import apply_couplings
from vkc_pin.world.models.couplings.limits import apply_robot_limits, tighten_coupled_limits
from vkc_pin.world.models.grippers.gripper import build_gripper
from vkc_pin.world.models.robot import Base, Robot
from vkc_pin.world.models.robot_model import (
    build_full_model,
    build_planned_model,
    compute_rest_positions,
    find_base_joints,
    find_default_tool_frame,
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

__all__ = ["find_robot", "list_robots", "load_robot"]

_BASES = get_args(Base)
_PAIRS = ("srdf", "sampled", "all")
_SAMPLES = 1000  # to find allowed pairs when a robot without an SRDF is loaded
# Names under which example-robot-data loads URDF files called otherwise.
_ALIASES = {
    "anymal_kinova": "anymal-kinova",
    "asr_twodof": "TwoDofs",
    "b1_z1": "b1-z1",
    "hyq": "hyq_no_sensors",
    "solo8": "solo",
}


def list_robots() -> dict[str, Path]:
    """Return the names `load_robot` knows and their files: those in robots/, then those of example-robot-data."""
    known = {
        path.parent.name: path for path in sorted(resources.folder("robots").glob("*/robot.yaml"))
    }
    folder = resources.example_robot_data()
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
        name: A name of `list_robots`, or the path of a URDF file, of a robot.yaml, or of a folder
            that holds one. Text is a path if it has the ending of such a file or a slash in it.

    Raises:
        UnknownNameError: It is neither.
        InputError: There is no such file.
    """
    path = Path(name)
    if isinstance(name, Path) or path.suffix.lower() in (".urdf", ".yaml", ".yml") or "/" in name:
        file = path / "robot.yaml" if path.is_dir() else path
        if not file.is_file():
            raise InputError(
                "there is no such robot",
                file=file,
                expected="a URDF file, a robot.yaml, or a robot's name",
            )
        return file
    known = list_robots()
    if name not in known:
        raise UnknownNameError("robot", str(name), known)
    return known[str(name)]


def load_robot(
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
    prismatic. Joints that follow one of these (<mimic>, or `couplings` in robot.yaml) move with it,
    wherever they are: together they have one coordinate, that of the joint they follow.

    Limits come from the URDF and from a `robot.yaml` beside it. Where neither names a velocity or
    an acceleration they are π rad/s (m/s) and 1.4 rad/s² (m/s²) for joints, 1 m/s, 2 rad/s, 3 m/s²
    and 6 rad/s² for the base, ±20 m.

    Where the URDF begins with joints that drive the robot about, the virtual base takes their
    place: they are locked at 0, with a warning unless something says where, and unless `base` is
    "fixed".

    Pairs of links that may touch come from the SRDF. Without one they are adjacent links and those
    that sampling finds always, or never, in collision. In any case neighbours may that are always
    close, links that always overlap, and those that overlap at home; see
    `vkc_pin.world.models.self_collisions`. There is a warning where these are not neighbours.

    Args:
        name: A robot in robots/, one of example-robot-data ("panda", "tiago", "ur5"), or the path
            of a URDF.
        base: "omni", "differential" (not sideways), "ackermann" (nor tighter than `turning_radius`)
            or "fixed" (limits of 0).
        tool_frame: The frame that grasps; by default that of robot.yaml, else the last frame of the
            longest chain.
        arm: A group of the SRDF, instead of `tool_frame`: the link at its end grasps.
        locked_joints: More joints to lock, and where, [m] or [rad]; joints locked anyway rest at 0
            or the nearest limit.
        home: Where joints rest, [m] or [rad]; by default what robot.yaml says, else a group state
            of the SRDF that covers all planned joints (one called home if there is one), else 0, or
            the middle if 0 is outside the limits. Where links overlap there, joints of which nobody
            says where they rest are moved, with a warning.
        srdf: File of allowed collisions; by default the one robot.yaml names, or the one beside the
            URDF.
        pairs: Where the allowed pairs come from: "srdf"; "sampled" whether there is an SRDF or not;
            "all" makes every pair of links that move against each other a collision pair, even
            adjacent ones, to look at the geometry itself.
        packages: Folders for `package://` addresses; others are looked for around the file.
        height: Of the root link above the floor [m]; by default what robot.yaml says, else 0.
        turning_radius: Of an "ackermann" base, the least radius on which its root link turns [m];
            by default robot.yaml's.

    Raises:
        UnknownNameError: There is no such robot, frame, joint or link; the error names the nearest
            one.
        InputError: A file or value is wrong, no joint would be planned, or nothing could collide.
    """
    for value, field, choices, kind in (
        (base, "base", _BASES, "kind of base"),
        (pairs, "pairs", _PAIRS, "source of pairs"),
    ):
        if not isinstance(value, str) or value not in choices:
            raise InputError(
                f"wrong {kind}", field=field, expected=" or ".join(choices), got=shown(value)
            )
    for field, given_name, kind in (
        ("tool_frame", tool_frame, "the name of a frame"),
        ("arm", arm, "the name of a group"),
    ):
        if given_name is not None:
            text(given_name, field, kind)
    if arm is not None and tool_frame is not None:
        raise InputError(
            "both say what grasps",
            field="arm, tool_frame",
            expected="one of them",
            got=f"{arm}, {tool_frame}",
        )
    positions = {}
    for field, values in (("locked_joints", locked_joints), ("home", home)):
        named = mapping({} if values is None else values, field, "joints, each with its position")
        positions[field] = {
            joint: quantity(value, f"{field}.{joint}") for joint, value in named.items()
        }
    home, locked_joints = positions["home"], positions["locked_joints"]
    files = _read_files(
        name,
        mapping({} if packages is None else packages, "packages", "packages, each with its folder"),
    )
    urdf, settings = files.urdf, files.settings
    beside = file_path(srdf, "srdf") if srdf is not None else files.srdf()
    semantics = (
        read_srdf(beside, links=urdf.links) if beside is not None and pairs == "srdf" else None
    )
    full = build_full_model(urdf)
    tool = (
        tool_frame
        if tool_frame is not None
        else files.tool_frame(arm, beside) or find_default_tool_frame(full, urdf)
    )
    if tool not in (frames := dict.fromkeys(frame.name for frame in full.frames)):
        raise UnknownNameError("frame", tool, frames, file=urdf.path, field="tool_frame")
    full = tighten_coupled_limits(full, urdf, tool)
    replaced = find_base_joints(full, urdf) if base != "fixed" else ()
    fingers = {joint: finger.open for joint, finger in settings.gripper.items()}
    said = {**settings.locked_joints, **locked_joints}
    locked = {**fingers, **dict.fromkeys(replaced, 0.0), **said}
    given = {**settings.home, **home, **locked}
    rest = compute_rest_positions(full, urdf, given)
    files.check_names(rest)
    for joint in given:
        field = "home" if joint in home else "locked_joints"
        if joint not in rest:
            raise UnknownNameError("joint", joint, rest, file=urdf.path, field=field)
        if joint in said or joint not in (*replaced, *fingers):
            files.check_limits(full, joint, given[joint], field)
    if unsaid := ", ".join(joint for joint in replaced if joint not in said):
        problem = "the virtual base moves the robot; joints of its own that do are locked"
        warnings.warn(f"{urdf.path}: {problem}: {unsaid}", stacklevel=2)
    raised, rest = (
        settings.base.height if height is None else quantity(height, "height"),
        {**rest, **locked},
    )
    model = build_planned_model(full, urdf, tool, rest, locked, height=raised)
    coordinates, lower, upper, velocity, acceleration = apply_robot_limits(
        full, model, settings, base
    )
    files.check_followers(model, rest, given)
    state = _read_rest_state(model, coordinates.names[3:], semantics, given)
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
        home=np.clip(
            [{**rest, **state}[joint] for joint in coordinates.names[3:]], lower[3:], upper[3:]
        ),  # rounding
        tool_frame=tool,
        base=base,
        touch_links=settings.touch_links,
        height=raised,
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
            height=raised,
        ),
        file=urdf,
    )
    if pairs == "all":
        robot = set_collision_pairs(robot, ())
    else:
        loose = [
            joint for joint in coordinates.names[3:] if joint not in given and joint not in state
        ]
        robot = apply_self_collision_analysis(robot, semantics, loose, samples=_SAMPLES)
    if len(robot.collision.collisionPairs) == 0 and (pairs == "all" or semantics is not None):
        expected = "<collision> elements, and an SRDF that fits"
        raise InputError(
            "no pair of links is left that could collide", file=robot.urdf, expected=expected
        )
    return robot


@dataclass(frozen=True, eq=False)
class _RobotFiles:
    """A robot's files: `source`, its robot.yaml or else its URDF; what the first says; and the URDF."""

    source: Path
    settings: RobotSchema
    document: Document
    urdf: UrdfFile

    @property
    def name(self) -> str:
        """The robot's name: that of its folder or its file."""
        return (
            self.source.resolve().parent.name
            if self.source.name == "robot.yaml"
            else self.source.stem
        )

    def srdf(self) -> Path | None:
        """Return the SRDF that belongs to the URDF: named in robot.yaml, or found by its name."""
        if self.settings.srdf is not None:
            return self.source.parent / self.settings.srdf
        path = self.urdf.path
        stems = (path.stem, path.stem.removesuffix("_robot"))
        places = [
            folder / f"{stem}.srdf"
            for stem in stems
            for folder in (path.parent, path.parent.parent / "srdf")
        ]
        return next((place for place in places if place.is_file()), None)

    def tool_frame(self, arm: str | None, srdf: Path | None) -> str | None:
        """Return the frame that grasps, as a group of the SRDF or robot.yaml names it; None if neither does."""
        named = self.settings.arm if arm is None else arm
        return self.settings.tool_frame if named is None else group_tip(srdf, self.urdf.root, named)

    def check_names(self, joints: Collection[str]) -> None:
        """Check that the joints and links that robot.yaml names exist. Raises `UnknownNameError` if one does not."""
        settings = self.settings
        for key in ("home", "locked_joints", "gripper", "joints"):
            for joint in getattr(settings, key):
                if joint not in joints:
                    raise self.document.unknown((key, joint), "joint", joint, joints)
        for link in settings.touch_links:
            if link not in self.urdf.links:
                raise self.document.unknown(("touch_links",), "link", link, self.urdf.links)

    def check_limits(self, full: pin.Model, joint: str, position: float, field: str) -> None:
        """Check that a joint can be where it is said to rest, or to be locked. Raises `InputError` if it cannot."""
        moving = full.joints[full.getJointId(joint)]
        if moving.nq == 1:
            low, high = full.lowerPositionLimit[moving.idx_q], full.upperPositionLimit[moving.idx_q]
            if not low - LIMIT_SLACK <= position <= high + LIMIT_SLACK:
                problem, expected = "rests outside its limits", f"between {low:g} and {high:g}"
                for key, said in (
                    ("locked_joints", self.settings.locked_joints),
                    ("home", self.settings.home),
                ):
                    if said.get(joint) == position:
                        raise self.document.error(
                            (key, joint), problem, expected=expected, got=position
                        )
                raise InputError(
                    problem,
                    file=self.urdf.path,
                    field=f"{field}.{joint}",
                    expected=expected,
                    got=position,
                )

    def check_followers(
        self, model: pin.Model, rest: Mapping[str, float], given: Collection[str]
    ) -> None:
        """Check that joints `given` a place to rest at follow those that they follow. Raises `InputError` if one does not."""
        coordinates = Coordinates(model)
        for move in coordinates.moves[3:]:
            joint, leader = str(model.names[move.joint]), coordinates.names[move.coordinate]
            if joint != leader and joint in given:
                follows = move.factor * rest[leader] + move.offset
                if abs(rest[joint] - follows) > LIMIT_SLACK:
                    problem, expected = f"this joint follows '{leader}'", f"{follows:g}, or nothing"
                    if joint in self.settings.home:
                        raise self.document.error(
                            ("home", joint), problem, expected=expected, got=rest[joint]
                        )
                    raise InputError(
                        problem,
                        file=self.urdf.path,
                        field=f"home.{joint}",
                        expected=expected,
                        got=rest[joint],
                    )


def _read_files(name: str | Path, packages: Mapping[str, str | Path]) -> _RobotFiles:
    """Find and read a robot's URDF, and the robot.yaml that belongs to it if there is one."""
    file_path(name, "name", "a robot's name, or a path")
    source = find_robot(name)
    document = Document({})
    settings = RobotSchema(urdf=source.name)
    if source.suffix != ".yaml" and (source.parent / "robot.yaml").is_file():
        beside, _ = read_robot(source.parent / "robot.yaml")
        source = source.parent / "robot.yaml" if beside.urdf == source.name else source
    if source.suffix == ".yaml":
        settings, document = read_robot(source)
    folders = {
        key: file_path(folder, f"packages.{key}", "a folder") for key, folder in packages.items()
    }
    folders = {
        **find_python_packages(tuple(p for p in settings.packages if p not in folders), document),
        **folders,
    }
    urdf = read_urdf(source.parent / settings.urdf, folders)
    apply_couplings(urdf, settings.couplings, document)
    return _RobotFiles(source, settings, document, urdf)


def _read_rest_state(
    model: pin.Model, arm: Sequence[str], semantics: Srdf | None, given: Collection[str]
) -> dict[str, float]:
    """Return where an SRDF says that the joints of an arm rest, those `given` otherwise left out."""
    state = {} if semantics is None else semantics.state(arm)
    return {
        joint: find_nearest_position(model, joint, state[joint])
        for joint in arm
        if joint in state and joint not in given
    }
