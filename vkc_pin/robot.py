"""Robots: a URDF on a planar virtual base, with limits, a tool frame and convex collision geometry."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.coordinates import Coordinates
from vkc_pin.documents import Document
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.geometry import link_name
from vkc_pin.robot_files import RobotFile, find_robot, read_urdf
from vkc_pin.robot_geometry import collision_geometry, visual_geometry
from vkc_pin.robot_model import default_tool_frame, full_model, planned_model, rest_positions, within_limits
from vkc_pin.robot_schema import RobotSchema, python_packages, read_robot
from vkc_pin.srdf import read_srdf

__all__ = ["Robot", "add_pairs", "load_robot"]

Base = Literal["omni", "differential", "fixed"]
_BASES = ("omni", "differential", "fixed")
_PAIRS = ("srdf", "sampled", "all")
_VELOCITY, _ACCELERATION = np.pi, 1.4  # of joints for which no file names one, [rad/s] and [rad/s²], or [m/s] and [m/s²]
_SAMPLES = 1000  # to find allowed pairs when a robot without an SRDF is loaded


@dataclass(frozen=True, eq=False)
class Robot:
    """A mobile manipulator.

    The coordinates z are (base_x, base_y, base_yaw, arm joints), [m] and [rad]; n is their number.

    Attributes:
        name: The robot's name.
        urdf: The URDF file it was read from.
        model: Joint 1, named "base", is planar; the planned joints follow. All other joints of the URDF are locked.
        collision: Convex shapes named `<link>_<k>`; the collision pairs are those that the robot must keep apart.
        coordinates: The minimal coordinates of `model`.
        lower, upper: Position limits, shape (n,), infinite for the yaw and for continuous joints.
        velocity, acceleration: Limits, shape (n,).
        home: Where the arm rests, shape (n − 3,).
        tool_frame: The frame of `model` that grasps: z is the approach direction, x the one in which fingers close.
        base: How the base moves: "omni" any way, "differential" forwards and round, "fixed" not at all.
        touch_links: The links that may touch what is grasped.
    """

    name: str
    urdf: Path
    model: pin.Model
    collision: pin.GeometryModel
    coordinates: Coordinates
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    home: NDArray[np.float64]
    tool_frame: str
    base: Base
    touch_links: tuple[str, ...] = ()
    file: RobotFile = field(repr=False, kw_only=True)

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """What the robot looks like; read when first asked for, since meshes for display are large.

        Raises:
            InputError: A mesh cannot be read.
        """
        return visual_geometry(self.model, self.file)

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {len(self.home)} joints on a base that is {self.base}, tool frame {self.tool_frame}>"

    def link_of(self, geometry: int) -> str:
        """Return the name of the link that shape number `geometry` of `collision` belongs to."""
        return link_name(self.collision.geometryObjects[geometry].name)

    @property
    def links(self) -> tuple[str, ...]:
        """The links that have collision geometry, each once."""
        return tuple(dict.fromkeys(link_name(shape.name) for shape in self.collision.geometryObjects))

    @property
    def base_links(self) -> tuple[str, ...]:
        """The links with collision geometry that drive along with the base: they stand on the floor."""
        return tuple(dict.fromkeys(link_name(shape.name) for shape in self.collision.geometryObjects if shape.parentJoint == 1))

    def rest(self) -> NDArray[np.float64]:
        """Return the coordinates, shape (n,), of the arm at home and the base at the origin."""
        return np.concatenate([np.zeros(3), self.home])


def load_robot(
    name: str | Path,
    *,
    base: Base = "omni",
    tool_frame: str | None = None,
    locked_joints: Mapping[str, float] | None = None,
    home: Mapping[str, float] | None = None,
    srdf: str | Path | None = None,
    pairs: Literal["srdf", "sampled", "all"] = "srdf",
    packages: Mapping[str, str | Path] | None = None,
) -> Robot:
    """Load a robot and put it on a planar virtual base.

    The joints on the way from the root to the tool frame are planned. All others (wheels, heads, other arms, fingers) are
    locked, as are joints that mimic others and joints of a type other than revolute, continuous and prismatic.

    Limits come from the URDF and from a `robot.yaml` beside it. Where neither names a velocity or an acceleration they
    are π rad/s (m/s) and 1.4 rad/s² (m/s²) for joints, 1 m/s, 2 rad/s, 3 m/s² and 6 rad/s² for the base, ±20 m.

    Pairs of links that may touch come from the SRDF. Without one they are adjacent links and those that sampling
    finds always, or never, in collision (`vkc_pin.allowed_collisions`).

    Args:
        name: A robot in robots/, one of example-robot-data ("panda", "tiago", "ur5"), or the path of a URDF.
        base: "omni", "differential" (the planner keeps it from moving sideways) or "fixed" (its limits are 0).
        tool_frame: The frame that grasps; by default that of robot.yaml, else the last frame of the longest chain.
        locked_joints: More joints to lock, and where, [m] or [rad]; joints locked anyway rest at 0 or the nearest limit.
        home: Where joints rest, [m] or [rad]; by default what robot.yaml says, else a group state of the SRDF that
            covers all planned joints (one called home if there is one), else 0, or the middle if 0 is outside the limits.
        srdf: File of allowed collisions; by default the one robot.yaml names, or the one beside the URDF.
        pairs: Where the allowed pairs come from: "srdf"; "sampled" whether there is an SRDF or not; "all" makes every pair
            of links that move against each other a collision pair, even adjacent ones, to look at the geometry itself.
        packages: Folders for `package://` addresses; others are looked for around the file.

    Raises:
        UnknownNameError: There is no such robot, frame, joint or link; the error names the nearest one.
        InputError: A file or value is wrong, no joint would be planned, or nothing could collide.
    """
    if base not in _BASES:
        raise InputError("wrong kind of base", field="base", expected=" or ".join(_BASES), got=base)
    if pairs not in _PAIRS:
        raise InputError("wrong source of pairs", field="pairs", expected=" or ".join(_PAIRS), got=pairs)
    source = find_robot(str(name))
    document = Document({})
    settings = RobotSchema(urdf=source.name)
    if source.suffix != ".yaml" and (source.parent / "robot.yaml").is_file():
        beside, _ = read_robot(source.parent / "robot.yaml")
        source = source.parent / "robot.yaml" if beside.urdf == source.name else source
    if source.suffix == ".yaml":
        settings, document = read_robot(source)
    folders = {key: Path(folder) for key, folder in (packages or {}).items()}
    folders = {**python_packages(tuple(p for p in settings.packages if p not in folders), document), **folders}
    file = read_urdf(source.parent / settings.urdf, folders)
    srdf_file = Path(srdf) if srdf is not None else _srdf_beside(file, settings, source)
    semantics = read_srdf(srdf_file, links=file.links) if srdf_file is not None and pairs == "srdf" else None

    full = full_model(file)
    tool = tool_frame if tool_frame is not None else settings.tool_frame or default_tool_frame(full, file)
    if tool not in (frames := dict.fromkeys(frame.name for frame in full.frames)):
        raise UnknownNameError("frame", tool, frames, file=file.path, field="tool_frame")
    locked = {**settings.locked_joints, **(locked_joints or {})}
    given = {**settings.home, **(home or {}), **locked}
    rest = rest_positions(full, file, given)
    for key, joints in (("home", settings.home), ("locked_joints", settings.locked_joints), ("joints", settings.joints)):
        for joint in joints:
            if joint not in rest:
                raise document.unknown((key, joint), "joint", joint, rest)
    for joint in given:
        if joint not in rest:
            raise UnknownNameError(
                "joint", joint, rest, file=file.path, field="home" if joint in (home or {}) else "locked_joints"
            )
    model = planned_model(full, file, tool, rest, locked)
    arm = list(model.names)[2:]
    if semantics is not None:
        state = semantics.state(arm)
        rest.update({joint: within_limits(model, joint, state[joint]) for joint in arm if joint in state and joint not in given})
    for link in settings.touch_links:
        if link not in file.links:
            raise document.unknown(("touch_links",), "link", link, file.links)
    coordinates, lower, upper, velocity, acceleration = _limits(model, settings, base)
    resting = np.array([rest[joint] for joint in arm])
    if (outside := np.flatnonzero((resting < lower[3:] - 1e-9) | (resting > upper[3:] + 1e-9))).size:
        k = int(outside[0])
        limits = f"between {lower[3 + k]:g} and {upper[3 + k]:g}"
        raise InputError(
            "rests outside its limits", file=document.file or file.path, field=f"home.{arm[k]}", expected=limits, got=resting[k]
        )
    robot = Robot(
        name=source.resolve().parent.name if source.name == "robot.yaml" else source.stem,
        urdf=file.path,
        model=model,
        collision=collision_geometry(model, file),
        coordinates=coordinates,
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        home=resting,
        tool_frame=tool,
        base=base,
        touch_links=settings.touch_links,
        file=file,
    )
    add_pairs(robot, () if pairs == "all" else None if semantics is None else semantics.allowed)
    return robot


def add_pairs(robot: Robot, allowed: Collection[tuple[str, str]] | None) -> None:
    """Make the collision pairs of `robot` those of its links that move against each other, less the `allowed` ones.

    Args:
        robot: Changed in place.
        allowed: Pairs of links, each sorted; None to find them by sampling.

    Raises:
        InputError: No pair is left by an `allowed` that was given.
    """
    sampled = allowed is None
    if allowed is None:
        from vkc_pin.allowed_collisions import sample_allowed_pairs

        allowed = sample_allowed_pairs(robot, samples=_SAMPLES)
    robot.collision.removeAllCollisionPairs()
    shapes = robot.collision.geometryObjects
    for first, second in itertools.combinations(range(len(shapes)), 2):
        links = tuple(sorted((robot.link_of(first), robot.link_of(second))))
        if shapes[first].parentJoint != shapes[second].parentJoint and links not in allowed:
            robot.collision.addCollisionPair(pin.CollisionPair(first, second))
    if len(robot.collision.collisionPairs) == 0 and not sampled:
        raise InputError(
            "no pair of links is left that could collide", file=robot.urdf, expected="<collision> elements, and an SRDF that fits"
        )


def _srdf_beside(file: RobotFile, settings: RobotSchema, source: Path) -> Path | None:
    """Return the SRDF that belongs to `file`: named in robot.yaml, or found by its name."""
    if settings.srdf is not None:
        return source.parent / settings.srdf
    stems = (file.path.stem, file.path.stem.removesuffix("_robot"))
    places = [folder / f"{stem}.srdf" for stem in stems for folder in (file.path.parent, file.path.parent.parent / "srdf")]
    return next((place for place in places if place.is_file()), None)


def _limits(
    model: pin.Model, settings: RobotSchema, base: Base
) -> tuple[Coordinates, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Write the limits into `model` and return its coordinates with (lower, upper, velocity, acceleration), shape (n,) each."""
    low, high = np.array(settings.base.position).T if base != "fixed" else (np.zeros(2), np.zeros(2))
    position_low, position_high, velocity = model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit
    position_low[:2], position_high[:2], velocity[:3] = low, high, settings.base.velocity
    acceleration = np.full(model.nv, _ACCELERATION)
    acceleration[:3] = settings.base.acceleration
    for j in range(2, model.njoints):
        v, named = model.joints[j].idx_v, settings.joints.get(model.names[j])
        if named is not None and named.velocity is not None:
            velocity[v] = named.velocity
        elif not 0.0 < velocity[v] < 1e3:  # Pinocchio's value for a joint without limit is the largest number
            velocity[v] = _VELOCITY
        if named is not None and named.acceleration is not None:
            acceleration[v] = named.acceleration
    model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit = position_low, position_high, velocity
    coordinates = Coordinates(model)
    lower, upper = coordinates.lower.copy(), coordinates.upper.copy()
    if base == "fixed":
        lower[:3] = upper[:3] = 0.0
    return coordinates, lower, upper, coordinates.velocity.copy(), acceleration
