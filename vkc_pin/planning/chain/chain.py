"""Builds the virtual kinematic chain: virtual base, robot and inverted objects in one model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.planning.chain.kinematic_tree import Kinematics, KinematicTree, get_kinematics
from vkc_pin.utils.arguments import check_instance
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.utils.cache import Cache
from vkc_pin.world.models.articulated_object import ArticulatedObject, Attachment
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.grafting import add_joint, graft, graft_geometry, round_placement
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment, make_holds, resolve_holds
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import SupportedObject

FREEDOM_VELOCITY = 1.0  # [rad/s] or [m/s], limit of a freedom of the grasp
FREEDOM_ACCELERATION = 2.0


def invert(
    obj: ArticulatedObject, link: str, state: ArrayLike
) -> tuple[pin.Model, pin.GeometryModel]:
    """Re-root an object at a link, whose frame becomes the universe frame.

    With placement P and motion J(q) of a joint, parent → child is P·J(q), so child → parent is
    J(q)⁻¹·P⁻¹, where J(q)⁻¹ is the same joint with a negated axis. A constant rotation aligns it
    with z and is absorbed into the adjacent placements; z-aligned joints have the shortest
    expressions.

    Args:
        obj: The object.
        link: The new root link.
        state: Joint positions, shape (n,), at which joints off the path to the base link are
            locked.

    Returns:
        Joints on the path from the link to the base link, with their names and limits, and a body
        frame for each link; and the collision geometry on these bodies.

    Raises:
        UnknownNameError: The object has no such link.
        InputError: `state` has the wrong size, or a joint on the path cannot be inverted.
    """
    source = check_instance(obj, ArticulatedObject, "obj").model
    root = source.frames[obj.link_frame(link)]
    data = source.createData()
    pin.forwardKinematics(source, data, obj.coordinates.q(state))
    path = [root.parentJoint]  # from the link's joint down to the universe
    while path[-1] != 0:
        path.append(source.parents[path[-1]])

    model = pin.Model()
    model.name = obj.name
    # joint of the path → joint of the new model that carries its body, and the body's placement
    carrier: dict[int, tuple[int, pin.SE3]] = {path[0]: (0, root.placement.inverse())}
    for child, parent in pairwise(path):
        # From the child's body to the parent's: J(q)⁻¹·P⁻¹ = turn·J_z(q)·turn⁻¹·P⁻¹, with the
        # rotation `turn` from z to the negated axis.
        new_parent, body = carrier[child]
        joint, axis = _align_with_z(source, data, child)
        turn = pin.SE3(_rotate_z_to(-axis), np.zeros(3))
        placement = round_placement(body * turn)
        index = add_joint(model, new_parent, joint, placement, like=(source, child))
        carrier[parent] = (index, turn.inverse() * source.jointPlacements[child].inverse())

    def place(joint: int, placement: pin.SE3) -> tuple[int, pin.SE3]:
        """Return the new joint that carries `placement` of the old `joint`, and its placement."""
        anchor = joint  # nearest joint of the path; those between it and `joint` are locked
        while anchor not in carrier:
            anchor = source.parents[anchor]
        new_joint, body = carrier[anchor]
        joint_on_anchor = data.oMi[anchor].actInv(data.oMi[joint])
        return new_joint, round_placement(body * joint_on_anchor * placement)

    for joint in range(source.njoints):
        if source.inertias[joint].mass > 0.0:
            new_joint, placement = place(joint, pin.SE3.Identity())
            model.appendBodyToJoint(new_joint, source.inertias[joint], placement)
    frames: dict[int, int] = {}  # frame of the object → frame of the new model
    for index, frame in enumerate(source.frames):
        if frame.type == pin.FrameType.BODY:
            new_joint, placement = place(frame.parentJoint, frame.placement)
            body_frame = pin.Frame(frame.name, new_joint, 0, placement, pin.FrameType.BODY)
            frames[index] = model.addFrame(body_frame, False)

    collision = pin.GeometryModel()
    for shape in obj.collision.geometryObjects:
        copy = pin.GeometryObject(shape)
        copy.parentJoint, copy.placement = place(shape.parentJoint, shape.placement)
        copy.parentFrame = frames[shape.parentFrame]
        collision.addGeometryObject(copy)
    return model, collision


def _align_with_z(model: pin.Model, data: pin.Data, index: int) -> tuple[pin.JointModel, Floats]:
    """Return the z-aligned joint of the same kind, and the unit axis of joint `index`."""
    kind = model.joints[index].shortname().removeprefix("JointModel")
    subspace = np.array(data.joints[index].S, float).ravel()  # linear part, then angular part
    if kind in ("RX", "RY", "RZ", "RevoluteUnaligned"):
        return pin.JointModelRZ(), subspace[3:]
    if kind in ("RUBX", "RUBY", "RUBZ", "RevoluteUnboundedUnaligned"):
        return pin.JointModelRUBZ(), subspace[3:]
    if kind in ("PX", "PY", "PZ", "PrismaticUnaligned"):
        return pin.JointModelPZ(), subspace[:3]
    expected = "a revolute, continuous or prismatic joint"
    raise InputError(
        "this joint cannot be inverted", field=model.names[index], expected=expected, got=kind
    )


def _rotate_z_to(axis: Floats) -> Floats:
    """Return a rotation, shape (3, 3), from z to the unit vector `axis`, with many zeros.

    Its columns are x, y and z: x is the basis vector furthest from the axis, made perpendicular.
    """
    basis = np.eye(3)
    x = basis[int(np.argmin(np.abs(axis)))]
    x = x - axis * (axis @ x)
    x = x / np.linalg.norm(x)
    y = np.cross(axis, x)
    return np.column_stack([x, y, axis])


@dataclass(frozen=True, eq=False)
class Closure:
    """h_chain of eq. 2: target pose of a grasped object's base link.

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
        grasped_geometries: Hold → indices in `collision` of the geometry that moves with it.
        supported_geometries: Supported object → indices in `collision` of its geometry.
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
    grasped_geometries: Mapping[Hold, tuple[int, ...]]
    supported_geometries: Mapping[SupportedObject, tuple[int, ...]]
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
    def tree(self) -> KinematicTree:
        """The joints of the model, those of grasps and objects mounted on the robot's."""
        return KinematicTree(self.model, self.robot.model)

    @cached_property
    def _kinematics(self) -> Kinematics:
        """Kinematics, stored here because a cache lookup takes as long as an evaluation."""
        return get_kinematics(self.tree, self.cache)

    def joint_placements(self, z: Floats) -> tuple[Floats, Floats]:
        """Return the world placements of all joints at z, shape (W, n); joint 0 is the world.

        Returns:
            Rotations, shape (W, J, 3, 3), and translations, shape (W, J, 3) [m].
        """
        batch = len(z)
        joints = self.model.njoints
        (placements,) = self._kinematics.batch(z, self.tree.mounts.ravel())
        placements = placements.reshape(batch, joints - 1, 12)
        rotations = np.zeros((batch, joints, 3, 3))
        rotations[:, 0] = np.eye(3)
        # Nine numbers are the columns of R.
        transposed = placements[..., :9].reshape(batch, joints - 1, 3, 3)
        rotations[:, 1:] = transposed.swapaxes(2, 3)
        translations = np.zeros((batch, joints, 3))
        translations[:, 1:] = placements[..., 9:]
        return rotations, translations

    @cached_property
    def carries(self) -> Bools:
        """Mask of shape (J, J): whether joint j moves when joint k does."""
        joints = self.model.njoints
        carries = np.zeros((joints, joints), bool)
        for j in range(joints):
            carries[j, list(self.model.supports[j])] = True
        return carries

    @cached_property
    def motions(self) -> tuple[Ints, Ints, Floats, Floats, Bools]:
        """Coordinate and joint, (m,), of each of `Coordinates.moves`, and the joint's velocity.

        Linear and angular velocity, shape (m, 3), are in the joint's frame, but the linear velocity
        of planar joints is along the world's axes: a mask, shape (m,).
        """
        data = self.model.createData()
        moves = self.coordinates.moves
        pin.forwardKinematics(self.model, data, pin.neutral(self.model))
        linear = np.zeros((len(moves), 3))
        angular = np.zeros((len(moves), 3))
        along_world = np.zeros(len(moves), bool)
        for row, move in enumerate(moves):
            if str(self.model.joints[move.joint].shortname()) == "JointModelPlanar":
                axis = move.coordinate - self.coordinates.joints.index(move.joint)
                if axis < 2:  # x or y
                    linear[row, axis] = 1.0
                    along_world[row] = True
                else:  # yaw, about z
                    angular[row, axis] = 1.0
            else:
                motion = np.asarray(data.joints[move.joint].S, float).ravel()
                linear[row] = motion[:3]
                angular[row] = motion[3:]
        coordinates = np.array([move.coordinate for move in moves])
        joints = np.array([move.joint for move in moves])
        return coordinates, joints, linear, angular, along_world

    def point_jacobians(self, z: Floats, which: Ints, joint: Ints, point: Floats) -> Floats:
        """Return the Jacobians of points that are fixed in joints' frames, shape (C, 3, n).

        A joint at the translation t, which moves with the linear velocity v and the angular
        velocity ω for a unit rate of a coordinate, all in the world, moves a point p that it
        carries by v + ω × (p − t). A coordinate that several joints follow has the sum.

        Args:
            z: Configurations, shape (B, n).
            which: Configuration of each point, shape (C,).
            joint: Joint that carries the point, shape (C,); 0 is the world.
            point: Position of the point in the world, shape (C, 3) [m].
        """
        coordinate, owner, linear, angular, along_world = self.motions
        rotations, translations = self.joint_placements(z)
        axes = rotations[:, owner]
        rotated_linear = np.einsum("bnij,nj->bni", axes, linear)
        v = np.where(along_world[:, None], linear, rotated_linear)[which]
        omega = np.einsum("bnij,nj->bni", axes, angular)[which]
        arm = point[:, None] - translations[:, owner][which]
        motion = v + np.cross(omega, arm)
        motion = motion * self.carries[joint][:, owner, None]
        # The motions are sorted by coordinate: add those of each.
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
            full_name = name
        else:
            model = self.model
            full_name = self.prefixes[hold] + name
        frame = model.frames[model.getFrameId(full_name)]
        return frame.parentJoint, pin.SE3(frame.placement)


def consolidate(
    scene: Scene,
    holds: Iterable[Hold] | Mapping[str, str],
    *,
    supported: Iterable[SupportedObject] = (),
    cache: Cache | None = None,
) -> VirtualKinematicChain:
    """Merge the scene's robot with the objects it grasps into one model (paper, section III).

    Branches of an object that are not on the path from grasp to base are locked.

    Args:
        scene: Robot and placed objects.
        holds: All holds at any time, each after the hold it depends on; or object → attachment, all
            grasped by the tool. Several holds become branches of one tree.
        supported: Objects supported by links of grasped objects at any time.
        cache: Cache of the chain's kinematics. Defaults to one of its own.

    Raises:
        UnknownNameError: The scene has no such object, or the object no such attachment.
        InputError: Two grasps move the same joint, or a freedom of a grasp has the name of a joint.
    """
    robot = check_instance(scene, Scene, "scene").robot
    if isinstance(holds, Mapping):
        holds = make_holds(holds)
    holds = resolve_holds(scene.objects, holds)
    cache = Cache() if cache is None else check_instance(cache, Cache, "cache")
    model = pin.Model(robot.model)
    collision = pin.GeometryModel()
    graft_geometry(
        collision,
        robot.collision.geometryObjects,
        joints=list(range(model.njoints)),
        placement=pin.SE3.Identity(),
    )
    names = list(robot.coordinates.names)
    limits = [*_list_limits(robot).values()]
    grasped_geometries = {}
    closures = {}
    virtual = {}
    hold_coordinates = {}
    prefixes: dict[Hold, str] = {}
    for hold in holds:
        name = hold.object
        placed = scene.objects[name]
        item = placed.object
        attachment = get_attachment(scene.objects, hold)
        prefix = _make_prefix(name, prefixes)
        prefixes[hold] = prefix
        holder = robot.tool_frame if hold.by is None else f"{prefixes[hold.by]}{hold.link}"

        # From the holder's frame to the object's link: offset⁻¹, J(v)⁻¹ and placement⁻¹ of the
        # attachment, see `Attachment`.
        tool = model.frames[model.getFrameId(holder)]
        hand = tool.placement * compute_hand_frame(robot, attachment)
        grasp = hand * attachment.offset.inverse()
        parent, placement, added = _add_virtual_joint(
            model, tool.parentJoint, grasp, attachment, name
        )
        placement = round_placement(placement * attachment.placement.inverse())
        tree, shapes = invert(item, attachment.link, placed.state)
        joints = graft(model, tree, parent=parent, placement=placement, prefix=prefix)

        path = tree.names[1:]
        limits += added.values()
        limits_by_joint = _list_limits(item)
        limits += [limits_by_joint[joint] for joint in path]
        virtual[hold] = tuple(added)
        hold_coordinates[hold] = (*added, *(f"{name}.{joint}" for joint in path))
        names += hold_coordinates[hold]

        base = model.frames[model.getFrameId(f"{prefix}{item.base_link}")]
        moving = list(shapes.geometryObjects)
        if not item.free:
            # Links that these joints do not move (a door's frame, another door in it) are fixed in
            # the world, whether or not the chain is closed.
            moving = [shape for shape in moving if joints[shape.parentJoint] != base.parentJoint]
        geometries = graft_geometry(
            collision, moving, joints=joints, placement=placement, prefix=prefix
        )
        grasped_geometries[hold] = tuple(geometries)
        closures[hold] = Closure(
            joint=base.parentJoint,
            local=pin.SE3(base.placement),
            target=placed.link_placement(item.base_link),
        )
    _check_unique(names)
    supported_geometries = {}
    for number, on_top in enumerate(supported):
        link = model.frames[model.getFrameId(prefixes[on_top.hold] + on_top.link)]
        prefix = on_top.object + "^" * (number + 1) + "."
        supported_geometries[on_top] = _graft_supported_object(
            scene, on_top, collision, link, prefix
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
        grasped_geometries=grasped_geometries,
        supported_geometries=supported_geometries,
        closures=closures,
        virtual=virtual,
        added=hold_coordinates,
        prefixes=prefixes,
        cache=cache,
    )


def _list_limits(owner: Robot | ArticulatedObject) -> dict[str, tuple[float, ...]]:
    """Return lower, upper, velocity and acceleration limit of each coordinate, by its name."""
    limits = zip(owner.lower, owner.upper, owner.velocity, owner.acceleration, strict=True)
    return dict(zip(owner.coordinates.names, limits, strict=True))


def _make_prefix(name: str, prefixes: Mapping[Hold, str]) -> str:
    """Return the prefix of the frames and joints of an object's next branch.

    Pinocchio finds frames by unique names: a second branch of an object gets another prefix.
    """
    earlier_branches = sum(hold.object == name for hold in prefixes)
    return name + "'" * earlier_branches + "."


def _graft_supported_object(
    scene: Scene,
    supported: SupportedObject,
    collision: pin.GeometryModel,
    link: pin.Frame,
    prefix: str,
) -> tuple[int, ...]:
    """Add the shapes of an object to the link on which it rests; return their indices."""
    placement = link.placement * supported.placement_in_link
    placed = dataclasses.replace(scene.objects[supported.object], placement=placement)
    geometries = graft_geometry(
        collision,
        make_world_shapes(placed),
        joints=[link.parentJoint],
        placement=pin.SE3.Identity(),
        prefix=prefix,
    )
    return tuple(geometries)


def _check_unique(names: list[str]) -> None:
    """Raise an `InputError` if two coordinates share a name."""
    for name in names:
        if names.count(name) > 1:
            problem = (
                "two coordinates share this name (two grasps of one joint, "
                "or an attachment named like a joint of its object)"
            )
            raise InputError(problem, field=name, expected="unique coordinate names")


def _add_virtual_joint(
    model: pin.Model, parent: int, placement: pin.SE3, attachment: Attachment, name: str
) -> tuple[int, pin.SE3, dict[str, tuple[float, float, float, float]]]:
    """Add J(v)⁻¹, tool to object: reversed joints with negated axes.

    The grasp's own joint is J = J_1·…·J_k, each about or along an axis through a point of the
    attachment's frame, so that J⁻¹ = J_k⁻¹·…·J_1⁻¹.

    Returns last joint, placement of the attachment on it, and coordinate names → limits.
    """
    added = {}
    freedoms = [*zip(attachment.coordinates, attachment.freedoms, strict=True)]
    for suffix, freedom in reversed(freedoms):
        joint = pin.JointModelPZ()
        if freedom.kind == "revolute":
            joint = pin.JointModelRZ()
        joint_name = f"{name}.{suffix}"
        # z of the joint's frame is the negated axis, as in `invert`.
        to_axis = pin.SE3(_rotate_z_to(-freedom.axis), freedom.through)
        parent = model.addJoint(
            parent,
            joint,
            round_placement(placement * to_axis),
            joint_name,
            np.array([np.inf]),  # torque
            np.array([FREEDOM_VELOCITY]),
            np.array([freedom.lower]),
            np.array([freedom.upper]),
        )
        placement = to_axis.inverse()
        added[joint_name] = (
            freedom.lower,
            freedom.upper,
            FREEDOM_VELOCITY,
            FREEDOM_ACCELERATION,
        )
    return parent, placement, added
