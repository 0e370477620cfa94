"""Reads an MJCF file with MuJoCo's compiler (https://mujoco.readthedocs.io/en/stable/XMLreference.html).

The compiler resolves includes, defaults, classes and units; its result is read here, not the file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import (
    Colour,
    Coupling,
    Description,
    Joint,
    Limits,
    Link,
    Loop,
    Part,
    make_limits,
)
from vkc_pin.importing.formats.mjcf_compiler import NO_MASS, compile_mjcf
from vkc_pin.simulation.robot_in_model import copy_positions
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional

if TYPE_CHECKING:
    import trimesh

_HIDDEN = 3  # first group that MuJoCo's viewer hides; by convention, collision geometry
_FREE = 0  # type of a free joint
_DEGREE = 5  # coefficients of the polynomial of a coupling
_EQUALITY = "<equality>"


def read_mjcf_description(file: Path) -> Description:
    """Read the description of a robot, an object or a home from an MJCF file.

    Positions are relative to the pose of the file. Everything fixed in the world becomes one link,
    `world`. Free bodies are on floating joints. A body's frame is moved to its last joint, and
    several joints of one body are connected by links without shapes.
    """
    model, notes = compile_mjcf(file)
    mujoco = import_optional("mujoco", "import", purpose="reading MJCF", file=file)
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    return _Reader(mujoco, model, data, file, notes).read()


class CompiledModel(NamedTuple):
    """A compiled model as it was read.

    Attributes:
        description: Its description.
        positions: Positions of hinges and slides by name, relative to `model.qpos0`, [rad] or [m].
        bodies: Link of each body.
    """

    description: Description
    positions: dict[str, float]
    bodies: tuple[str, ...]


def read_compiled_model(model: Any, data: Any) -> CompiledModel:
    """Read a compiled model, and the positions of its joints.

    The description is that of `read_mjcf_description`, but bodies whose geoms collide with nothing
    have no shapes, and free bodies, ball joints and mocap bodies are where `data` has them.

    Args:
        model: The `mujoco.MjModel`.
        data: Its `mujoco.MjData`, of which `qpos`, `mocap_pos` and `mocap_quat` are read.
    """
    mujoco = import_optional("mujoco", "sim", purpose="reading a compiled model")
    scalar = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    at_zero = copy_positions(model, data)
    addresses = dict[int, int]()  # in `qpos` of each hinge and slide
    for joint in range(model.njnt):
        if int(model.jnt_type[joint]) in scalar:
            addresses[joint] = int(model.jnt_qposadr[joint])
    for address in addresses.values():
        at_zero.qpos[address] = model.qpos0[address]
    mujoco.mj_kinematics(model, at_zero)
    name = bytes(model.names).split(b"\0", 1)[0].decode() or "model"
    reader = _Reader(mujoco, model, at_zero, Path(name), [], keeps_intangible=False)
    positions = dict[str, float]()
    for joint, address in addresses.items():
        positions[reader.find_joint_name(joint)] = float(data.qpos[address] - model.qpos0[address])
    return CompiledModel(reader.read(), positions, reader.bodies)


class _Reader:
    """Reads a compiled model.

    Args:
        mujoco: The package.
        model: The `mujoco.MjModel`.
        data: Its `mujoco.MjData`, whose kinematics are computed, with hinges and slides at
            `model.qpos0`.
        file: The file, for messages.
        notes: Notes, to which changes and omissions are added.
        keeps_intangible: Whether bodies that collide with nothing keep their visual shapes.
    """

    def __init__(
        self,
        mujoco: Any,
        model: Any,
        data: Any,
        file: Path,
        notes: list[str],
        *,
        keeps_intangible: bool = True,
    ) -> None:
        self._keeps_intangible = keeps_intangible
        self._paired = {int(geom) for geom in (*model.pair_geom1, *model.pair_geom2)}
        self._mujoco = mujoco
        self._model = model
        self._data = data
        self._file = file
        self._notes = notes
        names = [str(model.body(k).name) for k in range(model.nbody)]
        self._taken = set(filter(None, names))
        self._bodies = [name or self._add_name(f"body_{k}") for k, name in enumerate(names)]
        # A body whose frame is moved to its last joint may carry bodies of smaller numbers.
        self._frames = {name: self._find_frame(body) for body, name in enumerate(self._bodies)}
        self._surfaces: dict[int, trimesh.Trimesh] = {}  # by number of the mesh

    def read(self) -> Description:
        """Return the description; see `read_mjcf_description`."""
        links = dict[str, Link]()
        joints = dict[str, Joint]()
        for body, name in enumerate(self._bodies):
            for joint in self._read_joints(body):
                joints[joint.child] = joint
                links[joint.child] = Link(joint.child)
            visual, collision = self._read_shapes(body)
            links[name] = Link(name, visual, collision, self._read_inertia(body))
        couplings, loops = self._read_equalities()
        return Description(
            self._file,
            links,
            joints,
            notes=tuple(self._notes),
            format="MJCF",
            couplings=tuple(couplings),
            loops=tuple(loops),
            states=self._read_states(),
            is_world=True,
        )

    # Bodies and joints

    def _read_joints(self, body: int) -> list[Joint]:
        """Return the joints between a body and its parent, outermost last; none for the world."""
        if body == 0:
            return []
        name = self._bodies[body]
        parent = self._bodies[int(self._model.body_parentid[body])]
        moving = self._list_scalar_joints(body)
        if not moving:
            kind = "floating" if self._is_free(body) else "fixed"
            placement = self._frames[parent].inverse() * self._frames[name]
            joint = Joint(
                name=f"{name}_{kind}", kind=kind, parent=parent, child=name, placement=placement
            )
            return [joint]
        found = list[Joint]()
        for count, number in enumerate(moving):
            link = name
            if count < len(moving) - 1:
                link = self._add_name(f"{name}_{count}")
                self._frames[link] = self._find_joint_frame(body, number)
            found.append(self._read_joint(number, parent, link))
            parent = link
        return found

    def _list_joints(self, body: int) -> range:
        first = int(self._model.body_jntadr[body])
        return range(first, first + int(self._model.body_jntnum[body]))

    def _list_scalar_joints(self, body: int) -> list[int]:
        """Return the joints of a body, without free ones."""
        joints = self._list_joints(body)
        return [joint for joint in joints if int(self._model.jnt_type[joint]) != _FREE]

    def _is_free(self, body: int) -> bool:
        kinds = {int(self._model.jnt_type[joint]) for joint in self._list_joints(body)}
        return _FREE in kinds

    def _find_frame(self, body: int) -> pin.SE3:
        """Return the frame of a body's link: that of the body, moved to its last joint."""
        moving = self._list_scalar_joints(body)
        if moving:
            return self._find_joint_frame(body, moving[-1])
        return _make_placement(self._data.xpos[body], self._data.xmat[body])

    def _find_joint_frame(self, body: int, joint: int) -> pin.SE3:
        return _make_placement(self._data.xanchor[joint], self._data.xmat[body])

    def _read_joint(self, number: int, parent: str, child: str) -> Joint:
        model = self._model
        kinds = self._mujoco.mjtJoint
        name = self._find_name("joint", number)
        placement = self._frames[parent].inverse() * self._frames[child]
        code = int(model.jnt_type[number])
        if code not in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
            self._notes.append(f"joint '{name}' is a ball joint: taken as fixed")
            return Joint(name=name, kind="fixed", parent=parent, child=child, placement=placement)
        position = int(model.jnt_qposadr[number])
        velocity = int(model.jnt_dofadr[number])
        zero = float(model.qpos0[position])
        if zero:
            self._notes.append(
                f"joint '{name}' is at its `ref` in the file: values are less by {zero:.4g}"
            )
        axis = self._frames[child].rotation.T @ self._data.xaxis[number]
        actuators = self._find_actuators(number)
        return Joint(
            name=name,
            kind="revolute" if code == int(kinds.mjJNT_HINGE) else "prismatic",
            parent=parent,
            child=child,
            placement=placement,
            axis=np.asarray(axis),
            limits=self._find_limits(number, zero),
            effort=self._find_effort(number, actuators),
            damping=_get_first(model.dof_damping[velocity]),
            friction=float(model.dof_frictionloss[velocity]),
            stiffness=_get_first(model.jnt_stiffness[number]),
            springref=float(model.qpos_spring[position]) - zero,
            is_driven=bool(actuators),
        )

    def _find_limits(self, joint: int, zero: float) -> Limits:
        """Return the limits of a joint relative to its position `zero` in the file."""
        if not self._model.jnt_limited[joint]:
            return make_limits(-np.inf, np.inf)
        low, high = (float(value) - zero for value in self._model.jnt_range[joint])
        return make_limits(low, high)

    def _find_actuators(self, joint: int) -> list[int]:
        """Return the actuators of a joint."""
        model = self._model
        is_on_joint = model.actuator_trntype == int(self._mujoco.mjtTrn.mjTRN_JOINT)
        found = np.flatnonzero(is_on_joint & (model.actuator_trnid[:, 0] == joint))
        return [int(actuator) for actuator in found]

    def _find_effort(self, joint: int, actuators: list[int]) -> float | None:
        """Return the effort limit of a joint, its own or that of an actuator, [N] or [N·m]."""
        model = self._model
        limit = 0.0
        if model.jnt_actfrclimited[joint]:
            limit = float(np.abs(model.jnt_actfrcrange[joint]).max())
        else:
            for actuator in actuators:
                if model.actuator_forcelimited[actuator]:
                    force = float(np.abs(model.actuator_forcerange[actuator]).max())
                    limit = force * abs(float(model.actuator_gear[actuator, 0]))
                    break
        return limit if limit > 0.0 else None

    def _read_inertia(self, body: int) -> pin.Inertia:
        """Return a body's inertia as stated, or as MuJoCo computes it from its geoms' densities."""
        model = self._model
        mass = float(model.body_mass[body])
        if not mass > NO_MASS:
            return pin.Inertia.Zero()
        principal = pin.Inertia(mass, np.zeros(3), np.diag(model.body_inertia[body]))
        axes = _make_placement(self._data.xipos[body], self._data.ximat[body])
        return (self._frames[self._bodies[body]].inverse() * axes).act(principal)

    # Shapes

    def _read_shapes(self, body: int) -> tuple[tuple[Part, ...], tuple[Part, ...]]:
        """Return the visual and the collision shapes of a body.

        Visual are those that MuJoCo's viewer shows and those that do not collide, and all of a body
        that has none of these.
        """
        model = self._model
        visual = list[Part]()
        collision = list[Part]()
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            part = self._read_shape(body, geom)
            if part is None:
                continue
            collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            collides = collides or geom in self._paired
            if collides:
                collision.append(part)
            if int(model.geom_group[geom]) < _HIDDEN or not collides:
                visual.append(part)
        if not collision and not self._keeps_intangible:
            return (), ()
        return tuple(visual or collision), tuple(collision)

    def _read_shape(self, body: int, geom: int) -> Part | None:
        """Return a shape, or None with a note if it has no volume."""
        types = self._mujoco.mjtGeom
        code = int(self._model.geom_type[geom])
        name = self._find_shape_name(geom)
        size = tuple(float(value) for value in self._model.geom_size[geom])
        radius, half_length, _ = size
        triangles = None
        if code == types.mjGEOM_BOX:
            kind = "box"
            size = tuple(2.0 * value for value in size)
        elif code == types.mjGEOM_SPHERE:
            kind = "sphere"
            size = (radius,)
        elif code in (types.mjGEOM_CYLINDER, types.mjGEOM_CAPSULE):
            kind = "cylinder" if code == types.mjGEOM_CYLINDER else "capsule"
            size = (radius, 2.0 * half_length)
        elif code == types.mjGEOM_ELLIPSOID:  # its semi-axes are the scale of a unit sphere
            import trimesh

            kind = "mesh"
            triangles = trimesh.creation.icosphere(subdivisions=3)
        elif code == types.mjGEOM_MESH:
            kind = "mesh"
            size = (1.0, 1.0, 1.0)
            triangles = self._read_mesh(int(self._model.geom_dataid[geom]))
        else:
            is_field = code == types.mjGEOM_HFIELD
            why = "is a height field" if is_field else "has no volume (a plane)"
            self._notes.append(f"geom '{name}' of body '{self._bodies[body]}' {why}: left out")
            return None
        place = _make_placement(self._data.geom_xpos[geom], self._data.geom_xmat[geom])
        return Part(
            name=name,
            placement=self._frames[self._bodies[body]].inverse() * place,
            kind=kind,
            size=size,
            triangles=triangles,
            colour=self._find_colour(geom),
        )

    def _find_colour(self, geom: int) -> Colour:
        material = int(self._model.geom_matid[geom])
        rgba = self._model.geom_rgba[geom] if material < 0 else self._model.mat_rgba[material]
        red, green, blue, opacity = (float(value) for value in rgba)
        return (red, green, blue, opacity)

    def _read_mesh(self, number: int) -> trimesh.Trimesh:
        import trimesh

        if number not in self._surfaces:
            model = self._model
            first_vertex = int(model.mesh_vertadr[number])
            first_face = int(model.mesh_faceadr[number])
            vertices = model.mesh_vert[first_vertex:][: int(model.mesh_vertnum[number])]
            faces = model.mesh_face[first_face:][: int(model.mesh_facenum[number])]
            mesh = trimesh.Trimesh(np.array(vertices, float), np.array(faces))
            self._surfaces[number] = mesh
        return self._surfaces[number]

    def _find_shape_name(self, geom: int) -> str:
        """Return the name of a geom, or that of its mesh."""
        name = str(self._model.geom(geom).name)
        if name:
            return name
        # Of a height field, the number is one of height fields.
        is_mesh = int(self._model.geom_type[geom]) == int(self._mujoco.mjtGeom.mjGEOM_MESH)
        return self._find_name("mesh", int(self._model.geom_dataid[geom])) if is_mesh else ""

    # Equalities and key frames

    def _read_equalities(self) -> tuple[list[Coupling], list[Loop]]:
        """Return the couplings and loops of the equalities that are active at first."""
        model = self._model
        kinds = self._mujoco.mjtEq
        couplings = list[Coupling]()
        loops = list[Loop]()
        for number in np.flatnonzero(model.eq_active0).tolist():
            kind = int(model.eq_type[number])
            if kind == kinds.mjEQ_JOINT:
                leader = int(model.eq_obj2id[number])
                coefficients = [float(value) for value in model.eq_data[number][:_DEGREE]]
                coupling = Coupling(
                    self._find_name("joint", int(model.eq_obj1id[number])),
                    self._find_name("joint", leader) if leader >= 0 else None,
                    tuple(coefficients),
                    _EQUALITY,
                )
                couplings.append(coupling)
            elif kind == kinds.mjEQ_CONNECT:
                loops.append(self._read_loop(number, "connected"))
            elif kind == kinds.mjEQ_WELD:
                loops.append(self._read_loop(number, "welded"))
            else:
                name = str(model.equality(number).name) or f"number {number}"
                about = f"{_EQUALITY} '{name}' of tendons or flexible parts"
                self._notes.append(f"{about}: left out")
        return couplings, loops

    def _read_loop(self, equality: int, kind: str) -> Loop:
        """Return a connection of two bodies, which may name sites."""
        model = self._model
        one = int(model.eq_obj1id[equality])
        other = int(model.eq_obj2id[equality])
        if int(model.eq_objtype[equality]) == self._mujoco.mjtObj.mjOBJ_SITE:
            bodies = (int(model.site_bodyid[one]), int(model.site_bodyid[other]))
            points = (self._data.site_xpos[one], self._data.site_xpos[other])
        else:
            bodies = (one, other)
            points = (
                self._place_point(one, model.eq_data[equality, :3]),
                self._place_point(other, model.eq_data[equality, 3:6]),
            )
        first = self._bodies[bodies[0]]
        second = self._bodies[bodies[1]]
        if kind == "welded":
            return Loop(kind, (first, second), None, _EQUALITY)
        local = (
            self._frames[first].actInv(np.array(points[0])),
            self._frames[second].actInv(np.array(points[1])),
        )
        return Loop(kind, (first, second), local, _EQUALITY)

    def _place_point(self, body: int, point: Floats) -> Floats:
        """Return a point of a body in the world [m], shape (3,)."""
        rotation = self._data.xmat[body].reshape(3, 3)
        return np.asarray(self._data.xpos[body] + rotation @ point)

    def _read_states(self) -> dict[str, dict[str, float]]:
        """Return the joint positions of each key frame, relative to the pose of the file."""
        model = self._model
        states = dict[str, dict[str, float]]()
        for key in range(model.nkey):
            positions = dict[str, float]()
            for joint in range(model.njnt):
                kinds = self._mujoco.mjtJoint
                if int(model.jnt_type[joint]) in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)):
                    address = int(model.jnt_qposadr[joint])
                    moved = model.key_qpos[key, address] - model.qpos0[address]
                    positions[self._find_name("joint", joint)] = float(moved)
            states[self._find_name("key", key)] = positions
        return states

    # Names

    def _add_name(self, name: str) -> str:
        """Return a name for a link without one: `name`, with "_" appended while it is taken."""
        while name in self._taken:
            name += "_"
        self._taken.add(name)
        return name

    @property
    def bodies(self) -> tuple[str, ...]:
        """Link of each body."""
        return tuple(self._bodies)

    def find_joint_name(self, joint: int) -> str:
        """Return the name of a joint, or its number."""
        return self._find_name("joint", joint)

    def _find_name(self, kind: str, number: int) -> str:
        """Return the name of an element, or its kind and number."""
        get: Callable[[int], Any] = getattr(self._model, kind)
        return str(get(number).name) or f"{kind}_{number}"


def _get_first(value: Any) -> float:
    """Return a number, or the first one of the array that new versions of MuJoCo have there."""
    return float(np.ravel(value)[0])


def _make_placement(position: Any, matrix: Any) -> pin.SE3:
    rotation: Floats = np.array(matrix, float).reshape(3, 3)
    return pin.SE3(rotation, np.array(position, float))
