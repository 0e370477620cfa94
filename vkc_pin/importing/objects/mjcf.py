"""Reads an object from an MJCF file with MuJoCo's compiler."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.mjcf_models import NO_MASS, compile_mjcf
from vkc_pin.importing.objects.description import (
    Description,
    Joint,
    Link,
    Part,
    limit_follower,
    make_limits,
)
from vkc_pin.importing.objects.mjcf_equalities import FREE, list_joints, read_equalities
from vkc_pin.utils.optional_imports import import_optional

_HIDDEN = 3  # first group that MuJoCo's viewer hides; by convention, collision geometry


def read_object_mjcf(file: Path, *, free: bool = False) -> Description:
    """Read the description of an object or a home from an MJCF file.

    Everything fixed in the world becomes one link, `world`. Active equalities hold joints and
    attach free bodies; see `read_equalities`.

    Args:
        file: The file.
        free: Whether to keep free bodies, on floating joints; otherwise they are left out.
    """
    model, notes = compile_mjcf(file)
    mujoco = import_optional("mujoco", "import", purpose="reading MJCF", file=file)
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    return _Reader(mujoco, model, data, file, notes).read(free=free)


class _Reader:
    def __init__(self, mujoco: Any, model: Any, data: Any, file: Path, notes: list[str]) -> None:
        self.mujoco, self.model, self.data, self.file = mujoco, model, data, file
        self.notes = notes
        names = [str(model.body(k).name) for k in range(model.nbody)]
        self.taken = set(filter(None, names))
        self.bodies = [name or self._add_name(f"body_{k}") for k, name in enumerate(names)]
        self.equalities = read_equalities(mujoco, model)

    def read(self, *, free: bool) -> Description:
        """Return the description; see `read_object_mjcf`."""
        self.notes += self.equalities.notes
        frames, links, joints = dict[str, pin.SE3](), dict[str, Link](), dict[str, Joint]()
        kept = [body for body in range(self.model.nbody) if free or not self._is_separate(body)]
        # A body whose frame is moved to its last joint may carry bodies of smaller numbers.
        frames |= {self.bodies[body]: self._find_frame(body) for body in kept}
        for body in range(self.model.nbody):
            name = self.bodies[body]
            if body not in kept:
                if self._is_free(body):
                    self.notes.append(f"body '{name}' is free, hence a separate object: left out")
                continue
            last = self.bodies[self._find_parent(body)]
            # Several joints of one body are connected by links without shapes.
            moving = self._list_joints(body)
            for count, j in enumerate(moving):
                link = name if count == len(moving) - 1 else self._add_name(f"{name}_{count}")
                frames[link] = self._find_joint_frame(body, j)
                joints[link] = self._read_joint(j, last, link, frames)
                links[link] = Link(link)
                last = link
            if body and not moving:
                kind = "floating" if self._is_free(body) else "fixed"
                joints[name] = Joint(
                    name=f"{name}_{kind}",
                    kind=kind,
                    parent=last,
                    child=name,
                    placement=frames[last].inverse() * frames[name],
                )
            links[name] = Link(
                name, *self._read_shapes(body, frames[name]), self._read_inertia(body, frames[name])
            )
        return Description(self.file, links, joints, tuple(self.notes))

    def _is_free(self, body: int) -> bool:
        """Return whether a body has a free joint, and no equality attaches it to another."""
        is_floating = any(
            int(self.model.jnt_type[j]) == FREE for j in list_joints(self.model, body)
        )
        return is_floating and body not in self.equalities.attached

    def _is_separate(self, body: int) -> bool:
        """Return whether a body is free or on a free one."""
        while body and not self._is_free(body):
            body = self._find_parent(body)
        return body > 0

    def _find_parent(self, body: int) -> int:
        return self.equalities.attached.get(body, int(self.model.body_parentid[body]))

    def _list_joints(self, body: int) -> list[int]:
        """Return the joints of a body, without free ones."""
        joints = list_joints(self.model, body)
        return [j for j in joints if int(self.model.jnt_type[j]) != FREE]

    def _find_frame(self, body: int) -> pin.SE3:
        """Return the frame of a body's link: that of the body, moved to its last joint."""
        moving = self._list_joints(body)
        if moving:
            return self._find_joint_frame(body, moving[-1])
        return _placement(self.data.xpos[body], self.data.xmat[body])

    def _find_joint_frame(self, body: int, joint: int) -> pin.SE3:
        return _placement(self.data.xanchor[joint], self.data.xmat[body])

    def _read_joint(
        self, number: int, parent: str, child: str, frames: dict[str, pin.SE3]
    ) -> Joint:
        model = self.model
        kind = {2: "prismatic", 3: "revolute"}.get(int(model.jnt_type[number]), "fixed")
        name = self._find_name("joint", number)
        if kind == "fixed":
            self.notes.append(f"joint '{name}' is a ball joint: taken as fixed")
        address = model.jnt_qposadr[number]
        zero = 0.0 if kind == "fixed" else float(model.qpos0[address])
        if zero:
            self.notes.append(
                f"joint '{name}' is at its `ref` in the file: values are less by {zero:.4g}"
            )
        joint = Joint(
            name=name,
            kind=kind,
            parent=parent,
            child=child,
            placement=frames[parent].inverse() * frames[child],
            axis=np.asarray(frames[child].rotation.T @ self.data.xaxis[number]),
            limits=None if kind == "fixed" else self._find_limits(number),
            damping=float(np.ravel(model.dof_damping[model.jnt_dofadr[number]])[0]),
            friction=float(model.dof_frictionloss[model.jnt_dofadr[number]]),
            stiffness=float(np.ravel(model.jnt_stiffness[number])[0]),
            springref=float(model.qpos_spring[address]) - zero,
        )
        held = self.equalities.held
        return joint.fix(held[number]) if number in held else joint

    def _find_limits(self, number: int) -> tuple[float, float] | None:
        """Return the limits of a joint relative to the file, as far as its leader reaches."""
        limits = None
        if self.model.jnt_limited[number]:
            zero = float(self.model.qpos0[self.model.jnt_qposadr[number]])
            low, high = (float(value) - zero for value in self.model.jnt_range[number])
            limits = make_limits(low, high)
        if number not in self.equalities.followers:
            return limits
        leader, factor, offset = self.equalities.followers[number]
        return limit_follower(limits, self._find_limits(leader), factor, offset)

    def _read_inertia(self, body: int, frame: pin.SE3) -> pin.Inertia:
        """Return a body's inertia as stated, or as MuJoCo computes it from its geoms' densities."""
        if not self.model.body_mass[body] > NO_MASS:
            return pin.Inertia.Zero()
        principal = pin.Inertia(
            float(self.model.body_mass[body]), np.zeros(3), np.diag(self.model.body_inertia[body])
        )
        return (frame.inverse() * _placement(self.data.xipos[body], self.data.ximat[body])).act(
            principal
        )

    def _read_shapes(self, body: int, frame: pin.SE3) -> tuple[tuple[Part, ...], tuple[Part, ...]]:
        """Return the visual and the collision shapes of a body."""
        model, kinds = self.model, self.mujoco.mjtGeom
        visual, collision = list[Part](), list[Part]()
        for geom in range(
            int(model.body_geomadr[body]),
            int(model.body_geomadr[body]) + int(model.body_geomnum[body]),
        ):
            kind, size = int(model.geom_type[geom]), model.geom_size[geom]
            rgba = (
                model.geom_rgba[geom]
                if model.geom_matid[geom] < 0
                else model.mat_rgba[model.geom_matid[geom]]
            )
            shape: tuple[str, tuple[float, ...]] | None = {
                int(kinds.mjGEOM_BOX): ("box", tuple(2.0 * float(s) for s in size)),
                int(kinds.mjGEOM_SPHERE): ("sphere", (float(size[0]),)),
                int(kinds.mjGEOM_CYLINDER): ("cylinder", (float(size[0]), 2.0 * float(size[1]))),
                int(kinds.mjGEOM_CAPSULE): ("capsule", (float(size[0]), 2.0 * float(size[1]))),
                int(kinds.mjGEOM_ELLIPSOID): ("mesh", tuple(map(float, size))),
                int(kinds.mjGEOM_MESH): ("mesh", (1.0, 1.0, 1.0)),
            }.get(kind)
            name = self._find_name("geom", geom, default=self._find_mesh_name(geom))
            if shape is None:
                subject = f"geom '{name}' of body '{self.bodies[body]}'"
                is_field = kind == int(kinds.mjGEOM_HFIELD)
                why = "is a height field" if is_field else "has no volume (a plane)"
                self.notes.append(f"{subject} {why}: left out")
                continue
            part = Part(
                name=name,
                placement=frame.inverse()
                * _placement(self.data.geom_xpos[geom], self.data.geom_xmat[geom]),
                kind=shape[0],
                size=shape[1],
                triangles=self._read_mesh(geom) if shape[0] == "mesh" else None,
                colour=(float(rgba[0]), float(rgba[1]), float(rgba[2]), float(rgba[3])),
            )
            collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            if collides:
                collision.append(part)
            if int(model.geom_group[geom]) < _HIDDEN or not collides:
                visual.append(part)
        return tuple(visual), tuple(collision)

    def _read_mesh(self, geom: int) -> Any:
        import trimesh

        number = int(self.model.geom_dataid[geom])
        if number < 0:  # an ellipsoid, whose semi-axes are the scale
            return trimesh.creation.icosphere(subdivisions=3)
        first, count = int(self.model.mesh_vertadr[number]), int(self.model.mesh_vertnum[number])
        start, faces = int(self.model.mesh_faceadr[number]), int(self.model.mesh_facenum[number])
        corners = np.array(self.model.mesh_vert[first : first + count], float)
        return trimesh.Trimesh(corners, np.array(self.model.mesh_face[start : start + faces]))

    def _find_mesh_name(self, geom: int) -> str:
        number = int(self.model.geom_dataid[geom])
        # That of a height field is a number of height fields.
        is_mesh = int(self.model.geom_type[geom]) == int(self.mujoco.mjtGeom.mjGEOM_MESH)
        return self._find_name("mesh", number) if is_mesh else ""

    def _add_name(self, name: str) -> str:
        """Return a name for a link without one: `name`, with "_" appended while it is taken."""
        while name in self.taken:
            name += "_"
        self.taken.add(name)
        return name

    def _find_name(self, kind: str, number: int, default: str | None = None) -> str:
        name = getattr(self.model, kind)(number).name
        return str(name) or (f"{kind}_{number}" if default is None else default)


def _placement(position: Any, matrix: Any) -> pin.SE3:
    return pin.SE3(np.array(matrix, float).reshape(3, 3), np.array(position, float))
