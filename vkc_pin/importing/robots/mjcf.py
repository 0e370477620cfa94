"""Converts an MJCF file to a URDF, closed linkages included.

MuJoCo's compiler resolves includes, defaults, classes and units; its result is read here, not the
file.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.mjcf_models import NO_MASS, compile_mjcf
from vkc_pin.importing.targets import add_connection, add_origin, format_numbers
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.xml import replace_forbidden

_STEPS = 8  # steps of the driving joint from rest to either end of its range
_GAP = 1e-3  # [m] largest distance at which a loop counts as closed
_STIFFNESS = 1e-4  # weight of the distance from the previous configuration
_MAX_JOINTS = 24
_FAR = 20.0  # [m] limits of prismatic joints without limits


def solve_linkages(mujoco: Any, model: Any) -> list[list[dict[int, float]]]:
    """Return configurations of each linkage that is closed by <connect>.

    The joint with an actuator, or else the first one, drives a linkage. Joints that <joint>
    equalities couple belong to one linkage.

    Returns:
        For each linkage, its configurations at rest, at both ends of the driving joint's travel and
        halfway; each maps joint numbers to displacements from the file's pose, [m] or [rad].
    """
    return [
        _Linkage(mujoco, model, joints, connects, couplings).sweep()
        for joints, connects, couplings in _find_linkages(mujoco, model)
        if len(joints) <= _MAX_JOINTS
    ]


def _find_linkages(mujoco: Any, model: Any) -> list[tuple[list[int], list[int], list[int]]]:
    """Return joints, <connect> constraints and <joint> couplings of each linkage."""
    kinds, is_active = mujoco.mjtEq, model.eq_active0 > 0
    linkages: list[tuple[set[int], set[int], set[int]]] = []
    for k in np.flatnonzero((model.eq_type == int(kinds.mjEQ_CONNECT)) & is_active).tolist():
        one, other = (_find_joints(model, body) for body in _get_bodies(mujoco, model, k))
        if one and other:
            linkages.append((one ^ other, {k}, set()))
    for k in np.flatnonzero((model.eq_type == int(kinds.mjEQ_JOINT)) & is_active).tolist():
        pair = {int(model.eq_obj1id[k]), int(model.eq_obj2id[k])} - {-1}
        if any(pair & joints for joints, _, _ in linkages):
            linkages.append((pair, set(), {k}))
    merged: list[tuple[set[int], set[int], set[int]]] = []
    for linkage in linkages:
        touching = [other for other in merged if other[0] & linkage[0]]
        merged = [other for other in merged if other not in touching]
        joints, loops, pairs = (
            set[int]().union(*sets) for sets in zip(linkage, *touching, strict=True)
        )
        merged.append((joints, loops, pairs))
    return [(sorted(joints), sorted(loops), sorted(pairs)) for joints, loops, pairs in merged]


def _get_bodies(mujoco: Any, model: Any, equality: int) -> tuple[int, int]:
    one, other = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
    if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
        return int(model.site_bodyid[one]), int(model.site_bodyid[other])
    return one, other


def _find_joints(model: Any, body: int) -> set[int]:
    """Return the joints between a body and the world."""
    joints = set[int]()
    while body > 0:
        first = int(model.body_jntadr[body])
        joints |= set(range(first, first + int(model.body_jntnum[body])))
        body = int(model.body_parentid[body])
    return joints


class _Linkage:
    def __init__(
        self,
        mujoco: Any,
        model: Any,
        joints: Sequence[int],
        connects: Sequence[int],
        couplings: Sequence[int],
    ) -> None:
        self._mujoco, self._model, self._data = mujoco, model, mujoco.MjData(model)
        self._joints, self._connects, self._couplings = list(joints), connects, couplings
        self._addresses = model.jnt_qposadr[self._joints]
        self._zero = np.array(model.qpos0[self._addresses])
        limited = model.jnt_limited[self._joints].astype(bool)
        low, high = model.jnt_range[self._joints].T
        self._low = np.where(limited, low, -np.inf) - self._zero
        self._high = np.where(limited, high, np.inf) - self._zero
        by_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        driven = set(model.actuator_trnid[by_joint, 0].tolist())
        self._driver = next((k for k, joint in enumerate(self._joints) if joint in driven), 0)

    def sweep(self) -> list[dict[int, float]]:
        """Return the configurations at rest, halfway to either end, and at either end."""
        rest = np.clip(np.zeros(len(self._joints)), self._low, self._high)
        found = [rest]
        for end in (self._low[self._driver], self._high[self._driver]):
            path = self._follow(rest, float(end)) if np.isfinite(end) else []
            found += [path[(len(path) - 1) // 2], path[-1]] if path else []
        return [dict(zip(self._joints, map(float, state), strict=True)) for state in found]

    def _follow(self, rest: Floats, end: float) -> list[Floats]:
        """Return closed configurations on a path of the driving joint to `end`."""
        from scipy.optimize import least_squares

        path, before = list[Floats](), rest
        high = np.maximum(self._high, self._low + 1e-6)
        for target in np.linspace(rest[self._driver], end, _STEPS + 1)[1:]:

            def measure(state: Floats, target: float = target, before: Floats = before) -> Floats:
                off = [state[self._driver] - target], _STIFFNESS * (state - before)
                return np.concatenate([self._measure_gaps(state), *off])

            start = np.clip(before, self._low + 1e-9, high - 1e-9)
            state = least_squares(measure, start, bounds=(self._low, high)).x
            gaps = np.abs(self._measure_gaps(state)).max(initial=0.0)
            if gaps > _GAP or abs(state[self._driver] - target) > _GAP:
                break
            path.append(state)
            before = state
        return path

    def _measure_gaps(self, state: Floats) -> Floats:
        """Return the errors of the loops [m] and of the couplings."""
        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        data.qpos[self._addresses] = self._zero + state
        self._mujoco.mj_kinematics(model, data)
        gaps = [np.subtract(*self._find_anchors(k)) for k in self._connects]
        index = {joint: k for k, joint in enumerate(self._joints)}
        for k in self._couplings:
            one, other = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
            leader = state[index[other]] if other >= 0 else 0.0
            value = np.polynomial.polynomial.polyval(leader, model.eq_data[k, :5])
            gaps.append(np.array([state[index[one]] - value]))
        return np.concatenate(gaps)

    def _find_anchors(self, equality: int) -> tuple[Floats, Floats]:
        """Return both ends of a <connect> in the world [m], shape (3,) each."""
        model, data = self._model, self._data
        ids = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
        if model.eq_objtype[equality] == int(self._mujoco.mjtObj.mjOBJ_SITE):
            return data.site_xpos[ids[0]].copy(), data.site_xpos[ids[1]].copy()
        anchors = model.eq_data[equality, :3], model.eq_data[equality, 3:6]
        first, second = (
            data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor
            for body, anchor in zip(ids, anchors, strict=True)
        )
        return first, second


@dataclass
class ConvertedRobot:
    """A URDF converted from an MJCF file.

    Attributes:
        root: The URDF.
        states: Maps the name of each key frame to joint positions, [m] or [rad].
        linkages: For each linkage that <connect> closes, some of its configurations, the file's
            pose first: joint positions, [m] or [rad].
        notes: Changes and omissions.
    """

    root: ElementTree.Element
    states: dict[str, dict[str, float]] = field(default_factory=dict)
    linkages: list[list[dict[str, float]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def convert_mjcf(file: Path, folder: Path) -> ConvertedRobot:
    """Convert the largest joint tree of an MJCF file to a URDF, with STL meshes in `folder`.

    Bodies become links, and several joints of a body a chain of links. Notes name everything that a
    URDF cannot express: ball joints and free joints below the root are locked, planes left out.
    Other trees are left out.
    """
    model, notes = compile_mjcf(file)
    mujoco = import_optional("mujoco", "import", purpose="an MJCF file", file=file)
    return _Converter(mujoco, model, file, folder, notes).convert()


class _Converter:
    def __init__(self, mujoco: Any, model: Any, file: Path, folder: Path, notes: list[str]) -> None:
        self._mujoco, self._model, self._folder, self._file = mujoco, model, folder, file
        self._result = ConvertedRobot(
            ElementTree.Element("robot", name=replace_forbidden(file.stem)), notes=notes
        )
        self._names: dict[tuple[str, int], str] = {}
        counts = {"body": model.nbody, "joint": model.njnt}
        self._given = {
            self._get_plain_name(kind, k) for kind in counts for k in range(counts[kind])
        }
        self._added: set[str] = set()  # names of links and joints that the MJCF file lacks
        self._meshes: dict[int, Path] = {}
        self._stems: list[str] = []  # of files of meshes

    def convert(self) -> ConvertedRobot:
        """Return the largest joint tree as a URDF."""
        model = self._model
        bodies = range(1, model.nbody)
        sizes: dict[int, int] = {}
        for body in bodies:
            root = int(model.body_rootid[body])
            sizes[root] = sizes.get(root, 0) + int(model.body_jntnum[body])
        if not sizes or max(sizes.values()) == 0:
            raise InputError(
                "the file has no joints", file=self._file, expected="a body with joints"
            )
        chosen = max(sizes, key=lambda root: sizes[root])
        if others := [self._get_name("body", root) for root in sizes if root != chosen]:
            listed = ", ".join(others[:8]) + (", ..." if len(others) > 8 else "")
            self._result.notes.append(f"left out other bodies in the world: {listed}")
        for body in bodies:
            if model.body_rootid[body] == chosen:
                self._convert_body(body, root=body == chosen)
        self._convert_couplings()
        scalar = set(self._find_scalar_joints())
        for states in solve_linkages(self._mujoco, model):
            if states[0].keys() <= scalar:
                named = [{self._get_name("joint", j): state[j] for j in state} for state in states]
                self._result.linkages.append(named)
        for key in range(model.nkey):
            self._result.states[self._get_name("key", key)] = {
                self._get_name("joint", j): float(
                    model.key_qpos[key, address] - model.qpos0[address]
                )
                for j in self._find_scalar_joints()
                if (address := model.jnt_qposadr[j]) >= 0
            }
        return self._result

    def _get_name(self, kind: str, index: int) -> str:
        """Return a unique URDF name of a body, joint, shape or mesh."""
        if (kind, index) not in self._names:
            plain = name = self._get_plain_name(kind, index)
            number = 1
            while name in self._names.values() or name in self._added:
                name = f"{plain}_{kind}" if number == 1 else f"{plain}_{kind}_{number}"
                number += 1
            self._names[kind, index] = name
        return self._names[kind, index]

    def _get_plain_name(self, kind: str, index: int) -> str:
        """Return the name in the file, with "_" for characters that frame names cannot have."""
        code = getattr(self._mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        given = self._mujoco.mj_id2name(self._model, code, index) or f"{kind}_{index}"
        return "".join(letter if letter.isalnum() or letter in "_-" else "_" for letter in given)

    def _add_name(self, name: str) -> str:
        """Return a name for a link or joint that the MJCF file lacks, numbered if it is taken."""
        new, number = name, 1
        while new in self._given or new in self._added or new in self._names.values():
            number += 1
            new = f"{name}_{number}"
        self._added.add(new)
        return new

    def _find_scalar_joints(self) -> list[int]:
        """Return the revolute and prismatic joints of the robot."""
        named = {joint.get("name") for joint in self._result.root.findall("joint")}
        return [j for j in range(self._model.njnt) if self._get_name("joint", j) in named]

    def _convert_body(self, body: int, *, root: bool) -> None:
        model, kinds, name = self._model, self._mujoco.mjtJoint, self._get_name("body", body)
        placement = pin.SE3(_to_rotation(model.body_quat[body]), model.body_pos[body].copy())
        parent = int(model.body_parentid[body])
        above = self._add_name(f"{name}_root") if root else self._get_name("body", parent)
        if root:
            ElementTree.SubElement(self._result.root, "link", name=above)
        for joint in range(
            int(model.body_jntadr[body]), int(model.body_jntadr[body] + model.body_jntnum[body])
        ):
            kind = int(model.jnt_type[joint])
            if kind not in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
                if not root:
                    name = self._get_name("joint", joint)
                    self._result.notes.append(f"joint {name} is locked: a URDF has no such joint")
                elif kind == kinds.mjJNT_FREE:
                    placement = pin.SE3.Identity()  # a mobile robot, independent of its pose
                continue
            anchor = pin.SE3(np.eye(3), model.jnt_pos[joint].copy())
            below = self._add_name(f"{self._get_name('joint', joint)}_link")
            ElementTree.SubElement(self._result.root, "link", name=below)
            self._convert_joint(joint, above, below, placement * anchor)
            above, placement = below, anchor.inverse()
        link = ElementTree.SubElement(self._result.root, "link", name=name)
        added = self._add_name(f"{name}_fixed")
        add_connection(self._result.root, added, "fixed", above, name, placement)
        self._convert_inertia(link, body)
        self._convert_shapes(link, body)

    def _convert_joint(self, joint: int, above: str, below: str, placement: pin.SE3) -> None:
        model, name = self._model, self._get_name("joint", joint)
        turns = model.jnt_type[joint] == self._mujoco.mjtJoint.mjJNT_HINGE
        limited = bool(model.jnt_limited[joint])
        kind = ("revolute" if limited else "continuous") if turns else "prismatic"
        element = add_connection(self._result.root, name, kind, above, below, placement)
        ElementTree.SubElement(element, "axis", xyz=format_numbers(model.jnt_axis[joint]))
        low, high = model.jnt_range[joint] - model.qpos0[model.jnt_qposadr[joint]]
        if not limited and not turns:
            low, high = -_FAR, _FAR
        limit = {"lower": f"{low:.9g}", "upper": f"{high:.9g}"} if kind != "continuous" else {}
        effort = {"effort": f"{value:.9g}"} if (value := self._find_effort(joint)) > 0.0 else {}
        ElementTree.SubElement(element, "limit", {**limit, **effort})

    def _find_effort(self, joint: int) -> float:
        """Return the effort limit of a joint [N] or [N·m]; 0 if none is stated."""
        model = self._model
        if model.jnt_actfrclimited[joint]:
            return float(np.abs(model.jnt_actfrcrange[joint]).max())
        by_joint = model.actuator_trntype == int(self._mujoco.mjtTrn.mjTRN_JOINT)
        for actuator in np.flatnonzero(by_joint & (model.actuator_trnid[:, 0] == joint)):
            if model.actuator_forcelimited[actuator]:
                return float(
                    np.abs(model.actuator_forcerange[actuator]).max()
                    * abs(model.actuator_gear[actuator, 0])
                )
        return 0.0

    def _convert_inertia(self, link: ElementTree.Element, body: int) -> None:
        model = self._model
        if model.body_mass[body] <= NO_MASS:
            return
        inertial = ElementTree.SubElement(link, "inertial")
        add_origin(
            inertial, pin.SE3(_to_rotation(model.body_iquat[body]), model.body_ipos[body].copy())
        )
        ElementTree.SubElement(inertial, "mass", value=f"{model.body_mass[body]:.9g}")
        ixx, iyy, izz = (f"{moment:.9g}" for moment in model.body_inertia[body])
        moments = {"ixx": ixx, "iyy": iyy, "izz": izz, "ixy": "0", "ixz": "0", "iyz": "0"}
        ElementTree.SubElement(inertial, "inertia", moments)

    def _convert_shapes(self, link: ElementTree.Element, body: int) -> None:
        model = self._model
        geoms = range(
            int(model.body_geomadr[body]), int(model.body_geomadr[body] + model.body_geomnum[body])
        )
        collision = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        visual = [g for g in geoms if g not in collision] or collision
        for kind, chosen in (("visual", visual), ("collision", collision)):
            for geom in chosen:
                self._convert_shape(link, kind, geom)

    def _convert_shape(self, link: ElementTree.Element, kind: str, geom: int) -> None:
        import trimesh

        model, types = self._model, self._mujoco.mjtGeom
        size, shape = model.geom_size[geom], int(model.geom_type[geom])
        radius = {"radius": f"{size[0]:.9g}"}
        long = {**radius, "length": f"{2.0 * size[1]:.9g}"}
        shapes: dict[int, tuple[str, dict[str, str]]] = {
            int(types.mjGEOM_SPHERE): ("sphere", radius),
            int(types.mjGEOM_CAPSULE): ("capsule", long),
            int(types.mjGEOM_CYLINDER): ("cylinder", long),
            int(types.mjGEOM_BOX): ("box", {"size": format_numbers(2.0 * size)}),
        }
        if shape == types.mjGEOM_MESH:
            data = int(model.geom_dataid[geom])
            if data not in self._meshes:
                vertices = model.mesh_vert[model.mesh_vertadr[data] :][: model.mesh_vertnum[data]]
                faces = model.mesh_face[model.mesh_faceadr[data] :][: model.mesh_facenum[data]]
                self._meshes[data] = self._write_mesh(
                    self._get_name("mesh", data), trimesh.Trimesh(vertices, faces, process=False)
                )
            shapes[shape] = ("mesh", {"filename": str(self._meshes[data])})
        elif shape == types.mjGEOM_ELLIPSOID:
            ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
            file = self._write_mesh(
                self._get_name("geom", geom), ball.apply_transform(np.diag([*size, 1.0]))
            )
            shapes[shape] = ("mesh", {"filename": str(file)})
        if shape not in shapes:
            self._result.notes.append(
                f"left out a shape of {link.get('name')}: neither a solid nor a mesh"
            )
            return
        element = ElementTree.SubElement(link, kind)
        add_origin(
            element, pin.SE3(_to_rotation(model.geom_quat[geom]), model.geom_pos[geom].copy())
        )
        tag, attributes = shapes[shape]
        ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), tag, attributes)
        if kind == "visual":
            material = int(model.geom_matid[geom])
            colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
            named = ElementTree.SubElement(element, "material", name=f"{link.get('name')}_{geom}")
            ElementTree.SubElement(named, "color", rgba=format_numbers(colour))

    def _write_mesh(self, name: str, mesh: Any) -> Path:
        self._stems += choose_file_names([name], taken=self._stems)
        file = self._folder / f"{self._stems[-1]}.stl"
        self._folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(mesh.export(file_type="stl"))
        return file

    def _convert_couplings(self) -> None:
        """Write couplings of two joints as <mimic>."""
        model = self._model
        joints = {joint.get("name", ""): joint for joint in self._result.root.findall("joint")}
        leads: dict[str, str] = {}
        for k in np.flatnonzero(
            (model.eq_type == int(self._mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_active0 > 0)
        ):
            names = [
                self._get_name("joint", int(ids[k]))
                for ids in (model.eq_obj1id, model.eq_obj2id)
                if ids[k] >= 0
            ]
            if len(names) < 2 or not joints.keys() >= {*names}:
                continue
            joint, leader = names
            offset, factor = (float(value) for value in model.eq_data[k, :2])
            if model.eq_data[k, 2:5].any():
                self._result.notes.append(
                    f"joint {joint} follows {leader} by a nonlinear function: it is linearized"
                )
            if joint in leads and leader not in leads and factor:
                joint, leader = (leader, joint)
                offset, factor = (-offset / factor, 1.0 / factor)
            follower = leader
            while follower in leads:
                follower = leads[follower]
            if joint in leads or follower == joint:
                self._result.notes.append(
                    f"joint {joint} follows {leads.get(joint, leader)}; "
                    "another coupling of it is left out"
                )
                continue
            leads[joint] = leader
            ElementTree.SubElement(
                joints[joint],
                "mimic",
                joint=leader,
                multiplier=f"{factor:.9g}",
                offset=f"{offset:.9g}",
            )


def _to_rotation(quaternion: Floats) -> Floats:
    """Return the rotation matrix, shape (3, 3), of a quaternion w, x, y, z."""
    return np.array(pin.Quaternion(*(float(part) for part in quaternion)).normalized().matrix())
