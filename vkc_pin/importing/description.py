"""Defines the description of a robot, an object or a home, independent of its file format."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats
from vkc_pin.world.files.meshes import load_mesh

if TYPE_CHECKING:
    import trimesh


Colour = tuple[float, float, float, float]
Limits = tuple[float, float]
MOVING_KINDS = ("revolute", "continuous", "prismatic")
"""Kinds of joints that have a position."""
_RESISTANCES = ("damping", "friction", "stiffness")
_SIDES = 48  # facets of a cylinder mesh
SOLIDS = {
    "box": coal.Box,
    "sphere": coal.Sphere,
    "cylinder": coal.Cylinder,
    "capsule": coal.Capsule,
}
"""Constructors of primitive shapes, whose arguments are the sizes of a `Part`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """A shape of a link.

    Attributes:
        name: Name in the file; need not be unique.
        placement: Placement in the frame of its link.
        kind: "box", "sphere", "cylinder", "capsule" or "mesh".
        size: Dimensions as in `vkc_pin.world.files.urdf.UrdfShape` [m]; for meshes, the scale.
        file: Mesh file, or None if the mesh is given as triangles.
        triangles: Mesh before scaling.
        colour: Red, green, blue and opacity, or None.
    """

    name: str
    placement: pin.SE3
    kind: str
    size: tuple[float, ...]
    file: Path | None = None
    triangles: trimesh.Trimesh | None = None
    colour: Colour | None = None

    @classmethod
    def from_triangles(
        cls, name: str, triangles: trimesh.Trimesh, colour: Colour | None = None
    ) -> Part:
        """Return a mesh in the frame of its link [m]."""
        return cls(
            name=name,
            placement=pin.SE3.Identity(),
            kind="mesh",
            size=(1.0, 1.0, 1.0),
            triangles=triangles,
            colour=colour,
        )

    def transform(self, placement: pin.SE3) -> Part:
        """Return the shape in a frame in which its link's frame is at `placement`."""
        return replace(self, placement=placement * self.placement)

    def make_mesh(self) -> trimesh.Trimesh:
        """Return the surface in the frame of its link [m]."""
        import trimesh

        if self.triangles is not None:
            mesh = self.triangles.copy().apply_scale(self.size)
        elif self.file is not None:
            mesh = load_mesh(self.file, self.size)
        elif self.kind == "box":
            mesh = trimesh.creation.box(self.size)
        elif self.kind == "sphere":
            (radius,) = self.size
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        elif self.kind == "capsule":
            radius, length = self.size
            mesh = trimesh.creation.capsule(height=length, radius=radius, count=[_SIDES, _SIDES])
        else:
            radius, length = self.size
            mesh = trimesh.creation.cylinder(radius, height=length, sections=_SIDES)
        return mesh.apply_transform(self.placement.homogeneous)

    def compute_inertia(self, density: float) -> pin.Inertia:
        """Return the inertia of a solid of this `density` [kg/m³] in the frame of its link."""
        if self.kind in SOLIDS:
            solid = SOLIDS[self.kind](*self.size)
            mass = density * solid.computeVolume()
            tensor = density * np.asarray(solid.computeMomentofInertia())
            return self.placement.act(pin.Inertia(mass, np.zeros(3), tensor))
        mesh = self.make_mesh()
        mesh.density = density
        return pin.Inertia(
            float(mesh.mass), np.asarray(mesh.center_mass), np.asarray(mesh.moment_inertia)
        )


@dataclass(frozen=True, eq=False)
class Link:
    """A link with its visual and collision shapes and its inertia, in the link's frame."""

    name: str
    visual: tuple[Part, ...] = ()
    collision: tuple[Part, ...] = ()
    inertia: pin.Inertia = field(default_factory=pin.Inertia.Zero)

    @property
    def solid(self) -> tuple[Part, ...]:
        """Collision shapes, or visual shapes if the file has no collision shapes."""
        return self.collision or self.visual

    def transform(self, placement: pin.SE3) -> Link:
        """Return the link in a frame in which its own frame is at `placement`."""
        visual = tuple(part.transform(placement) for part in self.visual)
        collision = tuple(part.transform(placement) for part in self.collision)
        return Link(self.name, visual, collision, placement.act(self.inertia))


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """A joint, at whose zero position the child's frame is at `placement` in the parent's.

    Attributes:
        name: Joint name.
        kind: "fixed", "revolute", "prismatic", "continuous" if the file says that it turns without
            end, "floating" or "planar".
        parent, child: Names of the links.
        placement: Placement of the child's frame in the parent's.
        axis: Unit axis in the child's frame, shape (3,).
        limits: Lower and upper limit, [rad] or [m], infinite where the file says that there is
            none; None if the file says nothing.
        velocity: Velocity limit, [rad/s] or [m/s]; None if the file states none.
        effort: Effort limit, [N·m] or [N]; None if the file states none.
        damping: Damping, [N·m·s/rad] or [N·s/m]; 0 if the file states none.
        friction: Coulomb friction, [N·m] or [N]; 0 if the file states none.
        stiffness: Stiffness of a spring, [N·m/rad] or [N/m]; 0 if the file states none.
        springref: Rest position of the spring, [rad] or [m].
        is_driven: Whether the file has an actuator for it.
    """

    name: str
    kind: str
    parent: str
    child: str
    placement: pin.SE3
    axis: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    limits: Limits | None = None
    velocity: float | None = None
    effort: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    springref: float = 0.0
    is_driven: bool = False

    def compute_motion(self, value: float) -> pin.SE3:
        """Return the child's frame at a position, [rad] or [m], in its frame at zero."""
        if self.kind == "prismatic":
            return pin.SE3(np.eye(3), self.axis * value)
        return pin.SE3(pin.exp3(self.axis * value), np.zeros(3))

    def fix(self, value: float) -> Joint:
        """Return the joint fixed at a position, [rad] or [m]."""
        placement = self.placement * self.compute_motion(value)
        return replace(self, kind="fixed", placement=placement, limits=None)


@dataclass(frozen=True)
class Coupling:
    """A joint whose position y is a polynomial of its leader's position x: y = Σ aₖ xᵏ.

    Attributes:
        joint: Name of the joint that follows.
        leader: Name of the leader; None if the joint is held at a₀.
        coefficients: a₀, a₁, ...; [m] or [rad] for y and x.
        element: Element of the file that states it, for messages.
    """

    joint: str
    leader: str | None
    coefficients: tuple[float, ...]
    element: str

    @property
    def is_linear(self) -> bool:
        """Whether no power of x above the first counts."""
        return not any(self.coefficients[2:])

    @property
    def offset(self) -> float:
        """a₀ [m] or [rad]."""
        return self.coefficients[0]

    @property
    def factor(self) -> float:
        """a₁."""
        return self.coefficients[1]

    def evaluate(self, position: float) -> float:
        """Return the joint's position, given its leader's, [m] or [rad]."""
        return float(np.polynomial.polynomial.polyval(position, self.coefficients))


@dataclass(frozen=True, eq=False)
class Loop:
    """A connection of two links beside the tree of joints.

    Attributes:
        kind: "connected" at a point, or "welded".
        links: Names of both links.
        points: The point in the frame of each link [m], shape (3,) each; None for a weld.
        element: Element of the file that states it, for messages.
    """

    kind: str
    links: tuple[str, str]
    points: tuple[Floats, Floats] | None
    element: str


@dataclass(frozen=True)
class MissingMesh:
    """A mesh that would collide, does not exist, and that nothing replaces.

    Attributes:
        link: Its link.
        kind: "collision", or "visual" if the link has no collision shapes.
        error: The error, whose `field` is the mesh's address.
    """

    link: str
    kind: str
    error: InputError


@dataclass(frozen=True, eq=False)
class Description:
    """Description of a robot, an object or a home as a tree of links.

    Attributes:
        file: The file.
        links: Links by name.
        joints: Joints by the name of their child link.
        notes: Changes and omissions.
        missing: Meshes that would collide and do not exist.
        format: Name of the file's format.
        couplings: Joints that follow others or are held.
        loops: Connections beside the tree of joints.
        states: Joint positions by joint name, [rad] or [m], by the name of the state.
        warnings: Changes that can make shapes wrong.
        is_world: Whether the root is the world around the file's bodies.
    """

    file: Path
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    notes: tuple[str, ...] = ()
    missing: tuple[MissingMesh, ...] = ()
    format: str = ""
    couplings: tuple[Coupling, ...] = ()
    loops: tuple[Loop, ...] = ()
    states: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    is_world: bool = False

    @property
    def root(self) -> str:
        """The link without a parent joint."""
        return next(name for name in self.links if name not in self.joints)

    def compute_placements(self, values: Mapping[str, float] | None = None) -> dict[str, pin.SE3]:
        """Return the frames of all links in the root's frame.

        Args:
            values: Joint positions by name, [rad] or [m]; others are at zero.
        """
        positions = values or {}
        placements = {self.root: pin.SE3.Identity()}
        children = self.children()
        ahead = [self.root]
        while ahead:
            parent = ahead.pop()
            for child in children.get(parent, ()):
                joint = self.joints[child]
                motion = joint.compute_motion(positions.get(joint.name, 0.0))
                placements[child] = placements[parent] * joint.placement * motion
                ahead.append(child)
        return placements

    def walk_up(self, link: str) -> Iterator[str]:
        """Yield a link and those that carry it, up to the root."""
        yield link
        while link in self.joints:
            link = self.joints[link].parent
            yield link

    @property
    def is_massless(self) -> bool:
        """Whether no link has a mass."""
        return not any(link.inertia.mass > 0.0 for link in self.links.values())

    def clip_resistances(self) -> Description:
        """Return the object with resistances of joints from 0 to `MAX_COORDINATE`, noting others.

        Larger ones, also infinite ones, state that a joint does not move. Negative ones would
        drive it.
        """
        joints = dict(self.joints)
        notes = list(self.notes)
        for child, joint in self.joints.items():
            clipped = dict[str, Any]()
            for name in _RESISTANCES:
                stated = getattr(joint, name)
                used = min(max(stated, 0.0), MAX_COORDINATE)
                if used != stated and not math.isnan(stated):
                    about = f"a {name} of {stated:g}: {used:g} is used"
                    notes.append(f"joint '{joint.name}' states {about}")
                clipped[name] = used
            joints[child] = replace(joint, **clipped)
        return replace(self, joints=joints, notes=tuple(notes))

    def extract_subtree(self, link: str) -> Description:
        """Return a link and its descendants as a description of their own.

        Raises:
            UnknownNameError: There is no such link.
        """
        if link not in self.links:
            raise UnknownNameError("link", link, self.links, file=self.file, field="link")
        subtree = self.subtree(link)
        links = {name: self.links[name] for name in self.links if name in subtree}
        below = subtree - {link}
        joints = {child: self.joints[child] for child in self.joints if child in below}
        return self.keep(links, joints)

    def keep(self, links: Mapping[str, Link], joints: Mapping[str, Joint]) -> Description:
        """Return the description with some of its links and joints, and what belongs to them."""
        names = {joint.name for joint in joints.values()}
        couplings = list[Coupling]()
        for coupling in self.couplings:
            has_leader = coupling.leader is None or coupling.leader in names
            if coupling.joint in names and has_leader:
                couplings.append(coupling)
        loops = [loop for loop in self.loops if set(loop.links) <= links.keys()]
        states = dict[str, dict[str, float]]()
        for name, state in self.states.items():
            states[name] = {joint: state[joint] for joint in state if joint in names}
        return replace(
            self,
            links=links,
            joints=joints,
            missing=tuple(mesh for mesh in self.missing if mesh.link in links),
            couplings=tuple(couplings),
            loops=tuple(loops),
            states=states,
        )

    def rename(self, links: Mapping[str, str], joints: Mapping[str, str]) -> Description:
        """Return the description with other names.

        Args:
            links: New name of each link.
            joints: New name of each joint, by its child link.
        """
        renamed_links = {
            links[name]: replace(link, name=links[name]) for name, link in self.links.items()
        }
        renamed_joints = dict[str, Joint]()
        new_names = dict[str, str]()
        for child, joint in self.joints.items():
            new_names[joint.name] = joints[child]
            renamed_joints[links[child]] = replace(
                joint, name=joints[child], parent=links[joint.parent], child=links[child]
            )
        couplings = list[Coupling]()
        for coupling in self.couplings:
            leader = new_names.get(coupling.leader or "", coupling.leader)
            couplings.append(replace(coupling, joint=new_names[coupling.joint], leader=leader))
        loops = list[Loop]()
        for loop in self.loops:
            first, second = loop.links
            loops.append(replace(loop, links=(links[first], links[second])))
        states = dict[str, dict[str, float]]()
        for name, state in self.states.items():
            states[name] = {new_names[joint]: value for joint, value in state.items()}
        return replace(
            self,
            links=renamed_links,
            joints=renamed_joints,
            missing=tuple(replace(mesh, link=links[mesh.link]) for mesh in self.missing),
            couplings=tuple(couplings),
            loops=tuple(loops),
            states=states,
        )

    def add_notes(self, *notes: str) -> Description:
        """Return the description with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def check_meshes(self, *, is_home: bool = False) -> Description:
        """Return the object after checking that no mesh of its links is missing.

        Args:
            is_home: Whether visual meshes of links that do not move may be missing, which is noted.

        Raises:
            InputError: A mesh is missing.
        """
        description, omitted = self.omit_missing_visuals(
            lambda mesh: is_home and self.is_fixed(mesh.link)
        )
        notes = list[str]()
        for mesh in omitted:
            lacks = f"link '{mesh.link}': there is no visual mesh {mesh.error.field}"
            notes.append(f"{lacks}: left out, although nothing collides in its place")
        return description.add_notes(*notes)

    def omit_missing_visuals(
        self, can_omit: Callable[[MissingMesh], bool]
    ) -> tuple[Description, list[MissingMesh]]:
        """Return the description without missing meshes, and the visual ones that were omitted.

        Args:
            can_omit: Whether a visual mesh is not needed for collision.

        Raises:
            InputError: Other meshes are missing; the error lists all of them.
        """
        omitted = [mesh for mesh in self.missing if mesh.kind == "visual" and can_omit(mesh)]
        errors = [mesh.error for mesh in self.missing if mesh not in omitted]
        if errors:
            raise _make_missing_error(errors, self.file)
        return replace(self, missing=()), omitted

    def is_fixed(self, link: str) -> bool:
        """Return whether only fixed joints connect a link with the root."""
        while link in self.joints:
            if self.joints[link].kind != "fixed":
                return False
            link = self.joints[link].parent
        return True

    def subtree(self, link: str) -> set[str]:
        """Return a link and all its descendants."""
        children = self.children()
        found = {link}
        ahead = [link]
        while ahead:
            for child in children.get(ahead.pop(), ()):
                if child not in found:
                    found.add(child)
                    ahead.append(child)
        return found

    def children(self) -> dict[str, list[str]]:
        """Return the children of each link that has any."""
        children = dict[str, list[str]]()
        for child, joint in self.joints.items():
            children.setdefault(joint.parent, []).append(child)
        return children


def _make_missing_error(errors: Sequence[InputError], file: Path) -> InputError:
    """Return one error about all missing meshes of a file.

    Args:
        errors: Errors about single meshes, whose `field` is the mesh's address.
        file: The file.
    """
    by_address = {str(error.field): error for error in errors}
    if len(by_address) == 1:
        return errors[0]
    return InputError(
        f"{len(by_address)} meshes do not exist: {', '.join(by_address)}",
        file=file,
        expected="mesh files, or visual shapes of the same links",
        got=errors[0].got,
    )


def make_limits(low: float, high: float) -> Limits:
    """Return the limits of a joint as in `Joint`; numbers beyond `MAX_COORDINATE` mean none."""
    low = low if low > -MAX_COORDINATE else -math.inf
    high = high if high < MAX_COORDINATE else math.inf
    return (low, high)


def make_inertia(mass: float, moments: Iterable[float], placement: pin.SE3) -> pin.Inertia:
    """Return a link's inertia from the values that URDF and SDF state.

    Args:
        mass: Mass [kg].
        moments: Moments of inertia about the centre of mass [kg·m²], in the order of
            `vkc_pin.world.files.kinematic_tree.MOMENTS`.
        placement: Frame of the moments at the centre of mass, in the link's frame.
    """
    xx, xy, xz, yy, yz, zz = moments
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    least = float(np.linalg.eigvalsh(tensor)[0])
    if mass < 0.0 or least < -1e-9 * max(abs(xx), abs(yy), abs(zz)):
        problem = "a negative mass" if mass < 0.0 else "impossible moments of inertia"
        raise InputError(problem, expected="0 or more", got=mass if mass < 0.0 else least)
    return placement.act(pin.Inertia(mass, np.zeros(3), tensor))
