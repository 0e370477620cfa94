"""Reads USD files with the physics schemas (https://openusd.org, UsdPhysics), by usd-core."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import (
    MOVING_KINDS,
    SOLIDS,
    Coupling,
    Description,
    Joint,
    Limits,
    Link,
    Loop,
    Part,
    make_limits,
)
from vkc_pin.importing.formats.usd_stage import (
    JOINT_AXES,
    UsdBody,
    UsdEnd,
    UsdJoint,
    UsdMesh,
    UsdShape,
    UsdStage,
    load_usd_stage,
)
from vkc_pin.utils.arrays import MAX_COORDINATE, MIN_POSITIVE, Floats, Ints
from vkc_pin.world.files.hulls import compute_hull, thicken
from vkc_pin.world.files.polygons import triangulate_polygons

if TYPE_CHECKING:
    import trimesh

WORLD = ""
"""Key of the world among the paths of bodies."""
_STATE = "stage"
"""Name of the joint positions at which the bodies are in the file."""
_DENSITY = 1000.0  # [kg/m³] of a collider that states none, as UsdPhysics specifies
_SIDES = 48  # facets of cones, and of solids whose scale makes them none
_LISTED = 8  # names in a note
# Relative difference of scales, and cosine between axes, that count as none: rounding of the single
# precision in which files have them
_SAME = 1e-5
# Distance [m] and angle [rad] between a body and its joint from which they are noted: up to 1 mm,
# linkages count as closed
_GAP = 1e-3
_UP = {"Z": np.eye(3), "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}
_AXES = {"X": np.eye(3)[0], "Y": np.eye(3)[1], "Z": np.eye(3)[2]}
# Rotations of the z axis onto the axis of a shape
_ALONG = {"X": np.eye(3)[:, [1, 2, 0]], "Y": np.eye(3)[:, [2, 0, 1]], "Z": np.eye(3)}
_APPROXIMATIONS = (
    "none",
    "boundingCube",
    "boundingSphere",
    "convexDecomposition",
    "convexHull",
    "meshSimplification",
)


def read_usd_description(file: Path, packages: Mapping[str, Path]) -> Description:
    """Read the description of a robot, an object or a home from a USD file.

    Lengths are in metres, and z points up, whatever the file's units and axes are. Everything
    static is one link, `world`. Bodies that no joint connects to it stay in their places if they
    have joints, and are free otherwise, on floating joints. A link's frame is that of its body,
    without scale, moved to the origin of its hinge or slide.

    Args:
        file: The file.
        packages: Folders in which layers may be, beside that of the file.
    """
    return _Reader(file, load_usd_stage(file, packages)).read()


@dataclasses.dataclass(frozen=True, eq=False)
class _Edge:
    """A joint between two bodies.

    Attributes:
        joint: The joint of the file.
        kind: "fixed", "revolute", "prismatic", or another one of `UsdJoint`.
        axis: Unit axis in the joint's frame, shape (3,).
        dof: Name of the axis in the joint's limits and drives.
        bodies: Both bodies, by their paths.
        anchors: The joint's frame in the frame of each body [m].
    """

    joint: UsdJoint
    kind: str
    axis: Floats
    dof: str
    bodies: tuple[str, str]
    anchors: tuple[pin.SE3, pin.SE3]

    def get_other(self, body: str) -> str:
        """Return the body on the other side."""
        first, second = self.bodies
        return second if body == first else first


class _Forest:
    """Trees of bodies, which joints connect."""

    def __init__(self) -> None:
        self._edges = dict[str, list[_Edge]]()  # by body

    def add(self, edge: _Edge) -> None:
        for body in edge.bodies:
            self._edges.setdefault(body, []).append(edge)

    def list_edges(self, body: str) -> list[_Edge]:
        """Return the joints of a body, in the order of the file."""
        return self._edges.get(body, [])

    def find_path(self, start: str, end: str) -> list[_Edge] | None:
        """Return the joints from one body to another; None if none connect them."""
        paths: dict[str, list[_Edge]] = {start: []}
        ahead = [start]
        for body in ahead:
            if body == end:
                return paths[body]
            for edge in self.list_edges(body):
                other = edge.get_other(body)
                if other not in paths:
                    paths[other] = [*paths[body], edge]
                    ahead.append(other)
        return None

    def collect(self, body: str) -> list[str]:
        """Return the bodies that joints connect with one, itself first."""
        found = {body: None}
        ahead = [body]
        for each in ahead:
            for edge in self.list_edges(each):
                other = edge.get_other(each)
                if other not in found:
                    found[other] = None
                    ahead.append(other)
        return list(found)


class _Reader:
    def __init__(self, file: Path, stage: UsdStage) -> None:
        self._file = file
        self._stage = stage
        self._notes = list(stage.notes)
        # From the stage's frame and unit to metres with z up
        self._metric = np.eye(4)
        self._metric[:3, :3] = stage.metres * _UP[stage.up]
        self._bodies = {body.path: body for body in stage.bodies}
        self._places = {WORLD: pin.SE3.Identity()}  # of bodies
        for body in stage.bodies:
            matrix = self._metric @ body.matrix
            self._check_lengths(body.path, matrix[:3, 3])
            self._places[body.path] = _extract_placement(matrix)
        self._frames = dict(self._places)  # of links, which may be moved to their joints
        self._names = _choose_names(self._bodies)
        world = "world"
        while world in self._names.values():
            world += "_"
        self._names[WORLD] = world
        self._joint_names = _choose_names(joint.path for joint in stage.joints)
        self._joints = dict[str, Joint]()  # by child body
        self._edges = dict[str, _Edge]()  # by child body
        self._positions = dict[str, float]()  # at which bodies are in the file, by child body
        self._zeros = dict[str, float]()  # what counts as zero, by child body
        self._meshes: dict[tuple[int, bytes], trimesh.Trimesh] = {}

    def _check_lengths(self, path: str, lengths: Any) -> None:
        """Check that a prim is neither too large nor too far away, [m]."""
        largest = float(np.abs(lengths).max(initial=0.0))
        if not largest <= MAX_COORDINATE:
            raise InputError(
                "too large or too far away",
                file=self._file,
                field=path,
                expected=f"at most {MAX_COORDINATE:g} m (metersPerUnit is {self._stage.metres:g})",
                got=f"{largest:.4g} m",
            )

    def read(self) -> Description:
        """Return the description; see `read_usd_description`."""
        forest, cut = self._connect_bodies()
        roots = self._hold_roots(forest)
        self._orient(forest, roots)
        self._set_zeros(forest, cut)
        for body in self._edges:
            self._joints[body] = self._read_joint(body)
        loops = [loop for edge in cut for loop in self._read_loop(edge)]
        couplings = self._read_couplings()
        links = self._read_links()
        joints = {joint.child: joint for joint in self._joints.values()}
        return Description(
            self._file,
            links,
            joints,
            notes=tuple(self._notes),
            format="USD",
            couplings=tuple(couplings),
            loops=tuple(loops),
            states=self._read_state(),
            is_world=True,
        )

    # The tree

    def _connect_bodies(self) -> tuple[_Forest, list[_Edge]]:
        """Return the trees of bodies, and the joints that close loops beside them.

        Raises:
            InputError: Joints close a loop, and none of them is excluded from the tree.
        """
        forest = _Forest()
        cut = list[_Edge]()
        edges = [edge for joint in self._stage.joints for edge in self._make_edge(joint)]
        # Joints that are excluded are in the tree only if nothing else connects their bodies.
        for edge in sorted(edges, key=lambda edge: edge.joint.is_excluded):
            path = forest.find_path(*edge.bodies)
            if path is None:
                forest.add(edge)
            elif edge.joint.is_excluded:
                cut.append(edge)
            else:
                loop = ", ".join(each.joint.path for each in [*path, edge])
                raise InputError(
                    "joints close a loop",
                    file=self._file,
                    field=edge.joint.path,
                    expected="physics:excludeFromArticulation at one of them, which is cut",
                    got=loop,
                )
        return forest, cut

    def _make_edge(self, joint: UsdJoint) -> list[_Edge]:
        """Return a joint as an edge; nothing, with a note, if it does not hold its bodies."""
        kind, axis, dof = self._find_kind(joint)
        bodies = (joint.ends[0].body or WORLD, joint.ends[1].body or WORLD)
        if kind in ("distance", "free"):
            holds = "limits a distance only" if kind == "distance" else "leaves all axes free"
            self._notes.append(f"joint {joint.path} {holds}: left out")
            return []
        first, second = (self._place_anchor(end) for end in joint.ends)
        self._check_lengths(joint.path, [first.translation, second.translation])
        anchors = (
            self._places[bodies[0]].actInv(first),
            self._places[bodies[1]].actInv(second),
        )
        return [_Edge(joint, kind, axis, dof, bodies, anchors)]

    def _find_kind(self, joint: UsdJoint) -> tuple[str, Floats, str]:
        """Return the kind of a joint, its axis in its frame, and that axis' name in its limits.

        A generic joint is fixed, a hinge or a slide if all axes, or all but one, are locked: a
        lower limit above the upper one locks an axis, and so do two limits of 0.
        """
        if joint.kind in ("revolute", "prismatic"):
            low, high = joint.limits[""]
            if low > high:
                about = f"joint {joint.path} has a lower limit above its upper limit"
                self._notes.append(f"{about}, {low:g} and {high:g}: locked")
                return "fixed", _AXES["X"], ""
            return joint.kind, _AXES[joint.axis], ""
        if joint.kind != "generic":
            return joint.kind, _AXES["X"], ""
        if "distance" in joint.limits:
            self._notes.append(f"joint {joint.path}: the limit of its distance is left out")
        free = list[str]()
        for name in JOINT_AXES:
            low, high = joint.limits.get(name, (-math.inf, math.inf))
            if not (low > high or low == high == 0.0):
                free.append(name)
        if not free:
            return "fixed", _AXES["X"], ""
        if len(free) == len(JOINT_AXES) and not joint.limits:
            return "free", _AXES["X"], ""
        if len(free) > 1:
            return f"free about {', '.join(free)}", _AXES["X"], ""
        (name,) = free
        kind = "revolute" if name.startswith("rot") else "prismatic"
        return kind, _AXES[name[-1]], name

    def _place_anchor(self, end: UsdEnd) -> pin.SE3:
        """Return the frame of a joint on one side in the world.

        The scale of the prim that it names multiplies its position.
        """
        matrix = self._metric @ end.matrix
        origin = matrix[:3, :3] @ end.position + matrix[:3, 3]
        rotation = _extract_placement(matrix).rotation @ _convert_quaternion(end.rotation)
        return pin.SE3(rotation, origin)

    def _hold_roots(self, forest: _Forest) -> dict[str, str]:
        """Return how the root of each tree that no joint connects with the world is held there.

        Values are "fixed" and "floating".
        """
        held = dict[str, str]()
        reached = set(forest.collect(WORLD))
        in_place = list[str]()
        for body in self._stage.bodies:
            if body.path in reached:
                continue
            tree = forest.collect(body.path)
            reached.update(tree)
            root = self._choose_root(forest, tree)
            has_joints = False
            for each in tree:
                kinds = [edge.kind for edge in forest.list_edges(each)]
                has_joints = has_joints or any(kind in MOVING_KINDS for kind in kinds)
            is_kinematic = self._bodies[root].is_kinematic
            if has_joints and not is_kinematic:
                in_place.append(root)
            held[root] = "fixed" if has_joints or is_kinematic else "floating"
        if in_place:
            listed = self._list_names(in_place)
            about = "joined to nothing static, but with joints, hence fixed in place"
            self._notes.append(f"{about}: {listed}")
        return held

    def _choose_root(self, forest: _Forest, tree: Sequence[str]) -> str:
        """Return the body of a tree that carries the others.

        It is a kinematic one, else the root of an articulation, else one that is `body1` of no
        joint, else the first of the file.
        """
        order = [body.path for body in self._stage.bodies if body.path in set(tree)]
        kinematic = [body for body in order if self._bodies[body].is_kinematic]
        stated = [body for body in order if body in self._stage.roots]
        carrying = list[str]()
        for body in order:
            edges = forest.list_edges(body)
            if all(edge.bodies[0] == body for edge in edges):
                carrying.append(body)
        return [*kinematic, *stated, *carrying, *order][0]

    def _orient(self, forest: _Forest, roots: Mapping[str, str]) -> None:
        """Find the joint of each body, from the roots on, and move frames to hinges and slides."""
        ahead = [WORLD]
        for root, kind in roots.items():
            ahead.append(root)
            self._joints[root] = Joint(
                name=f"{self._names[root]}_{kind}",
                kind=kind,
                parent=self._names[WORLD],
                child=self._names[root],
                placement=self._places[root],
            )
        done = set(ahead)
        for body in ahead:
            for edge in forest.list_edges(body):
                child = edge.get_other(body)
                if child in done:
                    continue
                done.add(child)
                ahead.append(child)
                self._edges[child] = edge
                if edge.kind in MOVING_KINDS:
                    if self._bodies[child].is_kinematic:
                        about = f"body {child} is kinematic"
                        self._notes.append(f"{about}, but moves with joint {edge.joint.path}")
                    origin = self._places[child].act(self._find_anchors(child)[1].translation)
                    self._frames[child] = pin.SE3(self._places[child].rotation, origin)
                self._measure_position(child)

    def _find_parent(self, child: str) -> str:
        return self._edges[child].get_other(child)

    def _find_anchors(self, child: str) -> tuple[pin.SE3, pin.SE3]:
        """Return the frame of a body's joint in the frames of the parent's and of its own body."""
        edge = self._edges[child]
        first, second = edge.anchors
        return (second, first) if edge.bodies[0] == child else (first, second)

    def _find_axis(self, child: str) -> Floats:
        """Return the axis of a body's joint in the joint's frame.

        With the poses X_0 and X_1 of the bodies, the joint's frames A_0 and A_1 in them and its
        motion J(q), X_1 = X_0 A_0 J(q) A_1⁻¹, hence X_0 = X_1 A_1 J(−q) A_0⁻¹: seen from `body1`,
        the axis is reversed.
        """
        edge = self._edges[child]
        return -edge.axis if edge.bodies[0] == child else edge.axis

    def _measure_position(self, child: str) -> None:
        """Note where a body is on its joint in the file, and by how much it is beside it."""
        edge = self._edges[child]
        outer, inner = self._find_anchors(child)
        parent = self._find_parent(child)
        moved = (self._places[parent] * outer).actInv(self._places[child] * inner)
        axis = self._find_axis(child)
        value = 0.0
        if edge.kind == "prismatic":
            value = float(moved.translation @ axis)
        elif edge.kind == "revolute":
            value = self._unwind(edge, float(pin.log3(moved.rotation) @ axis))
        elif edge.kind != "fixed" or parent == WORLD:
            return
        motion = Joint(
            name="", kind=edge.kind, parent="", child="", placement=moved, axis=axis
        ).compute_motion(value)
        beside = motion.actInv(moved)
        distance = float(np.linalg.norm(beside.translation))
        angle = float(np.linalg.norm(pin.log3(beside.rotation)))
        if max(distance, angle) > _GAP:
            by = f"{1e3 * distance:.0f} mm and {math.degrees(angle):.1f}°"
            self._notes.append(f"body {child} is {by} beside its joint {edge.joint.path}: moved")
        if edge.kind in MOVING_KINDS:
            self._positions[child] = value

    def _unwind(self, edge: _Edge, angle: float) -> float:
        """Return the angle between the limits of a hinge that is equal up to whole turns [rad]."""
        low, high = self._convert_limits(edge)
        for turned in (angle, angle + 2.0 * math.pi, angle - 2.0 * math.pi):
            if low - _GAP <= turned <= high + _GAP:
                return turned
        return angle

    def _set_zeros(self, forest: _Forest, cut: Iterable[_Edge]) -> None:
        """Let the joints of loops be at zero where they are in the file, and loops be closed."""
        moving = dict[str, str]()  # bodies by the paths of their joints
        for child, edge in self._edges.items():
            moving[edge.joint.path] = child
        for edge in cut:
            for each in forest.find_path(*edge.bodies) or ():
                child = moving.get(each.joint.path, WORLD)
                value = self._positions.get(child, 0.0)
                if abs(value) > _GAP and child not in self._zeros:
                    self._zeros[child] = value
                    self._positions[child] = 0.0
                    name = self._joint_names[each.joint.path]
                    about = "belongs to a loop and is at zero in the file"
                    self._notes.append(f"joint '{name}' {about}: values are less by {value:.4g}")

    def _list_names(self, bodies: Sequence[str]) -> str:
        more = ", ..." if len(bodies) > _LISTED else ""
        return ", ".join(self._names[body] for body in bodies[:_LISTED]) + more

    # Joints

    def _read_joint(self, child: str) -> Joint:
        edge = self._edges[child]
        parent = self._find_parent(child)
        name = self._joint_names[edge.joint.path]
        ends: dict[str, Any] = {
            "name": name,
            "parent": self._names[parent],
            "child": self._names[child],
        }
        in_file = self._frames[parent].actInv(self._frames[child])
        if edge.kind not in ("fixed", *MOVING_KINDS):
            self._notes.append(f"joint {edge.joint.path} is {edge.kind}: taken as fixed")
            return Joint(kind="fixed", placement=in_file, **ends)
        # An asset that is referenced elsewhere moves its bodies, but no frame in the world.
        if edge.kind == "fixed" and parent == WORLD:
            return Joint(kind="fixed", placement=in_file, **ends)
        outer, inner = self._find_anchors(child)
        axis = self._find_axis(child)
        frame_in_body = self._places[child].actInv(self._frames[child])
        joint = Joint(
            kind=edge.kind,
            placement=self._frames[parent].actInv(self._places[parent] * outer),
            axis=axis,
            **ends,
        )
        zero = self._zeros.get(child, 0.0)
        placement = joint.placement * joint.compute_motion(zero) * inner.actInv(frame_in_body)
        if edge.kind == "fixed":
            return dataclasses.replace(joint, placement=placement)
        low, high = self._convert_limits(edge)
        velocity = edge.joint.max_velocity
        return dataclasses.replace(
            joint,
            placement=placement,
            axis=frame_in_body.rotation.T @ inner.rotation @ axis,
            limits=make_limits(low - zero, high - zero),
            velocity=_keep_rate(None if velocity is None else velocity * self._get_unit(edge)),
            effort=self._find_effort(edge),
            is_driven=self._find_drive(edge) is not None,
        )

    def _get_unit(self, edge: _Edge) -> float:
        """Return the unit of a joint's position: of degrees [rad], or of lengths [m]."""
        return math.radians(1.0) if edge.kind == "revolute" else self._stage.metres

    def _convert_limits(self, edge: _Edge) -> Limits:
        """Return the limits of a hinge or a slide, [rad] or [m]; infinite where there are none."""
        low, high = edge.joint.limits.get(edge.dof, (-math.inf, math.inf))
        unit = self._get_unit(edge)
        return low * unit, high * unit

    def _find_drive(self, edge: _Edge) -> float | None:
        """Return the largest force or torque of a joint's drive; None if it has no drive."""
        if edge.dof:
            return edge.joint.max_forces.get(edge.dof)
        return edge.joint.max_forces.get("angular" if edge.kind == "revolute" else "linear")

    def _find_effort(self, edge: _Edge) -> float | None:
        """Return the effort limit of a joint's drive, [N·m] or [N]."""
        force = self._find_drive(edge)
        if force is None:
            return None
        # Forces are in mass · length / s², torques in mass · length² / s².
        unit = self._stage.kilograms * self._stage.metres
        if edge.kind == "revolute":
            unit *= self._stage.metres
        return _keep_rate(force * unit)

    def _read_loop(self, edge: _Edge) -> list[Loop]:
        """Return the connection that a cut joint makes; a slide makes none, with a note."""
        path = edge.joint.path
        first, second = edge.bodies
        names = (self._names[first], self._names[second])
        element = f"{path}, excluded from the articulation"
        if edge.kind == "fixed":
            self._notes.append(f"joint {path} closes a loop: cut, '{names[0]}' is welded")
            return [Loop("welded", names, None, element)]
        if edge.kind not in ("revolute", "spherical"):
            self._notes.append(f"joint {path} closes a loop and is {edge.kind}: left out")
            return []
        self._notes.append(f"joint {path} closes a loop: cut, its bodies meet at a point")
        points = list[Floats]()
        for body, anchor in zip(edge.bodies, edge.anchors, strict=True):
            in_world = self._places[body].act(anchor.translation)
            points.append(self._frames[body].actInv(in_world))
        return [Loop("connected", names, (points[0], points[1]), element)]

    def _read_couplings(self) -> list[Coupling]:
        couplings = list[Coupling]()
        children = {edge.joint.path: child for child, edge in self._edges.items()}
        for joint in self._stage.joints:
            mimic = joint.mimic
            if mimic is None:
                continue
            child = children.get(joint.path, WORLD)
            leader = children.get(mimic.leader, WORLD)
            moving = [each for each in (child, leader) if each in self._positions]
            if len(moving) < 2:
                about = f"joint {joint.path} follows {mimic.leader} ({mimic.element})"
                self._notes.append(f"{about}: left out, one of them does not move")
                continue
            # y = a + b x in the file's units, and y' = u_y y − y_0, x' = u_x x − x_0 here
            unit = self._get_unit(self._edges[child])
            factor = mimic.factor * unit / self._get_unit(self._edges[leader])
            offset = mimic.offset * unit
            offset += factor * self._zeros.get(leader, 0.0) - self._zeros.get(child, 0.0)
            names = (self._joints[child].name, self._joints[leader].name)
            couplings.append(Coupling(*names, (offset, factor), mimic.element))
        return couplings

    def _read_state(self) -> dict[str, dict[str, float]]:
        """Return the joint positions of the file as a state, if they are not zero."""
        state = {self._joints[child].name: value for child, value in self._positions.items()}
        is_zero = all(abs(value) <= _GAP for value in state.values())
        return {} if is_zero else {_STATE: state}

    # Links

    def _read_links(self) -> dict[str, Link]:
        shapes = dict[str, list[UsdShape]]()
        for shape in self._stage.shapes:
            shapes.setdefault(shape.body or WORLD, []).append(shape)
        computed = list[str]()
        links = dict[str, Link]()
        for body in (WORLD, *self._bodies):
            name = self._names[body]
            visual = list[Part]()
            collision = list[Part]()
            colliders = list[UsdShape]()
            for shape in shapes.get(body, ()):
                if shape.is_visual:
                    visual.append(self._read_shape(shape, body))
                if shape.collides:
                    collision.append(self._read_collision(shape, body))
                    colliders.append(shape)
            inertia = pin.Inertia.Zero()
            if body != WORLD:
                inertia, is_stated = self._read_inertia(
                    self._bodies[body], colliders, collision, visual
                )
                if not is_stated:
                    computed.append(body)
            links[name] = Link(name, tuple(visual or collision), tuple(collision), inertia)
        if computed:
            about = f"bodies state neither mass nor density: {_DENSITY:g} kg/m³, as USD specifies"
            self._notes.append(f"{about}: {self._list_names(computed)}")
        return links

    def _read_collision(self, shape: UsdShape, body: str) -> Part:
        """Return a shape as it collides; meshes by their approximation."""
        if shape.mesh is None or shape.approximation in (
            "none",
            "convexDecomposition",
            "meshSimplification",
        ):
            return self._read_shape(shape, body)
        if shape.approximation not in _APPROXIMATIONS:
            about = f"shape {shape.path} collides as {shape.approximation!r}"
            self._notes.append(f"{about}, which is unknown: its triangles collide")
            return self._read_shape(shape, body)
        points = shape.mesh.points[np.unique(shape.mesh.corners)]
        low = points.min(axis=0)
        high = points.max(axis=0)
        matrix = self._find_matrix(shape, body)
        is_flat = not (high > low).all()
        if shape.approximation == "boundingCube" and not is_flat:
            moved = matrix @ _make_matrix(np.eye(3), 0.5 * (low + high))
            return self._make_solid(shape, moved, "cube", tuple(high - low))
        vertices = points @ matrix[:3, :3].T + matrix[:3, 3]
        if shape.approximation == "boundingSphere":
            centre = matrix[:3, :3] @ (0.5 * (low + high)) + matrix[:3, 3]
            radius = float(np.linalg.norm(vertices - centre, axis=1).max())
            return Part(
                name=_get_leaf(shape.path),
                placement=pin.SE3(np.eye(3), centre),
                kind="sphere",
                size=(radius,),
                colour=shape.colour,
            )
        hull = compute_hull(thicken(vertices)[0])
        return Part.from_triangles(_get_leaf(shape.path), hull, shape.colour)

    def _read_shape(self, shape: UsdShape, body: str) -> Part:
        """Return a shape in the frame of its link, with all scales in its size."""
        matrix = self._find_matrix(shape, body)
        if shape.mesh is not None:
            triangles = self._transform_mesh(shape.mesh, matrix)
            self._check_lengths(shape.path, triangles.vertices)
            return Part.from_triangles(_get_leaf(shape.path), triangles, shape.colour)
        return self._make_solid(shape, matrix, shape.kind, shape.size)

    def _find_matrix(self, shape: UsdShape, body: str) -> Floats:
        """Return the frame of a shape in that of its link, shape (4, 4), z along its axis [m]."""
        along = _make_matrix(_ALONG[shape.axis], np.zeros(3))
        in_world = self._metric @ shape.matrix @ along
        return np.asarray(self._frames[body].inverse().homogeneous @ in_world)

    def _make_solid(
        self, shape: UsdShape, matrix: Floats, kind: str, size: tuple[float, ...]
    ) -> Part:
        """Return a primitive in a frame that may be scaled; a mesh if the scale makes it none."""
        name = _get_leaf(shape.path)
        axes = matrix[:3, :3]
        scales = np.linalg.norm(axes, axis=0)
        rotation = axes / scales
        # All primitives are symmetric about their plane x = 0.
        if np.linalg.det(rotation) < 0.0:
            rotation = rotation * np.array([-1.0, 1.0, 1.0])
        is_square = np.abs(rotation.T @ rotation - np.eye(3)).max() <= _SAME
        solid = _scale_solid(kind, size, scales) if is_square else None
        if solid is None:
            mesh = _make_surface(kind, size).apply_transform(matrix)
            self._check_lengths(shape.path, mesh.vertices)
            return Part.from_triangles(name, mesh, shape.colour)
        kind, size = solid
        self._check_lengths(shape.path, [*size, *matrix[:3, 3]])
        placement = _extract_placement(_make_matrix(rotation, matrix[:3, 3]))
        return Part(name=name, placement=placement, kind=kind, size=size, colour=shape.colour)

    def _transform_mesh(self, mesh: UsdMesh, matrix: Floats) -> trimesh.Trimesh:
        """Return a mesh in the frame of a link [m]; equal ones are one object."""
        import trimesh

        key = (id(mesh), matrix.tobytes())
        if key not in self._meshes:
            faces = _triangulate(mesh)
            is_mirrored = np.linalg.det(matrix[:3, :3]) < 0.0
            if is_mirrored != mesh.is_left_handed:
                faces = faces[:, ::-1]
            vertices = mesh.points @ matrix[:3, :3].T + matrix[:3, 3]
            self._meshes[key] = trimesh.Trimesh(vertices, faces)
        return self._meshes[key]

    # Masses

    def _read_inertia(
        self,
        body: UsdBody,
        colliders: Sequence[UsdShape],
        parts: Sequence[Part],
        visual: Sequence[Part],
    ) -> tuple[pin.Inertia, bool]:
        """Return the inertia of a body in its link's frame, and whether its mass is stated.

        A body's mass has precedence over those of its colliders, a collider's density over the
        body's, and that over its material's. Centre and moments that are not stated are those of
        the colliders as solids, scaled to the mass.
        """
        total = pin.Inertia.Zero()
        is_stated = body.mass.mass is not None
        for collider, part in zip(colliders, parts, strict=True):
            density = self._find_density(body, collider)
            stated = density is not None or collider.mass.mass is not None
            is_stated = is_stated or stated
            solid = _compute_inertia(part, _DENSITY if density is None else density)
            if collider.mass.mass is not None:
                solid = _scale_mass(solid, collider.mass.mass * self._stage.kilograms)
            total += solid
        mass = total.mass
        if body.mass.mass is not None:
            mass = body.mass.mass * self._stage.kilograms
            if not parts:
                # The mass has the shape of the visual geometry.
                for part in visual:
                    total += _compute_inertia(part, _DENSITY)
            total = _scale_mass(total, mass)
        if not mass > 0.0:
            return pin.Inertia.Zero(), is_stated or not parts
        lever = np.asarray(total.lever)
        tensor = np.asarray(total.inertia)
        in_link = self._frames[body.path].inverse().homogeneous @ self._metric @ body.matrix
        if body.mass.centre is not None:
            stated = in_link[:3, :3] @ body.mass.centre + in_link[:3, 3]
            # Steiner: the moments of the colliders are about the stated centre, as in usd-core's
            # `ComputeMassProperties`.
            away = stated - lever
            tensor = tensor + mass * (away @ away * np.eye(3) - np.outer(away, away))
            lever = stated
        if body.mass.moments is not None:
            tensor = self._read_moments(body, in_link, tensor)
        return pin.Inertia(mass, lever, tensor), is_stated

    def _read_moments(self, body: UsdBody, in_link: Floats, computed: Floats) -> Floats:
        """Return the moments of inertia that a body states along its link's axes [kg·m²].

        Impossible ones count as not stated, with a note.
        """
        assert body.mass.moments is not None
        moments = self._stage.kilograms * self._stage.metres**2 * body.mass.moments
        if not (moments >= 0.0).all():
            self._notes.append(f"body {body.path}: negative moments of inertia count as not stated")
            return computed
        axes = _extract_placement(in_link).rotation
        if body.mass.axes is not None:
            axes = axes @ _convert_quaternion(body.mass.axes)
        tensor = axes @ np.diag(moments) @ axes.T
        # Equal up to rounding, which pinocchio does not accept of large ones
        return np.asarray(0.5 * (tensor + tensor.T))

    def _find_density(self, body: UsdBody, collider: UsdShape) -> float | None:
        """Return the density of a collider [kg/m³]; None if nothing states it."""
        unit = self._stage.kilograms / self._stage.metres**3
        for density in (collider.mass.density, body.mass.density, collider.material_density):
            if density is not None:
                return density * unit
        return None


def _choose_names(paths: Iterable[str]) -> dict[str, str]:
    """Return the names of prims by their paths; whole paths where prims share a name."""
    listed = list(paths)
    counts = Counter(_get_leaf(path) for path in listed)
    names = dict[str, str]()
    for path in listed:
        leaf = _get_leaf(path)
        names[path] = leaf if counts[leaf] == 1 else path.lstrip("/")
    return names


def _get_leaf(path: str) -> str:
    """Return the name of a prim."""
    return path.rpartition("/")[2]


def _keep_rate(stated: float | None) -> float | None:
    """Return a velocity or effort limit, or None for numbers that mean none."""
    is_limit = stated is not None and MIN_POSITIVE <= stated < MAX_COORDINATE
    return stated if is_limit else None


def _make_matrix(axes: Floats, origin: Floats) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    matrix[:3, 3] = origin
    return matrix


def _extract_placement(matrix: Floats) -> pin.SE3:
    """Return the frame of a matrix without its scale and shear, as usd-core's `Gf.Matrix4d.Factor`.

    With the polar decomposition M = R S, S symmetric and positive; of a mirrored one, −S is taken.
    """
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right
    if np.linalg.det(rotation) < 0.0:
        rotation = -rotation
    return pin.SE3(rotation, matrix[:3, 3])


def _convert_quaternion(quaternion: Floats) -> Floats:
    """Return the rotation of a quaternion (w, x, y, z) of any length above 0, shape (3, 3)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.asarray(pin.Quaternion(w, x, y, z).toRotationMatrix())


def _scale_solid(
    kind: str, size: tuple[float, ...], scales: Floats
) -> tuple[str, tuple[float, ...]] | None:
    """Return kind and size of a scaled primitive as in `Part`; None if it becomes another shape."""
    across, other, along = (float(scale) for scale in scales)
    is_round = abs(across - other) <= _SAME * across
    is_uniform = is_round and abs(across - along) <= _SAME * across
    if kind == "cube":
        edges = np.broadcast_to(size, 3) * scales
        return "box", tuple(edges.tolist())
    if kind == "sphere" and is_uniform:
        return "sphere", (across * size[0],)
    if kind in ("cylinder", "capsule"):
        bottom, top, height = size
        is_kept = is_round if kind == "cylinder" else is_uniform
        if bottom == top and is_kept:
            return kind, (across * bottom, along * height)
    return None


def _make_surface(kind: str, size: tuple[float, ...]) -> trimesh.Trimesh:
    """Return the surface of a primitive of the file with z along its axis."""
    import trimesh

    if kind == "cube":
        return trimesh.creation.box(np.broadcast_to(size, 3))
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=size[0])
    if kind == "cone":
        radius, height = size
        # Its frame is at half of its height, the tip on z.
        cone = trimesh.creation.cone(radius, height, sections=_SIDES)
        return cone.apply_translation((0.0, 0.0, -0.5 * height))
    bottom, top, height = size
    points = list[Floats]()
    for radius, z in ((bottom, -0.5 * height), (top, 0.5 * height)):
        if kind == "capsule":
            ball = trimesh.creation.icosphere(subdivisions=3)
            ring = radius * np.asarray(ball.vertices)
        else:
            angles = np.linspace(0.0, 2.0 * math.pi, _SIDES, endpoint=False)
            ring = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
        points.append(ring + np.array([0.0, 0.0, z]))
    return compute_hull(np.unique(np.concatenate(points), axis=0))


def _triangulate(mesh: UsdMesh) -> Ints:
    """Return the triangles of a mesh's polygons, shape (k, 3)."""
    starts = np.cumsum(mesh.counts) - mesh.counts
    found = [np.empty((0, 3), np.int64)]
    for count in np.unique(mesh.counts):
        first = starts[mesh.counts == count]
        corners = mesh.corners[first[:, None] + np.arange(count)]
        found.append(triangulate_polygons(mesh.points, corners))
    return np.concatenate(found)


def _compute_inertia(part: Part, density: float) -> pin.Inertia:
    """Return the inertia of a shape as a solid; an open mesh counts as its convex hull."""
    if part.kind not in SOLIDS:
        mesh = part.make_mesh()
        if not mesh.is_volume:
            hull = compute_hull(thicken(mesh.vertices)[0])
            part = Part.from_triangles(part.name, hull)
    return part.compute_inertia(density)


def _scale_mass(inertia: pin.Inertia, mass: float) -> pin.Inertia:
    """Return the inertia of a body of the same shape with another mass [kg]."""
    if not inertia.mass > 0.0:
        return pin.Inertia(mass, np.zeros(3), np.zeros((3, 3)))
    tensor = np.asarray(inertia.inertia) * mass / inertia.mass
    return pin.Inertia(mass, inertia.lever, tensor)
