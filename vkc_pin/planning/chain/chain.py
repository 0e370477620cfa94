"""The virtual kinematic chain: virtual base, robot, and the objects it handles, inverted, in one Pinocchio model."""

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
from vkc_pin.utils.arguments import instance
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import graft, graft_geometry, round_placement
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, make_holds, resolve_holds
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import SupportedObject

__all__ = ["Closure", "VirtualKinematicChain", "consolidate"]

VIRTUAL_VELOCITY = 1.0  # [rad/s] or [m/s], of the hand in a grasp that leaves it a freedom
VIRTUAL_ACCELERATION = 2.0


@dataclass(frozen=True, eq=False)
class Closure:
    """h_chain of eq. 2: where the base link of a held object must stay, or a free one is when it is grasped.

    Attributes:
        joint: The joint of the chain that carries the object's base link.
        local: Placement of the base link in that joint's frame.
        target: Placement of the base link in the world.
    """

    joint: int
    local: pin.SE3
    target: pin.SE3


@dataclass(frozen=True, eq=False, kw_only=True)
class VirtualKinematicChain:
    """C^V: one model of everything that moves together.

    Attributes:
        robot: The robot at its root.
        model: `pinocchio.Model`; joint 1 is the planar virtual base, then the arm, then per grasp
            the virtual joint of the attachment and the object's joints from the attachable link to
            its base, inverted.
        coordinates: Minimal coordinates z of `model`.
        names: Their names, shape (n,); objects' as `<object>.<joint>`, virtual joints' as
            `<object>.<attachment>`.
        lower, upper, velocity, acceleration: Limits, shape (n,), SI units.
        collision: Collision geometry of the robot (first, in the robot's order) and of what moves
            of the objects.
        held_geometries: Hold → indices in `collision` of the object's geometry that moves when it
            is held.
        ride_geometries: Ride → indices in `collision` of the geometry of what rides.
        closures: Hold → where the object's base link is on the chain, and where it stands in the
            world.
        virtual: Hold → names of the coordinates of its attachment's virtual joint.
        added: Hold → names of all coordinates that come with it: these, and the joints of the
            object that it moves.
        prefixes: Hold → what the object's frames and joints begin with in `model`.
        cache: What was built for it, and can serve others.
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
        """What a change of each coordinate counts as in searches, shape (n,), [rad/m] and 1: as a turn by so many radians.

        A metre is worth as many as move the hand by a metre, see `Robot.lever`; of joints that move
        together, all ways count.
        """
        return self.coordinates.turns + self.coordinates.lengths / self.robot.lever

    @cached_property
    def _kinematics(self) -> Kinematics:
        """Kept here: to look for it in the cache takes as long as to use it."""
        return get_kinematics(self.model, self.cache)

    def joint_placements(self, z: Floats) -> tuple[Floats, Floats]:
        """Return rotations, shape (W, J, 3, 3), and translations, shape (W, J, 3) [m], of all joints in the world.

        Args:
            z: Configurations, shape (W, n). Joint 0, the world, is among the J.
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
        """Whether joint j moves when joint k does, shape (J, J)."""
        joints = range(self.model.njoints)
        return np.array([[k in self.model.supports[j] for k in joints] for j in joints])

    @cached_property
    def motions(self) -> tuple[Ints, Ints, Floats, Floats, Bools]:
        """How joints move: for each of `Coordinates.moves` coordinate and joint, how that moves linearly and about which axis.

        Shapes (m,), (m,), (m, 3) and (m, 3), the last two in the joint's frame. The last array,
        shape (m,), says where the linear motion is along the world's axes: x and y of a planar
        joint.
        """
        data, moves = self.model.createData(), self.coordinates.moves
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        linear, angular, fixed = (
            np.zeros((len(moves), 3)),
            np.zeros((len(moves), 3)),
            np.zeros(len(moves), bool),
        )
        for row, move in enumerate(moves):
            if str(self.model.joints[move.joint].shortname()) == "JointModelPlanar":
                part = move.coordinate - self.coordinates.joints.index(move.joint)
                fixed[row] = part < 2
                (linear if part < 2 else angular)[row, part] = 1.0
            else:
                motion = np.asarray(data.joints[move.joint].S, float).ravel()
                linear[row], angular[row] = motion[:3], motion[3:]
        return (
            np.array([m.coordinate for m in moves]),
            np.array([m.joint for m in moves]),
            linear,
            angular,
            fixed,
        )

    def point_jacobians(self, z: Floats, which: Ints, joint: Ints, point: Floats) -> Floats:
        """Return how points that are fixed in joints' frames move, shape (C, 3, n).

        Args:
            z: Configurations, shape (B, n).
            which: The configuration of each point, shape (C,).
            joint: The joint that carries it, shape (C,); 0 stands still.
            point: Where it is in the world, shape (C, 3) [m].
        """
        coordinate, owner, linear, angular, fixed = self.motions
        rotations, translations = self.joint_placements(z)
        axes = rotations[:, owner]
        turned = np.where(fixed[:, None], linear, np.einsum("bnij,nj->bni", axes, linear))[which]
        about = np.einsum("bnij,nj->bni", axes, angular)[which]
        moved = turned + np.cross(about, point[:, None] - translations[:, owner][which])
        moved = moved * self.carries[joint][:, owner, None]
        return np.asarray(
            np.add.reduceat(
                moved, np.searchsorted(coordinate, np.arange(self.size)), axis=1
            ).swapaxes(1, 2)
        )

    def opened(self, opening: float | None) -> pin.GeometryModel:
        """Return its collision geometry with the robot's gripper so far open [m]; None: as the robot rests."""
        if opening is None:
            return self.collision
        geometry = self.collision.copy()
        for k, shape in enumerate(self.robot.opened(opening).collision.geometryObjects):
            geometry.geometryObjects[k].placement = shape.placement
        return geometry

    def index(self, name: str) -> int:
        """Return the position of coordinate `name` in z. Raises `UnknownNameError` if there is none."""
        if name not in self.names:
            raise UnknownNameError("coordinate", name, self.names)
        return self.names.index(name)

    def holder(self, hold: Hold) -> tuple[int, pin.SE3]:
        """Return the joint that carries the frame which holds something, and the frame's placement there."""
        return (
            self.frame(self.robot.tool_frame)
            if hold.by is None
            else self.frame(str(hold.link), hold.by)
        )

    def frame(
        self, name: str, hold: Hold | None = None, *, opening: float | None = None
    ) -> tuple[int, pin.SE3]:
        """Return the joint that carries a frame, and the frame's placement there.

        Args:
            name: A frame of the robot, or a link of what is held.
            hold: What holds that; None: it is the robot's.
            opening: How far the robot's gripper is open [m], which its fingers' frames depend on;
                None: as the robot rests.
        """
        if hold is None:
            model = self.robot.opened(opening).model  # the chain begins with the robot's joints
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

    Args:
        scene: Robot, objects and where they stand.
        holds: What is held at any time, each after the hold it depends on; or object → attachment,
            all by the tool. Several become branches of one tree; only what is held at a waypoint,
            and stands fixed, is closed there.
        rides: What stands on links of that, at any time.
        cache: Where the chain's kinematics are kept; None: in one of its own.

    Returns:
        The chain. Branches of an object beside the path from grasp to base are fixed at their
        present state.

    Raises:
        UnknownNameError: The scene has no such object, or the object no such attachment.
        InputError: Two grasps move the same joint, or one that leaves a freedom is called like a
            joint of its object.
    """
    robot = instance(scene, Scene, "scene").robot
    holds = resolve_holds(scene.objects, make_holds(holds) if isinstance(holds, Mapping) else holds)
    cache = Cache() if cache is None else instance(cache, Cache, "cache")
    model, collision = pin.Model(robot.model), pin.GeometryModel()
    graft_geometry(
        collision,
        robot.collision.geometryObjects,
        joints=list(range(model.njoints)),
        placement=pin.SE3.Identity(),
    )
    names = list(robot.coordinates.names)
    limits = [list(robot.lower), list(robot.upper), list(robot.velocity), list(robot.acceleration)]
    held_geometries, closures, virtual, with_hold = {}, {}, {}, {}
    prefixes: dict[Hold, str] = {}
    for hold in holds:
        name = hold.object
        placed = scene.objects[name]
        attachment = placed.object.attachment(hold.attachment)
        # Pinocchio finds a frame only by a name that no other has: the second branch of an object
        # needs another prefix.
        prefix = prefixes[hold] = name + "'" * sum(other.object == name for other in prefixes) + "."
        holder = robot.tool_frame if hold.by is None else f"{prefixes[hold.by]}{hold.link}"
        tool = model.frames[model.getFrameId(holder)]
        parent, placement = (
            tool.parentJoint,
            tool.placement * compute_hand_frame(robot, attachment) * attachment.offset.inverse(),
        )
        added = []
        # J(v)⁻¹, tool to object: each joint's axis is negated, and their order reversed.
        for suffix, freedom in reversed(
            [*zip(attachment.coordinates, attachment.freedoms, strict=True)]
        ):
            kind = (
                pin.JointModelRevoluteUnaligned
                if freedom.kind == "revolute"
                else pin.JointModelPrismaticUnaligned
            )
            joint_name, joint, low, high = (
                f"{name}.{suffix}",
                kind(-freedom.axis),
                freedom.lower,
                freedom.upper,
            )
            own = [np.array([value]) for value in (np.inf, VIRTUAL_VELOCITY, low, high)]
            through = pin.SE3(np.eye(3), freedom.through)
            parent = model.addJoint(
                parent, joint, round_placement(placement * through), joint_name, *own
            )
            placement = through.inverse()
            added.append(joint_name)
            for row, value in zip(
                limits, (low, high, VIRTUAL_VELOCITY, VIRTUAL_ACCELERATION), strict=True
            ):
                row.append(value)
        virtual[hold] = tuple(added)
        tree = invert(placed.object, attachment.link, placed.state)
        placement = round_placement(placement * attachment.placement.inverse())
        joints = graft(model, tree.model, parent=parent, placement=placement, prefix=prefix)
        names += added
        for joint_name in tree.model.names[1:]:
            names.append(f"{name}.{joint_name}")
            index = placed.object.coordinates.names.index(joint_name)
            stated = (
                placed.object.lower,
                placed.object.upper,
                placed.object.velocity,
                placed.object.acceleration,
            )
            for row, values in zip(limits, stated, strict=True):
                row.append(float(values[index]))
        with_hold[hold] = (*added, *(f"{name}.{joint_name}" for joint_name in tree.model.names[1:]))
        base = model.frames[model.getFrameId(f"{prefix}{placed.object.base_link}")]
        moving = list(tree.collision.geometryObjects)
        if not placed.object.free:
            # What the joints in hand do not move (a door's frame, another door in it) stands in the
            # world, closed or not.
            moving = [shape for shape in moving if joints[shape.parentJoint] != base.parentJoint]
        held_geometries[hold] = tuple(
            graft_geometry(collision, moving, joints=joints, placement=placement, prefix=prefix)
        )
        target = placed.link_placement(placed.object.base_link)
        closures[hold] = Closure(base.parentJoint, pin.SE3(base.placement), target)
    for joint_name in names:
        if names.count(joint_name) > 1:
            problem = (
                "two grasps of one joint, or an attachment and a joint of its object, share a name"
            )
            raise InputError(
                problem, field=joint_name, expected="a coordinate that is in the chain once"
            )
    ride_geometries = {}
    for number, ride in enumerate(rides):
        frame = model.frames[model.getFrameId(prefixes[ride.hold] + ride.link)]
        placed = dataclasses.replace(
            scene.objects[ride.object], placement=frame.placement * ride.placement_in_link
        )
        prefix = ride.object + "^" * (number + 1) + "."
        shapes = make_world_shapes(placed)
        ride_geometries[ride] = tuple(
            graft_geometry(
                collision,
                shapes,
                joints=[frame.parentJoint],
                placement=pin.SE3.Identity(),
                prefix=prefix,
            )
        )
    lower, upper, velocity, acceleration = (np.array(row, float) for row in limits)
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
        added=with_hold,
        prefixes=prefixes,
        cache=cache,
    )
