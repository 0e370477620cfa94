"""A scene as a MuJoCo model: the plain tree of robot and objects that validation and pictures use, with its masses.

Bodies are the joints of `World.model` with their inertias, geoms the convex shapes that the planner
avoids. What may touch what is listed pair by pair, see `contacts`; MuJoCo's own rules by bodies
play no part. Joints that follow others are held to them by equalities: the motor of what leads
moves all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.physics import Physics, engine
from vkc_pin.simulation.servos import Servo
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.coordinates import MovedJoint
from vkc_pin.world.models.dynamics.joint_resistance import Resistance
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.contact_rules import moves_as_one
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Builder", "PhysicalWorld", "quaternion"]

_CARRIER_MASS, _CARRIER_INERTIA = (
    0.05,
    1e-4,
)  # [kg], [kg·m²] of what stands between hand and link where a grasp leaves freedoms
_CONTACT = (
    0.01,
    1.0,
)  # time constant [s] and damping ratio of contacts: twice as hard as MuJoCo's usual ones
_CARRIER_DAMPING = 0.02  # of these freedoms, [N·m·s/rad] or [N·s/m]


@dataclass(frozen=True, eq=False)
class PhysicalWorld:
    """A scene in MuJoCo.

    Attributes:
        world: The plain tree that it is made of.
        model: The `mujoco.MjModel`.
        bodies: For each joint of the tree its body, shape (joints,).
        geoms: For each shape its geom, shape (G,).
        columns: Where each coordinate of the world is in MuJoCo's `qpos`, shape (n,).
        dofs: Where each coordinate of the world is among MuJoCo's velocities, shape (n,); -1 for
            those of free joints.
        carriers: Hold → where the coordinates of its freedoms are in `qpos`.
    """

    world: World
    model: Any
    bodies: Ints
    geoms: Ints
    columns: Ints
    dofs: Ints
    carriers: Mapping[Hold, Ints]

    def qpos(self, row: Floats) -> Floats:
        """Return MuJoCo's configuration, shape (nq,), of coordinates of the world, shape (n,); freedoms of grasps are at 0."""
        found = np.array(self.model.qpos0, float)
        found[self.columns] = row
        for move in self.world.coordinates.followers:
            joint = self.model.body_jntadr[self.bodies[move.joint]]
            found[self.model.jnt_qposadr[joint]] = move.factor * row[move.coordinate] + move.offset
        return found

    def row(self, qpos: Floats) -> Floats:
        """Return the coordinates of the world, shape (..., n), of configurations of MuJoCo, shape (..., nq)."""
        return np.asarray(qpos)[..., self.columns]


@dataclass(eq=False)
class Builder:
    """Puts a model together.

    Args:
        world: The tree, all of whose bodies have masses; see `physics.weigh`.
        physics: What to assume.
        gripping: Whether anything is held by friction. MuJoCo's contacts resist slipping by
            damping, and leave out centripetal accelerations: what is carried round a bend creeps
            out of the hand unless friction acts within two time steps.

    Attributes:
        mj: The package `mujoco`.
        spec: What is put together, a `mujoco.MjSpec`.
        bodies: For each joint of the tree its body there.
        moved: Number of a shape → the body that it is on instead of its joint's, and where.
    """

    world: World
    physics: Physics
    gripping: bool = False

    def __post_init__(self) -> None:
        self.mj = engine()
        self.moved: dict[int, tuple[Any, pin.SE3]] = {}
        self.spec = self.mj.MjSpec()
        self._carried: dict[Hold, list[str]] = {}

    def built(
        self,
        pairs: Pairs,
        servos: Sequence[Servo],
        holds: Sequence[Hold],
        latches: Sequence[tuple[str, float]],
        *,
        before: Callable[[Builder], None] | None = None,
        more: Callable[[Builder], None] | None = None,
    ) -> PhysicalWorld:
        """Return the model.

        Args:
            pairs: What may touch what.
            servos: Of the coordinates that are driven.
            holds: All that is ever welded, each with a weld of its own, in this order; they are not
                active.
            latches: Coordinates with where they are held, each with an equality of its own after
                those; not active.
            before: What to add before the shapes: bodies, say.
            more: What else to add, at the end: light, say.
        """
        mj, spec, option = self.mj, self.spec, self.spec.option
        option.timestep, option.integrator = (
            self.physics.timestep,
            mj.mjtIntegrator.mjINT_IMPLICITFAST,
        )
        option.cone, option.impratio = (
            mj.mjtCone.mjCONE_ELLIPTIC,
            10.0,
        )  # what is held by friction hardly creeps
        spec.compiler.degree = False
        self._bodies(servos)
        if before is not None:
            before(self)
        self._geoms(pairs)
        for hold in holds:
            self._weld(hold)
        for coordinate, value in latches:
            self._fixed(coordinate, value)
        if self.world.scene.robot.base == "fixed":
            for coordinate, value in zip(
                self.world.coordinates.names[:3], self.world.start[:3], strict=True
            ):
                self._fixed(coordinate, float(value), active=True)
        for servo in servos:
            servo.add_to(self.spec, self.mj)
        for move in self.world.coordinates.followers:
            self._follow(move)
        if more is not None:
            more(self)
        try:
            model = spec.compile()
        except ValueError as error:
            raise InputError("MuJoCo refuses the scene", field="scene", got=str(error)) from error
        bodies = np.array(
            [0, *(int(model.body(f"body {j}").id) for j in range(1, self.world.model.njoints))]
        )
        geoms = np.array([int(model.geom(f"shape {k}").id) for k in range(len(self.world.shapes))])
        columns = {
            hold: np.array([model.joint(k).qposadr[0] for k in own], int)
            for hold, own in self._carried.items()
        }
        return PhysicalWorld(self.world, model, bodies, geoms, *self._addresses(model), columns)

    def _bodies(self, servos: Sequence[Servo]) -> None:
        """Add a body for every joint of the tree, with its inertia."""
        tree, driven = self.world.model, {servo.coordinate: servo for servo in servos}
        data = tree.createData()
        pin.forwardKinematics(tree, data, pin.neutral(tree))
        self.bodies = [self.spec.worldbody]
        names: dict[int, list[str]] = {}
        for name, joint in zip(
            self.world.coordinates.names, self.world.coordinates.joints, strict=True
        ):
            names.setdefault(joint, []).append(name)
        follows = {move.joint: move for move in self.world.coordinates.followers}
        names |= {
            joint: [self.world.coordinates.names[move.coordinate]]
            for joint, move in follows.items()
        }
        for j in range(1, tree.njoints):
            place = tree.jointPlacements[j]
            body = self.bodies[tree.parents[j]].add_body(
                name=f"body {j}", pos=place.translation, quat=quaternion(place)
            )
            inertia = tree.inertias[j]
            body.mass, body.ipos, body.explicitinertial = inertia.mass, inertia.lever, True
            body.fullinertia = np.asarray(inertia.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            body.gravcomp = float(
                names[j][0] in driven or self._balanced(j)
            )  # controllers of arms carry what these weigh
            self.bodies.append(body)
            axes = np.asarray(data.joints[j].S).reshape(6, -1)
            if j in follows:  # Pinocchio's axis is for a unit of what leads it
                self._joint(body, str(tree.names[j]), axes[:, 0] / follows[j].factor)
            else:
                self._joints(body, j, names[j], axes, driven)

    def _joints(
        self, body: Any, j: int, names: Sequence[str], axes: Floats, driven: Mapping[str, Servo]
    ) -> None:
        """Add what moves a body."""
        tree = self.world.model
        if tree.joints[j].shortname() == "JointModelFreeFlyer":
            body.add_freejoint(name=str(tree.names[j]))
            return
        for k, name in enumerate(names):
            joint, slides = self._joint(body, name, axes[:, k])
            servo, column = driven.get(name), self.world.coordinates.index(name)
            if servo is not None:
                servo.give_motor(joint, self.mj)
                continue
            owner, _, own = name.partition(".")
            stated = self.world.scene.objects[owner].object.resistance.get(own, Resistance())
            usual = self.physics.prismatic_damping if slides else self.physics.revolute_damping
            joint.damping[0], joint.frictionloss = stated.damping or usual, stated.friction
            joint.stiffness[0], joint.springref = stated.stiffness, stated.springref
            lower, upper = (
                self.world.coordinates.lower[column],
                self.world.coordinates.upper[column],
            )
            if np.isfinite([lower, upper]).all():
                joint.limited, joint.range = self.mj.mjtLimited.mjLIMITED_TRUE, [lower, upper]

    def _joint(self, body: Any, name: str, twist: Floats) -> tuple[Any, bool]:
        """Add a joint along or about an axis, of a twist, shape (6,); return it, and whether it slides."""
        kind, slides = self.mj.mjtJoint, bool(np.linalg.norm(twist[:3]) > 0.5)
        axis = twist[:3] if slides else twist[3:]
        return body.add_joint(
            name=name, axis=axis, type=kind.mjJNT_SLIDE if slides else kind.mjJNT_HINGE
        ), slides

    def _balanced(self, joint: int) -> bool:
        """Return whether springs carry what a joint of an object carries."""
        placed = self.world.scene.objects.get(str(self.world.model.names[joint]).partition(".")[0])
        return self.physics.balanced and placed is not None and not placed.object.free

    def _geoms(self, pairs: Pairs) -> None:
        """Add the shapes, and which of them meet."""
        for number, shape in enumerate(self.world.shapes):
            body, place = self.moved.get(number, (self.bodies[shape.parentJoint], shape.placement))
            geom = self.geom(body, f"shape {number}", shape.geometry, place)
            geom.contype, geom.conaffinity = int(pairs.types[number]), int(pairs.affinities[number])
            geom.friction[0], geom.condim, geom.solref, geom.group = (
                self.physics.friction,
                4,
                _CONTACT,
                3,
            )
            geom.rgba = [*np.asarray(shape.meshColor)[:3], 1.0]
        for first, second in pairs.always.tolist():
            pair = self.spec.add_pair(geomname1=f"shape {first}", geomname2=f"shape {second}")
            pair.condim, pair.friction[:2], pair.solref = 4, [self.physics.friction] * 2, _CONTACT
            if self.gripping:
                pair.solreffriction = [2.0 * self.physics.timestep, 1.0]

    def geom(
        self,
        body: Any,
        name: str,
        shape: coal.CollisionGeometry,
        place: pin.SE3,
        *,
        thin: bool = False,
    ) -> Any:
        """Add a shape to a body; a `thin` one may have no volume."""
        kinds, where = (
            self.mj.mjtGeom,
            {"name": name, "pos": place.translation, "quat": quaternion(place)},
        )
        if isinstance(shape, coal.Box):
            return body.add_geom(type=kinds.mjGEOM_BOX, size=shape.halfSide, **where)
        if isinstance(shape, coal.Sphere):
            return body.add_geom(type=kinds.mjGEOM_SPHERE, size=[shape.radius, 0.0, 0.0], **where)
        if isinstance(shape, coal.Cylinder | coal.Capsule):
            kind = (
                kinds.mjGEOM_CYLINDER if isinstance(shape, coal.Cylinder) else kinds.mjGEOM_CAPSULE
            )
            return body.add_geom(type=kind, size=[shape.radius, shape.halfLength, 0.0], **where)
        if isinstance(shape, coal.Ellipsoid):
            return body.add_geom(type=kinds.mjGEOM_ELLIPSOID, size=shape.radii, **where)
        points, faces = triangulate(shape)
        mesh = self.spec.add_mesh(name=name, uservert=points.ravel(), userface=faces.ravel())
        inertias = self.mj.mjtMeshInertia
        mesh.inertia = inertias.mjMESH_INERTIA_SHELL if thin else inertias.mjMESH_INERTIA_CONVEX
        return body.add_geom(type=kinds.mjGEOM_MESH, meshname=name, **where)

    def frame(self, frame: str) -> tuple[Any, pin.SE3]:
        """Return the body that carries a frame of the tree, and where the frame is in it."""
        found = self.world.model.frames[self.world.model.getFrameId(frame)]
        return self.bodies[found.parentJoint], found.placement

    def _weld(self, hold: Hold) -> None:
        """Add what holds on: a weld of what holds with the link; where the grasp leaves freedoms, with a body that has these."""
        scene = self.world.scene
        attachment = scene.objects[hold.object].object.attachment(hold.attachment)
        holder, _ = self.frame(hold.frame or scene.robot.tool_frame)
        held, place = self.frame(f"{hold.object}.{attachment.link}")
        if not moves_as_one(scene, hold):
            held = self._carrier(hold, held, place * attachment.placement)
        weld = self.spec.add_equality(
            type=self.mj.mjtEq.mjEQ_WELD, objtype=self.mj.mjtObj.mjOBJ_BODY, active=False
        )
        weld.name1, weld.name2, weld.data[10] = holder.name, held.name, 1.0
        weld.solref = [2.0 * self.physics.timestep, 1.0]  # as hard as can be integrated

    def _carrier(self, hold: Hold, link: Any, place: pin.SE3) -> Any:
        attachment = self.world.scene.objects[hold.object].object.attachment(hold.attachment)
        name = f"carrier {len(self._carried)}"
        body = link.add_body(name=name, pos=place.translation, quat=quaternion(place), gravcomp=1.0)
        body.mass, body.inertia, body.explicitinertial = (
            _CARRIER_MASS,
            np.full(3, _CARRIER_INERTIA),
            True,
        )
        joints = self._carried[hold] = []
        for k, freedom in enumerate(attachment.freedoms):
            kind = (
                self.mj.mjtJoint.mjJNT_HINGE
                if freedom.kind == "revolute"
                else self.mj.mjtJoint.mjJNT_SLIDE
            )
            joint = body.add_joint(
                name=f"{name} {k}", type=kind, axis=freedom.axis, pos=freedom.through
            )
            joint.damping[0] = _CARRIER_DAMPING
            joints.append(joint.name)
        return body

    def _fixed(self, joint: str, value: float, *, active: bool = False) -> Any:
        """Return a new equality that holds a joint at a value."""
        kind, of = self.mj.mjtEq.mjEQ_JOINT, self.mj.mjtObj.mjOBJ_JOINT
        equality = self.spec.add_equality(type=kind, objtype=of, name1=joint, active=active)
        equality.data[0] = value
        return equality

    def _follow(self, move: MovedJoint) -> None:
        """Add an equality that holds a joint where the one that it follows has it."""
        equality = self._fixed(str(self.world.model.names[move.joint]), move.offset, active=True)
        equality.name2, equality.data[1] = (
            self.world.coordinates.names[move.coordinate],
            move.factor,
        )
        equality.solref = [2.0 * self.physics.timestep, 1.0]  # as hard as can be integrated

    def _addresses(self, model: Any) -> tuple[Ints, Ints]:
        """Return where the coordinates of the world are in MuJoCo's positions and velocities."""
        columns, dofs, done, tree = list[int](), list[int](), set[int](), self.world.model
        for name, j in zip(
            self.world.coordinates.names, self.world.coordinates.joints, strict=True
        ):
            if tree.joints[j].shortname() != "JointModelFreeFlyer":
                joint = model.joint(name)
                columns.append(int(joint.qposadr[0]))
                dofs.append(int(joint.dofadr[0]))
            elif j not in done:
                done.add(j)
                first = int(model.joint(str(tree.names[j])).qposadr[0])
                columns += [
                    first + k for k in (0, 1, 2, 4, 5, 6, 3)
                ]  # MuJoCo's quaternions begin with w
                dofs += [-1] * 7
        return np.array(columns), np.array(dofs)


def quaternion(placement: pin.SE3) -> Floats:
    """Return a rotation as MuJoCo's quaternion, w first, shape (4,)."""
    return np.asarray(pin.Quaternion(placement.rotation).coeffs())[[3, 0, 1, 2]]
