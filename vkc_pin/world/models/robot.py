"""Robots: a URDF on a planar virtual base, with limits, a tool frame and convex collision geometry."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import whole
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.dynamics.torque_limits import TorqueLimits, compute_torque_limits
from vkc_pin.world.models.grafting import round_placement
from vkc_pin.world.models.grippers.gripper import Gripper
from vkc_pin.world.models.robot_model import load_visual_geometry
from vkc_pin.world.models.robot_schema import Wheels
from vkc_pin.world.models.shapes import compute_shape_distance, get_link_name, triangulate

__all__ = ["Base", "Robot"]

_MIN_LEVER = 0.1  # [m/rad] about the size of a hand
_FRONT_DISTANCE = 10.0  # [m] further than any hand reaches
_LEVER_SAMPLES = 200  # random ones over which the lever is averaged
_TIGHT_FACTOR = 0.5  # margin of links that are always close, as a share of what they can have

Base = Literal["omni", "differential", "ackermann", "fixed"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot:
    """A mobile manipulator.

    The coordinates z are (base_x, base_y, base_yaw, arm joints), [m] and [rad]; n is their number.

    Attributes:
        name: The robot's name.
        urdf: The URDF file it was read from.
        model: Joint 1, named "base", is planar; the planned joints follow. All other joints of the
            URDF are locked.
        collision: Convex shapes named `<link>_<k>`; the collision pairs are those that the robot
            must keep apart.
        coordinates: The minimal coordinates of `model`.
        lower, upper: Position limits, shape (n,), infinite for the yaw and for continuous joints.
        velocity, acceleration: Limits, shape (n,).
        home: Where the arm rests, shape (n − 3,).
        tool_frame: The frame of `model` that grasps: z is the approach direction, x the one in
            which fingers close.
        base: How the base moves: "omni" in any direction, "differential" along its x axis and
            round, "ackermann" along its x axis and in turns no tighter than `turning_radius`,
            "fixed" not at all.
        touch_links: The links that may touch what is grasped.
        height: Of its root link above the floor [m].
        gripper: How its fingers open, if its description says so; otherwise they stand still.
        wheels: The wheels of its base, if its description says; they limit bases that are
            "differential" or "ackermann".
        turning_radius: The least radius on which the base's origin turns if it is "ackermann" [m].
        tight: Pairs of links, each sorted, that are never, or not at home, 50 mm apart: how far
            they are at most, or there [m].
    """

    name: str
    urdf: Path
    model: pin.Model
    collision: pin.GeometryModel
    coordinates: Coordinates
    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    home: Floats
    tool_frame: str
    base: Base
    touch_links: tuple[str, ...] = ()
    height: float = 0.0
    gripper: Gripper | None = field(default=None, repr=False)
    wheels: Wheels | None = None
    turning_radius: float = 0.0
    tight: Mapping[tuple[str, str], float] = field(default_factory=dict, repr=False)
    file: UrdfFile = field(repr=False)
    _opened: dict[float, Robot] = field(default_factory=dict, repr=False)

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """What the robot looks like; read when first asked for, since meshes for display are large.

        Raises:
            InputError: A mesh cannot be read.
        """
        return load_visual_geometry(self.model, self.file)

    @cached_property
    def lever(self) -> float:
        """How far a radian moves the hand, on average over the arm's joints and over random postures [m/rad].

        It is the metric of searches, and says what driving costs beside turning and reaching. One
        number for all turns: were those of the wrist cheaper, searches would find long ones.
        """
        rng, data, frame = (
            np.random.default_rng(0),
            self.model.createData(),
            self.model.getFrameId(self.tool_frame),
        )
        turns = [k for k, unit in enumerate(self.coordinates.units) if k > 2 and unit == "rad"]
        if not turns:
            return _MIN_LEVER
        low, high = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        squares = np.zeros(len(turns))
        for z in rng.uniform(low, np.maximum(low, high), (_LEVER_SAMPLES, len(low))):
            jacobian = pin.computeFrameJacobian(
                self.model, data, self.coordinates.q(z), frame, pin.LOCAL_WORLD_ALIGNED
            )
            squares += (jacobian[:3, turns] ** 2).sum(axis=0)
        return max(float(np.sqrt(squares / _LEVER_SAMPLES).mean()), _MIN_LEVER)

    @cached_property
    def efforts(self) -> TorqueLimits:
        """The torques that its motors have, as far as its description can be relied upon."""
        return compute_torque_limits(self.model, self.coordinates, self.lower, self.upper)

    @cached_property
    def front(self) -> pin.SE3:
        """The foremost point of the hand in the tool frame, with its axes: as far along the approach as a touch link reaches."""
        frame = self.model.frames[self.model.getFrameId(self.tool_frame)]
        ahead = coal.Halfspace(
            np.array([0.0, 0.0, -1.0]), -_FRONT_DISTANCE
        )  # all that is so far before the tool
        carried = [s for s in self.collision.geometryObjects if s.parentJoint == frame.parentJoint]
        hand = [
            (s.geometry, frame.placement.actInv(s.placement))
            for s in carried
            if get_link_name(s.name) in self.touch_links
        ]
        gaps = [
            compute_shape_distance(geometry, where, ahead, pin.SE3.Identity())
            for geometry, where in hand
        ]
        return pin.SE3(
            np.eye(3), np.array([0.0, 0.0, _FRONT_DISTANCE - min(gaps, default=_FRONT_DISTANCE)])
        )

    @cached_property
    def fingerprint(self) -> str:
        """A digest of all that distances between its links depend on: shapes, where they are, limits, home, links and joints."""
        digest, data = hashlib.sha256(), self.model.createData()
        for joint in self.file.root.findall("joint"):
            ends = [
                element.get("link")
                for key in ("parent", "child")
                if (element := joint.find(key)) is not None
            ]
            digest.update(repr((joint.get("name"), joint.get("type"), ends)).encode())
        digest.update(repr((self.coordinates.names, list(self.model.parents))).encode())
        for values in (self.lower, self.upper, self.home):
            digest.update(np.asarray(values, float).tobytes())
        for z in np.random.default_rng(0).uniform(
            -3.0, 3.0, (3, len(self.lower))
        ):  # axes and placements, by what they do
            pin.forwardKinematics(self.model, data, self.coordinates.q(z))
            digest.update(np.array([place.homogeneous for place in data.oMi]).tobytes())
        for shape in self.collision.geometryObjects:
            points, faces = triangulate(shape.geometry)
            digest.update(repr((shape.name, shape.parentJoint, points.shape, faces.shape)).encode())
            digest.update(points.tobytes() + shape.placement.homogeneous.tobytes())
        return digest.hexdigest()

    def opening(self, asked: float | None) -> float | None:
        """Return how far its gripper opens, as near as it can to what is asked for [m]; None: nothing is, so that it rests."""
        return None if asked is None or self.gripper is None else self.gripper.clamp_opening(asked)

    def opened(self, opening: float | None) -> Robot:
        """Return the robot with its fingers locked where they are so far open [m]; None: the robot itself, with them at rest.

        Pairs and margins of its links stay the same.

        Raises:
            InputError: It has no gripper that opens, or that cannot be so far open.
        """
        if opening is None:
            return self
        if self.gripper is None:
            expected = "a `gripper` in its robot.yaml"
            raise InputError(
                f"the gripper of '{self.name}' does not open",
                field="opening",
                expected=expected,
                got=opening,
            )
        if opening not in self._opened:
            model, collision = pin.Model(self.model), self.collision.copy()
            for name, placement in self.gripper.compute_frames(opening).items():
                model.frames[model.getFrameId(name)].placement = placement
            for shape in collision.geometryObjects:
                old, new = (
                    there.frames[shape.parentFrame].placement for there in (self.model, model)
                )
                if old != new:
                    shape.placement = round_placement(new * old.actInv(shape.placement))
            self._opened[opening] = dataclasses.replace(
                self, model=model, collision=collision, _opened={}
            )
        return self._opened[opening]

    @property
    def start_limits(self) -> tuple[Floats, Floats]:
        """Limits of a start, shape (n,), [m] and [rad]: the robot's own; a base that cannot move may stand anywhere."""
        lower, upper = self.lower.copy(), self.upper.copy()
        if self.base == "fixed":
            lower[:3], upper[:3] = -np.inf, np.inf
        return lower, upper

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {len(self.home)} joints on a base that is {self.base}, tool frame {self.tool_frame}>"

    def link_of(self, geometry: int) -> str:
        """Return the name of the link that shape number `geometry` of `collision` belongs to.

        Raises:
            InputError: There is no such shape.
        """
        geometry = whole(geometry, "geometry", low=0, high=len(self.collision.geometryObjects) - 1)
        return get_link_name(self.collision.geometryObjects[geometry].name)

    def own_margin(self, links: tuple[str, str], margin: float) -> float:
        """Return the clearance [m] that two of its links, sorted, can keep: `margin`, or half of what they have at most."""
        return min(margin, _TIGHT_FACTOR * self.tight.get(links, np.inf))

    def own_margins(self, margin: float) -> dict[tuple[int, int], float]:
        """Return for each of its collision pairs, by the numbers of its shapes, the clearance to keep [m].

        Program and validation ask for it alike.

        Args:
            margin: What pairs keep that can: `Options.self_distance` [m].
        """
        found, links = {}, [get_link_name(shape.name) for shape in self.collision.geometryObjects]
        for pair in self.collision.collisionPairs:
            one, other = sorted((links[pair.first], links[pair.second]))
            found[pair.first, pair.second] = self.own_margin((one, other), margin)
        return found

    @property
    def links(self) -> tuple[str, ...]:
        """The links that have collision geometry, each once."""
        return tuple(
            dict.fromkeys(get_link_name(shape.name) for shape in self.collision.geometryObjects)
        )
