"""Builds the virtual kinematic chain: virtual base, robot and inverted objects in one model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.chain.inversion import invert
from vkc_pin.planning.chain.kinematics import Kinematics, get_kinematics
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, graft_geometry, round_placement
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment, make_holds, resolve_holds
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import SupportedObject

__all__ = ["Closure", "VirtualKinematicChain", "consolidate"]

FREEDOM_VELOCITY = 1.0  # [rad/s] or [m/s], limit of a freedom of the grasp
FREEDOM_ACCELERATION = 2.0


@dataclass(frozen=True, eq=False)
class Closure:
    """h_chain of eq. 2: target pose of a held object's base link.

    Attributes:
        joint: Joint of the chain that carries the base link.
        local: Placement of the base link on that joint.
        target: Placement in the world: where a fixed object stays, or a free one is grasped.
    """

    joint: int
    local: pin.SE3
    target: pin.SE3


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualKinematicChain:
    """C^V: one model of everything that moves together.

    Attributes:
        robot: The robot at its root.
        model: Joint 1 is the planar virtual base, followed by the arm and, for each grasp, the
            virtual joint of the attachment and the object's joints down to its base, inverted.
        coordinates: Minimal coordinates z of `model`.
        names: Coordinate names, shape (n,); `<object>.<joint>` or `<object>.<attachment>`.
        lower, upper, velocity, acceleration: Limits, shape (n,), SI units.
        collision: Collision geometry of the robot, then of the moving parts of objects.
        held_geometries: Hold → indices in `collision` of the geometry that moves with it.
        ride_geometries: Ride → indices in `collision` of the supported object's geometry.
        closures: Hold → closure of the object's base link.
        virtual: Hold → names of the coordinates of its attachment's virtual joint.
        added: Hold → names of all its coordinates: virtual joint and object joints.
        prefixes: Hold → prefix of the object's frames and joints in `model`.
        cache: Cache of functions built for the chain, shared with others.
    """

    robot: Robot
    model: pin.Model
    coordinates: Coordinates
    names: tuple[str, ...]
    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    collision: pin.GeometryModel
    held_geometries: Mapping[Hold, tuple[int, ...]]
    ride_geometries: Mapping[SupportedObject, tuple[int, ...]]
    closures: Mapping[Hold, Closure]
    virtual: Mapping[Hold, tuple[str, ...]]
    added: Mapping[Hold, tuple[str, ...]]
    prefixes: Mapping[Hold, str]
    cache: Cache = field(repr=False)

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return len(self.names)

    @cached_property
    def metric(self) -> Floats:
        """Weight of each coordinate in searches, shape (n,), [rad/m] and 1.

        It converts displacements to equivalent rotations: a metre counts as the rotation that moves
        the hand by a metre, see `Robot.lever`. The displacements of coupled joints add up.
        """
        return self.coordinates.turns + self.coordinates.lengths / self.robot.lever

    @cached_property
    def _kinematics(self) -> Kinematics:
        """Kinematics, stored here because a cache lookup takes as long as an evaluation."""
        return get_kinematics(self.model, self.cache)

    def joint_placements(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the world placements of all joints at z, shape (W, n); joint 0 is the world.

        Returns:
            Rotations, shape (W, J, 3, 3), and translations, shape (W, J, 3) [m].
        """
        batch, joints = len(z), self.model.njoints
        (columns,) = self._kinematics.batch(z)
        columns = columns.reshape(batch, joints - 1, 12)
        rotations, translations = np.zeros((batch, joints, 3, 3)), np.zeros((batch, joints, 3))
        rotations[:, 0] = np.eye(3)
        rotations[:, 1:] = columns[..., :9].reshape(batch, joints - 1, 3, 3).swapaxes(2, 3)
        translations[:, 1:] = columns[..., 9:]
        return rotations, translations

    @cached_property
    def carries(self) -> Bools:
        """Mask of shape (J, J): whether joint j moves when joint k does."""
        joints = range(self.model.njoints)
        return np.array([[k in self.model.supports[j] for k in joints] for j in joints])

    @cached_property
    def motions(self) -> tuple[Ints, Ints, Floats, Floats, Bools]:
        """Coordinate and joint, (m,), of each of `Coordinates.moves`, and the joint's velocity.

        Linear and angular velocity, shape (m, 3), are in the joint's frame, but the linear velocity
        of planar joints is along the world's axes: a mask, shape (m,).
        """
        data, moves = self.model.createData(), self.coordinates.moves
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        linear, angular = np.zeros((2, len(moves), 3))
        fixed = np.zeros(len(moves), bool)
        for row, move in enumerate(moves):
            if str(self.model.joints[move.joint].shortname()) == "JointModelPlanar":
                part = move.coordinate - self.coordinates.joints.index(move.joint)
                fixed[row] = part < 2
                (linear if part < 2 else angular)[row, part] = 1.0
            else:
                motion = np.asarray(data.joints[move.joint].S, float).ravel()
                linear[row], angular[row] = motion[:3], motion[3:]
        coordinates, joints = np.array([(move.coordinate, move.joint) for move in moves]).T
        return coordinates, joints, linear, angular, fixed

    def point_jacobians(self, z: Floats, which: Ints, joint: Ints, point: Floats) -> Floats:
        """Return the Jacobians of points that are fixed in joints' frames, shape (C, 3, n).

        Args:
            z: Configurations, shape (B, n).
            which: Configuration of each point, shape (C,).
            joint: Joint that carries the point, shape (C,); 0 is the world.
            point: Position of the point in the world, shape (C, 3) [m].
        """
        coordinate, owner, linear, angular, fixed = self.motions
        rotations, translations = self.joint_placements(z)
        axes = rotations[:, owner]
        translating = np.where(fixed[:, None], linear, np.einsum("bnij,nj->bni", axes, linear))
        rotating = np.einsum("bnij,nj->bni", axes, angular)[which]
        arm = point[:, None] - translations[:, owner][which]
        motion = translating[which] + np.cross(rotating, arm)
        motion = motion * self.carries[joint][:, owner, None]
        firsts = np.searchsorted(coordinate, np.arange(self.size))
        return np.asarray(np.add.reduceat(motion, firsts, axis=1).swapaxes(1, 2))

    def get_collision_geometry(self, opening: float | None) -> pin.GeometryModel:
        """Return the collision geometry with the robot's gripper at an opening [m].

        If `opening` is None, the gripper is as in the robot's home configuration.
        """
        if opening is None:
            return self.collision
        geometry = self.collision.copy()
        for k, shape in enumerate(self.robot.opened(opening).collision.geometryObjects):
            geometry.geometryObjects[k].placement = shape.placement
        return geometry

    def index(self, name: str) -> int:
        """Return the position of coordinate `name` in z.

        Raises:
            UnknownNameError: There is no such coordinate.
        """
        if name not in self.names:
            raise UnknownNameError("coordinate", name, self.names)
        return self.names.index(name)

    def holder(self, hold: Hold) -> tuple[int, pin.SE3]:
        """Return the joint that carries the frame of a hold, and the frame's placement on it."""
        if hold.by is None:
            return self.frame(self.robot.tool_frame)
        return self.frame(str(hold.link), hold.by)

    def frame(
        self, name: str, hold: Hold | None = None, *, opening: float | None = None
    ) -> tuple[int, pin.SE3]:
        """Return the joint that carries a frame or a link of `hold`, and its placement on it.

        `opening` [m] of the gripper determines the frames of its fingers. Default: home
        configuration.
        """
        if hold is None:
            model = self.robot.opened(opening).model  # the chain starts with the robot's joints
        else:
            model, name = self.model, self.prefixes[hold] + name
        frame = model.frames[model.getFrameId(name)]
        return frame.parentJoint, pin.SE3(frame.placement)


def consolidate(
    scene: Scene,
    holds: Iterable[Hold] | Mapping[str, str],
    *,
    rides: Iterable[SupportedObject] = (),
    cache: Cache | None = None,
) -> VirtualKinematicChain:
    """Merge the scene's robot with the objects it holds into one model (section III of the paper).

    Branches of an object that are not on the path from grasp to base are locked.

    Args:
        scene: Robot and placed objects.
        holds: All holds at any time, each after the hold it depends on; or object → attachment, all
            held by the tool. Several holds become branches of one tree.
        rides: Objects supported by links of held objects at any time.
        cache: Cache of the chain's kinematics. Defaults to one of its own.

    Raises:
        UnknownNameError: The scene has no such object, or the object no such attachment.
        InputError: Two grasps move the same joint, or a freedom of a grasp has the name of a joint.
    """
    robot = check_instance(scene, Scene, "scene").robot
    holds = resolve_holds(scene.objects, make_holds(holds) if isinstance(holds, Mapping) else holds)
    cache = Cache() if cache is None else check_instance(cache, Cache, "cache")
    model, collision = pin.Model(robot.model), pin.GeometryModel()
    shapes, joints = robot.collision.geometryObjects, list(range(model.njoints))
    graft_geometry(collision, shapes, joints=joints, placement=pin.SE3.Identity())
    names = list(robot.coordinates.names)
    limits = [*zip(robot.lower, robot.upper, robot.velocity, robot.acceleration, strict=True)]
    held_geometries, closures, virtual, hold_coordinates = {}, {}, {}, {}
    prefixes: dict[Hold, str] = {}
    for hold in holds:
        name, placed = hold.object, scene.objects[hold.object]
        item, attachment = placed.object, get_attachment(scene.objects, hold)
        # Pinocchio finds frames by unique names: a second branch of an object gets another prefix.
        prefix = prefixes[hold] = name + "'" * sum(other.object == name for other in prefixes) + "."
        holder = robot.tool_frame if hold.by is None else f"{prefixes[hold.by]}{hold.link}"
        tool = model.frames[model.getFrameId(holder)]
        placement = tool.placement * compute_hand_frame(robot, attachment)
        parent, placement, added = _add_virtual_joint(
            model, tool.parentJoint, placement * attachment.offset.inverse(), attachment, name
        )
        virtual[hold] = tuple(added)
        limits += added.values()
        tree, shapes = invert(item, attachment.link, placed.state)
        placement = round_placement(placement * attachment.placement.inverse())
        joints = graft(model, tree, parent=parent, placement=placement, prefix=prefix)
        of_object = zip(item.lower, item.upper, item.velocity, item.acceleration, strict=True)
        rows = dict(zip(item.coordinates.names, of_object, strict=True))
        limits += [rows[joint] for joint in tree.names[1:]]
        hold_coordinates[hold] = (*added, *(f"{name}.{joint}" for joint in tree.names[1:]))
        names += hold_coordinates[hold]
        base = model.frames[model.getFrameId(f"{prefix}{item.base_link}")]
        moving = list(shapes.geometryObjects)
        if not item.free:
            # Links that the held joints do not move (a door's frame, another door in it) are fixed
            # in the world, whether or not the chain is closed.
            moving = [shape for shape in moving if joints[shape.parentJoint] != base.parentJoint]
        held_geometries[hold] = tuple(
            graft_geometry(collision, moving, joints=joints, placement=placement, prefix=prefix)
        )
        target = placed.link_placement(item.base_link)
        closures[hold] = Closure(base.parentJoint, pin.SE3(base.placement), target)
    for name in names:
        if names.count(name) > 1:
            problem = (
                "two coordinates share this name (two grasps of one joint, "
                "or an attachment named like a joint of its object)"
            )
            raise InputError(problem, field=name, expected="unique coordinate names")
    ride_geometries = {}
    for number, ride in enumerate(rides):
        frame = model.frames[model.getFrameId(prefixes[ride.hold] + ride.link)]
        placed = dataclasses.replace(
            scene.objects[ride.object], placement=frame.placement * ride.placement_in_link
        )
        ride_geometries[ride] = tuple(
            graft_geometry(
                collision,
                make_world_shapes(placed),
                joints=[frame.parentJoint],
                placement=pin.SE3.Identity(),
                prefix=ride.object + "^" * (number + 1) + ".",
            )
        )
    lower, upper, velocity, acceleration = np.array(limits, float).T.copy()
    return VirtualKinematicChain(
        robot=robot,
        model=model,
        coordinates=Coordinates(model),
        names=tuple(names),
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
        collision=collision,
        held_geometries=held_geometries,
        ride_geometries=ride_geometries,
        closures=closures,
        virtual=virtual,
        added=hold_coordinates,
        prefixes=prefixes,
        cache=cache,
    )


def _add_virtual_joint(
    model: pin.Model, parent: int, placement: pin.SE3, attachment: Attachment, name: str
) -> tuple[int, pin.SE3, dict[str, tuple[float, float, float, float]]]:
    """Add J(v)⁻¹, tool to object: reversed joints with negated axes.

    Returns last joint, placement of the attachment on it, and coordinate names → limits.
    """
    added = {}
    for suffix, freedom in reversed(
        [*zip(attachment.coordinates, attachment.freedoms, strict=True)]
    ):
        revolute = freedom.kind == "revolute"
        kind = pin.JointModelRevoluteUnaligned if revolute else pin.JointModelPrismaticUnaligned
        low, high = freedom.lower, freedom.upper
        bounds = [np.array([value]) for value in (np.inf, FREEDOM_VELOCITY, low, high)]
        through = pin.SE3(np.eye(3), freedom.through)
        at, joint_name = round_placement(placement * through), f"{name}.{suffix}"
        parent = model.addJoint(parent, kind(-freedom.axis), at, joint_name, *bounds)
        placement = through.inverse()
        added[joint_name] = (low, high, FREEDOM_VELOCITY, FREEDOM_ACCELERATION)
    return parent, placement, added
