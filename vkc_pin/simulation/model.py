"""Builds a MuJoCo model of a scene from the kinematic tree that validation and viewers use.

Bodies are the joints of `World.model` with their inertias; geoms are the convex shapes that the
planner avoids. Contact pairs are listed explicitly (see `contacts`); MuJoCo's body-based rules are
disabled. Mimic joints are coupled to the joint that they follow by equality constraints, so that
the leading joint's motor moves all of them.
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
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.servos import Servo
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.point_cloud import PointCloud
from vkc_pin.world.models.coordinates import MovedJoint
from vkc_pin.world.models.dynamics import Resistance
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.contact_rules import is_rigid_grasp
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.world_model import World

# [kg], [kg·m²] of the body between hand and link of a grasp with degrees of freedom
_CARRIER_MASS = 0.05
_CARRIER_INERTIA = 1e-4
# [N·m·s/rad] or [N·s/m] of these degrees of freedom
_CARRIER_DAMPING = 0.02
# Time constant [s] and damping ratio of contacts, twice as stiff as MuJoCo's defaults
_CONTACT = (0.01, 1.0)
# Iterations of MuJoCo's noslip solver. Without them a stick of 0.4 kg turns between the fingers by
# 3 mrad/s, with 5 or more by 0.1 mrad/s.
_NOSLIP_ITERATIONS = 5
# [m] Tolerance of distances between convex shapes. With MuJoCo's default, 1e-6, contacts are so
# inaccurate that before MuJoCo 3.13 a stick that rests on two discs rolls by 0.2 rad in 6 s; with
# this, by 10 µrad.
_DISTANCE_TOLERANCE = 1e-12
# Impedances of constraints: the largest that MuJoCo accepts, and the stablest of soft ones
_MAX_IMPEDANCE = 0.9999
_SOFT_IMPEDANCE = 0.5
# Index of the factor of rotations in `eq_data` of a weld
TORQUE_SCALE = 10
# Elements xx, yy, zz, xy, xz, yz of a matrix, MuJoCo's order of a full inertia.
_INERTIA_ELEMENTS = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
# MuJoCo draws groups 0 to 2; collision shapes are hidden.
_HIDDEN_GROUP = 3


@dataclass(frozen=True, eq=False)
class PhysicalWorld:
    """A scene as a MuJoCo model.

    Attributes:
        world: Kinematic tree that the model is build from.
        model: The `mujoco.MjModel`.
        bodies: Body of each joint of the tree, shape (joints,).
        geoms: Geom of each collision shape, shape (G,).
        columns: Index of each world coordinate in MuJoCo's `qpos`, shape (n,).
        dofs: Index of each world coordinate in MuJoCo's velocities, shape (n,); -1 for coordinates
            of free joints.
        carriers: Maps each hold to the indices in `qpos` of its grasp's degrees of freedom.
    """

    world: World
    model: Any
    bodies: Ints
    geoms: Ints
    columns: Ints
    dofs: Ints
    carriers: Mapping[Hold, Ints]

    def to_qpos(self, row: Floats) -> Floats:
        """Return MuJoCo's configuration, shape (nq,), for world coordinates, shape (n,).

        Degrees of freedom of grasps are 0.
        """
        configuration = np.array(self.model.qpos0, float)
        configuration[self.columns] = row
        for move in self.world.coordinates.followers:
            joint = self.model.body_jntadr[self.bodies[move.joint]]
            value = move.factor * row[move.coordinate] + move.offset
            configuration[self.model.jnt_qposadr[joint]] = value
        return configuration

    def from_qpos(self, qpos: Floats) -> Floats:
        """Return the world coordinates, shape (..., n), of MuJoCo configurations, (..., nq)."""
        return np.asarray(qpos)[..., self.columns]

    def place_body(self, data: Any, body: int) -> pin.SE3:
        """Return the placement of a body in the world."""
        rotation = np.array(data.xmat[body]).reshape(3, 3)
        return pin.SE3(rotation, np.array(data.xpos[body]))

    def place_frame(self, data: Any, frame: str) -> pin.SE3:
        """Return the placement of a frame of the tree in the world."""
        found = self.world.model.frames[self.world.model.getFrameId(frame)]
        return self.place_body(data, int(self.bodies[found.parentJoint])) * found.placement


@dataclass(eq=False)
class Builder:
    """Builds the MuJoCo model.

    Args:
        world: Kinematic tree, all of whose bodies have masses; see `physics.complete_inertias`.
        physics: Physical settings.
        has_friction_grasps: Whether objects are grasped by friction. MuJoCo's contacts resist slip
            by damping and ignore centripetal acceleration, so a grasped object creeps out of the
            hand on curves unless friction acts within two time steps.

    Attributes:
        mj: The package `mujoco`.
        spec: The `mujoco.MjSpec` under construction.
        bodies: Body of each joint of the tree.
        moved_shapes: Maps the number of a shape to the body that carries it instead of its joint's
            body, and its placement there.
    """

    world: World
    physics: Physics
    has_friction_grasps: bool = False

    def __post_init__(self) -> None:
        self.mj = import_mujoco()
        self.moved_shapes: dict[int, tuple[Any, pin.SE3]] = {}
        self.spec = self.mj.MjSpec()
        self._carrier_joints: dict[Hold, list[str]] = {}

    def build(
        self,
        pairs: Pairs,
        servos: Sequence[Servo],
        holds: Sequence[Hold],
        latches: Sequence[tuple[str, float]],
        *,
        add_bodies: Callable[[Builder], None] | None = None,
        add_extras: Callable[[Builder], None] | None = None,
    ) -> PhysicalWorld:
        """Build the model."""
        self._set_options()
        self._add_bodies(servos)
        if add_bodies is not None:
            add_bodies(self)
        self._add_geoms(pairs)
        for hold in holds:
            self._add_weld(hold)
        for coordinate, value in latches:
            self._add_joint_equality(coordinate, value)
        if self.world.scene.robot.base == "fixed":
            base = zip(self.world.coordinates.names[:3], self.world.start[:3], strict=True)
            for coordinate, value in base:
                self._add_joint_equality(coordinate, float(value), active=True)
        for servo in servos:
            servo.add_to(self.spec, self.mj)
        for move in self.world.coordinates.followers:
            self._add_coupling(move)
        if add_extras is not None:
            add_extras(self)
        try:
            model = self.spec.compile()
        except ValueError as error:
            raise InputError("MuJoCo rejects the scene", field="scene", got=str(error)) from error
        for number in range(len(holds)):
            self._set_stiffness(model, number)
        return self._make_world(model)

    def _set_options(self) -> None:
        """Set the options of the solver."""
        option = self.spec.option
        option.timestep = self.physics.timestep
        option.integrator = self.mj.mjtIntegrator.mjINT_IMPLICITFAST
        # Objects that are grasped by friction hardly creep.
        option.cone = self.mj.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10.0
        if self.has_friction_grasps:
            option.noslip_iterations = _NOSLIP_ITERATIONS
        option.ccd_tolerance = _DISTANCE_TOLERANCE
        self.spec.compiler.degree = False

    def _make_world(self, model: Any) -> PhysicalWorld:
        """Find the tree's joints, shapes and coordinates in a compiled model."""
        joints = range(1, self.world.model.njoints)
        bodies = [0, *(int(model.body(f"body {j}").id) for j in joints)]
        geoms = [int(model.geom(f"shape {k}").id) for k in range(len(self.world.shapes))]
        columns, dofs = self._find_addresses(model)
        carriers: dict[Hold, Ints] = {}
        for hold, names in self._carrier_joints.items():
            carriers[hold] = np.array([model.joint(name).qposadr[0] for name in names], int)
        return PhysicalWorld(
            world=self.world,
            model=model,
            bodies=np.array(bodies),
            geoms=np.array(geoms),
            columns=columns,
            dofs=dofs,
            carriers=carriers,
        )

    def _add_bodies(self, servos: Sequence[Servo]) -> None:
        """Add a body with its inertia for each joint of the tree."""
        tree = self.world.model
        coordinates = self.world.coordinates
        driven = {servo.coordinate: servo for servo in servos}
        follows = {move.joint: move for move in coordinates.followers}
        # The coordinates of each joint; a mimic joint has that of the joint that it follows.
        names: dict[int, list[str]] = {}
        for name, joint in zip(coordinates.names, coordinates.joints, strict=True):
            names.setdefault(joint, []).append(name)
        for joint, move in follows.items():
            names[joint] = [coordinates.names[move.coordinate]]
        data = tree.createData()
        pin.forwardKinematics(tree, data, pin.neutral(tree))
        self.bodies = [self.spec.worldbody]
        for j in range(1, tree.njoints):
            place = tree.jointPlacements[j]
            body = self.bodies[tree.parents[j]].add_body(
                name=f"body {j}", pos=place.translation, quat=to_mujoco_quaternion(place)
            )
            inertia = tree.inertias[j]
            body.mass = inertia.mass
            body.ipos = inertia.lever
            body.explicitinertial = True
            body.fullinertia = np.asarray(inertia.inertia)[_INERTIA_ELEMENTS]
            # Arm controllers compensate gravity.
            body.gravcomp = float(names[j][0] in driven or self._is_balanced(j))
            self.bodies.append(body)
            axes = np.asarray(data.joints[j].S).reshape(6, -1)
            if j in follows:  # Pinocchio's axis is per unit of the leading joint
                self._add_joint(body, str(tree.names[j]), axes[:, 0] / follows[j].factor)
            else:
                self._add_joints(body, j, names[j], axes, driven)

    def _add_joints(
        self, body: Any, j: int, names: Sequence[str], axes: Floats, driven: Mapping[str, Servo]
    ) -> None:
        """Add the joints between a body and its parent."""
        tree = self.world.model
        if tree.joints[j].shortname() == "JointModelFreeFlyer":
            body.add_freejoint(name=str(tree.names[j]))
            return
        coordinates = self.world.coordinates
        for k, name in enumerate(names):
            joint, slides = self._add_joint(body, name, axes[:, k])
            servo = driven.get(name)
            if servo is not None:
                servo.configure_joint(joint, self.mj)
                continue
            owner, _, own = name.partition(".")
            stated = self.world.scene.objects[owner].object.resistance.get(own, Resistance())
            usual = self.physics.prismatic_damping if slides else self.physics.revolute_damping
            joint.damping[0] = stated.damping or usual
            joint.frictionloss = stated.friction
            joint.stiffness[0] = stated.stiffness
            joint.springref = stated.springref
            column = coordinates.index(name)
            limits = (coordinates.lower[column], coordinates.upper[column])
            if np.isfinite(limits).all():
                joint.limited = self.mj.mjtLimited.mjLIMITED_TRUE
                joint.range = limits

    def _add_joint(self, body: Any, name: str, twist: Floats) -> tuple[Any, bool]:
        """Add a joint along or about a twist's axis, shape (6,); return it and whether it slides.

        The twist has the linear velocity first, as in Pinocchio.
        """
        slides = bool(np.linalg.norm(twist[:3]) > 0.5)
        if slides:
            kind = self.mj.mjtJoint.mjJNT_SLIDE
            axis = twist[:3]
        else:
            kind = self.mj.mjtJoint.mjJNT_HINGE
            axis = twist[3:]
        joint = body.add_joint(name=name, axis=axis, type=kind)
        return joint, slides

    def _is_balanced(self, joint: int) -> bool:
        """Return whether springs balance the weight on an object's joint."""
        owner = str(self.world.model.names[joint]).partition(".")[0]
        placed = self.world.scene.objects.get(owner)
        return self.physics.balanced and placed is not None and not placed.object.free

    def _add_geoms(self, pairs: Pairs) -> None:
        """Add the collision shapes and their contact pairs."""
        sliding = self.physics.friction
        rolling = self.physics.rolling_friction
        is_sphere = [isinstance(shape.geometry, coal.Sphere) for shape in self.world.shapes]
        for number, shape in enumerate(self.world.shapes):
            body = self.bodies[shape.parentJoint]
            place = shape.placement
            if number in self.moved_shapes:
                body, place = self.moved_shapes[number]
            geom = self.add_geom(body, f"shape {number}", shape.geometry, place)
            geom.contype = int(pairs.types[number])
            geom.conaffinity = int(pairs.affinities[number])
            geom.friction[0] = sliding
            geom.friction[2] = rolling
            geom.condim = 6 if is_sphere[number] else 4  # only the former have rolling friction
            geom.solref = _CONTACT
            geom.group = _HIDDEN_GROUP
            geom.rgba = [*np.asarray(shape.meshColor)[:3], 1.0]
        for first, second in pairs.always.tolist():
            pair = self.spec.add_pair(geomname1=f"shape {first}", geomname2=f"shape {second}")
            pair.condim = 6 if is_sphere[first] or is_sphere[second] else 4
            pair.friction[:2] = sliding
            pair.friction[3:] = rolling
            pair.solref = _CONTACT
            if self.has_friction_grasps:
                pair.solreffriction = [2.0 * self.physics.timestep, 1.0]

    def add_geom(
        self,
        body: Any,
        name: str,
        shape: coal.CollisionGeometry,
        place: pin.SE3,
        *,
        thin: bool = False,
    ) -> Any:
        """Add a shape to a body; a `thin` mesh may have no volume."""
        kinds = self.mj.mjtGeom
        where = {"name": name, "pos": place.translation, "quat": to_mujoco_quaternion(place)}
        if isinstance(shape, PointCloud):
            raise InputError(
                "measured points cannot be simulated",
                field="scene.obstacles",
                expected="shapes instead of points",
            )
        if isinstance(shape, coal.Box):
            return body.add_geom(type=kinds.mjGEOM_BOX, size=shape.halfSide, **where)
        if isinstance(shape, coal.Sphere):
            return body.add_geom(type=kinds.mjGEOM_SPHERE, size=[shape.radius, 0.0, 0.0], **where)
        if isinstance(shape, coal.Cylinder | coal.Capsule):
            is_cylinder = isinstance(shape, coal.Cylinder)
            kind = kinds.mjGEOM_CYLINDER if is_cylinder else kinds.mjGEOM_CAPSULE
            return body.add_geom(type=kind, size=[shape.radius, shape.halfLength, 0.0], **where)
        if isinstance(shape, coal.Ellipsoid):
            return body.add_geom(type=kinds.mjGEOM_ELLIPSOID, size=shape.radii, **where)
        points, faces = triangulate(shape)
        mesh = self.spec.add_mesh(name=name, uservert=points.ravel(), userface=faces.ravel())
        inertias = self.mj.mjtMeshInertia
        mesh.inertia = inertias.mjMESH_INERTIA_SHELL if thin else inertias.mjMESH_INERTIA_CONVEX
        return body.add_geom(type=kinds.mjGEOM_MESH, meshname=name, **where)

    def find_frame(self, frame: str) -> tuple[Any, pin.SE3]:
        """Return the body that carries a frame of the tree, and the frame's placement in it."""
        target = self.world.model.frames[self.world.model.getFrameId(frame)]
        return self.bodies[target.parentJoint], target.placement

    def _add_weld(self, hold: Hold) -> None:
        """Add a weld between holder and link."""
        scene = self.world.scene
        attachment = scene.objects[hold.object].object.attachment(hold.attachment)
        holder, _ = self.find_frame(hold.frame or scene.robot.tool_frame)
        held, place = self.find_frame(f"{hold.object}.{attachment.link}")
        if not is_rigid_grasp(scene, hold):
            held = self._add_carrier(hold, held, place * attachment.placement)
        weld = self.spec.add_equality(
            type=self.mj.mjtEq.mjEQ_WELD, objtype=self.mj.mjtObj.mjOBJ_BODY, active=False
        )
        weld.name1 = holder.name
        weld.name2 = held.name

    def _set_stiffness(self, model: Any, number: int) -> None:
        """Set the stiffness of a weld, in a compiled model.

        MuJoCo's constraint of a deviation r has the impedance d and the regularization
        R = (1 - d) / d · a, where a is the sum of the bodies' inverse weights. At rest its force is
        d k r / R, with k = 1 / (d T)² for the time constant T. Therefore 1 - d = 1 / (K a T²) for
        the stiffness K. If even d = 1/2 is too stiff, T is longer. Rotations are r = s θ / 2 with a
        factor s; their torque about the angle θ is s / 2 times the force.

        Source: MuJoCo's documentation, "Computation", section "Constraint model: Parameters".
        """
        stiffness = self.physics.grasp_stiffness
        turning_stiffness = self.physics.grasp_turning_stiffness
        bodies = [int(model.eq_obj1id[number]), int(model.eq_obj2id[number])]
        shift, turn = np.asarray(model.body_invweight0)[bodies].sum(axis=0).tolist()
        time_constant = 2.0 * self.physics.timestep  # the shortest that the integrator allows
        impedance = 1.0 - 1.0 / (stiffness * shift * time_constant**2)
        if impedance < _SOFT_IMPEDANCE:
            impedance = _SOFT_IMPEDANCE
            time_constant = np.sqrt(1.0 / ((1.0 - impedance) * stiffness * shift))
        model.eq_solref[number] = time_constant, 1.0
        model.eq_solimp[number, :2] = min(impedance, _MAX_IMPEDANCE)
        ratio = turning_stiffness * turn / (stiffness * shift)
        model.eq_data[number, TORQUE_SCALE] = 2.0 * np.sqrt(ratio)

    def _add_carrier(self, hold: Hold, link: Any, place: pin.SE3) -> Any:
        """Add an intermediate body whose joints are the degrees of freedom of a grasp."""
        attachment = self.world.scene.objects[hold.object].object.attachment(hold.attachment)
        name = f"carrier {len(self._carrier_joints)}"
        body = link.add_body(
            name=name, pos=place.translation, quat=to_mujoco_quaternion(place), gravcomp=1.0
        )
        body.mass = _CARRIER_MASS
        body.inertia = np.full(3, _CARRIER_INERTIA)
        body.explicitinertial = True
        kinds = self.mj.mjtJoint
        joints: list[str] = []
        self._carrier_joints[hold] = joints
        for k, freedom in enumerate(attachment.freedoms):
            kind = kinds.mjJNT_HINGE if freedom.kind == "revolute" else kinds.mjJNT_SLIDE
            joint = body.add_joint(
                name=f"{name} {k}", type=kind, axis=freedom.axis, pos=freedom.through
            )
            joint.damping[0] = _CARRIER_DAMPING
            if np.isfinite([freedom.lower, freedom.upper]).all():
                joint.limited = self.mj.mjtLimited.mjLIMITED_TRUE
                joint.range = freedom.lower, freedom.upper
                # as stiff as the integrator allows
                joint.solref_limit = [2.0 * self.physics.timestep, 1.0]
                joint.solimp_limit[:2] = _MAX_IMPEDANCE
            joints.append(joint.name)
        return body

    def _add_joint_equality(self, joint: str, value: float, *, active: bool = False) -> Any:
        """Add an equality that fixes a joint at a value, and return it."""
        equality = self.spec.add_equality(
            type=self.mj.mjtEq.mjEQ_JOINT,
            objtype=self.mj.mjtObj.mjOBJ_JOINT,
            name1=joint,
            active=active,
        )
        equality.data[0] = value
        return equality

    def _add_coupling(self, move: MovedJoint) -> None:
        """Add an equality that couples a mimic joint to the joint that it follows."""
        follower = str(self.world.model.names[move.joint])
        equality = self._add_joint_equality(follower, move.offset, active=True)
        equality.name2 = self.world.coordinates.names[move.coordinate]
        equality.data[1] = move.factor
        equality.solref = [2.0 * self.physics.timestep, 1.0]  # as stiff as the integrator allows

    def _find_addresses(self, model: Any) -> tuple[Ints, Ints]:
        """Return the indices of the world coordinates in MuJoCo's positions and velocities."""
        tree = self.world.model
        coordinates = self.world.coordinates
        columns: list[int] = []
        dofs: list[int] = []
        done = set[int]()  # free joints
        for name, j in zip(coordinates.names, coordinates.joints, strict=True):
            if tree.joints[j].shortname() != "JointModelFreeFlyer":
                joint = model.joint(name)
                columns.append(int(joint.qposadr[0]))
                dofs.append(int(joint.dofadr[0]))
            elif j not in done:
                done.add(j)
                first = int(model.joint(str(tree.names[j])).qposadr[0])
                # MuJoCo's quaternions begin with w.
                columns += [first + k for k in (0, 1, 2, 4, 5, 6, 3)]
                dofs += [-1] * 7
        return np.array(columns), np.array(dofs)


def to_mujoco_quaternion(placement: pin.SE3) -> Floats:
    """Return the quaternion of a placement's rotation, w first as in MuJoCo, shape (4,)."""
    return np.asarray(pin.Quaternion(placement.rotation).coeffs())[[3, 0, 1, 2]]
