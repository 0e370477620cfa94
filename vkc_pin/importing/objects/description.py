"""Defines the description of an object, independent of its file format."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.missing_meshes import MissingMesh, make_missing_error
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats
from vkc_pin.world.files.meshes import load_mesh

if TYPE_CHECKING:
    import trimesh


Colour = tuple[float, float, float, float]
WEIGHTLESS = (
    "no mass is stated: arm torques ignore weight and inertia, and simulation assumes a density"
)
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
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=self.size[0])
        elif self.kind == "capsule":
            mesh = trimesh.creation.capsule(
                height=self.size[1], radius=self.size[0], count=[_SIDES, _SIDES]
            )
        else:
            mesh = trimesh.creation.cylinder(self.size[0], height=self.size[1], sections=_SIDES)
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
        visual, collision = (
            tuple(replace(part, placement=placement * part.placement) for part in kind)
            for kind in (self.visual, self.collision)
        )
        return Link(self.name, visual, collision, placement.act(self.inertia))


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """A joint, at whose zero position the child's frame is at `placement` in the parent's.

    Attributes:
        name: Joint name.
        kind: "fixed", "revolute", "prismatic" or, if the file says that it turns without end,
            "continuous"; in homes also "floating".
        parent, child: Names of the links.
        placement: Placement of the child's frame in the parent's.
        axis: Unit axis in the child's frame, shape (3,).
        limits: Lower and upper limit, [rad] or [m], one of them infinite if the file states only
            the other; None if the file states none.
        velocity: Velocity limit, [rad/s] or [m/s]; None if the file states none.
        damping: Damping, [N·m·s/rad] or [N·s/m]; 0 if the file states none.
        friction: Coulomb friction, [N·m] or [N]; 0 if the file states none.
        stiffness: Stiffness of a spring, [N·m/rad] or [N/m]; 0 if the file states none.
        springref: Rest position of the spring, [rad] or [m].
    """

    name: str
    kind: str
    parent: str
    child: str
    placement: pin.SE3
    axis: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    limits: tuple[float, float] | None = None
    velocity: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    springref: float = 0.0

    def compute_motion(self, value: float) -> pin.SE3:
        """Return the child's frame at a position, [rad] or [m], in its frame at zero."""
        if self.kind == "prismatic":
            return pin.SE3(np.eye(3), self.axis * value)
        return pin.SE3(pin.exp3(self.axis * value), np.zeros(3))

    def fix(self, value: float) -> Joint:
        """Return the joint fixed at a position, [rad] or [m]."""
        placement = self.placement * self.compute_motion(value)
        return replace(self, kind="fixed", placement=placement, limits=None)


@dataclass(frozen=True, eq=False)
class Description:
    """Description of an object as a tree of links.

    Attributes:
        file: The file.
        links: Links by name.
        joints: Joints by the name of their child link.
        notes: Changes and omissions.
        missing: Meshes that would collide and do not exist.
    """

    file: Path
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    notes: tuple[str, ...] = ()
    missing: tuple[MissingMesh, ...] = ()

    @property
    def root(self) -> str:
        """The link without a parent joint."""
        return next(name for name in self.links if name not in self.joints)

    def compute_placements(self, values: Mapping[str, float] | None = None) -> dict[str, pin.SE3]:
        """Return the frames of all links in the root's frame.

        Args:
            values: Joint positions by name, [rad] or [m]; others are at zero.
        """
        placements = {self.root: pin.SE3.Identity()}
        before = 0
        while before < len(placements):
            before = len(placements)
            for child, joint in self.joints.items():
                if child not in placements and joint.parent in placements:
                    value = (values or {}).get(joint.name, 0.0)
                    placements[child] = (
                        placements[joint.parent] * joint.placement * joint.compute_motion(value)
                    )
        return placements

    @property
    def is_massless(self) -> bool:
        """Whether no link has a mass."""
        return not any(link.inertia.mass > 0.0 for link in self.links.values())

    def clip_resistances(self) -> Description:
        """Return the object with resistances of joints from 0 to `MAX_COORDINATE`, noting others.

        Larger ones, also infinite ones, state that a joint does not move. Negative ones would
        drive it.
        """
        joints, notes = dict(self.joints), list(self.notes)
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

    def check_meshes(self, *, is_home: bool = False) -> Description:
        """Return the object after checking that no mesh of its links is missing.

        Args:
            is_home: Whether visual meshes of links that do not move may be missing, which is noted.

        Raises:
            InputError: A mesh is missing.
        """
        of_links = [mesh for mesh in self.missing if mesh.link in self.links]
        omitted = [
            mesh
            for mesh in of_links
            if is_home and mesh.kind == "visual" and self.is_fixed(mesh.link)
        ]
        errors = [mesh.error for mesh in of_links if mesh not in omitted]
        if errors:
            raise make_missing_error(errors, self.file)
        notes = [
            f"link '{mesh.link}': there is no visual mesh {mesh.error.field}: left out, "
            "although nothing collides in its place"
            for mesh in omitted
        ]
        return replace(self, notes=(*self.notes, *notes), missing=())

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
        found, ahead = {link}, [link]
        while ahead:
            new = [child for child in children.get(ahead.pop(), ()) if child not in found]
            found.update(new)
            ahead += new
        return found

    def children(self) -> dict[str, list[str]]:
        """Return the children of each link that has any."""
        found: dict[str, list[str]] = {}
        for child, joint in self.joints.items():
            found.setdefault(joint.parent, []).append(child)
        return found


def make_limits(low: float, high: float) -> tuple[float, float] | None:
    """Return the limits of a joint as in `Joint`; numbers beyond `MAX_COORDINATE` mean none."""
    low = low if low > -MAX_COORDINATE else -math.inf
    high = high if high < MAX_COORDINATE else math.inf
    return None if math.isinf(low) and math.isinf(high) else (low, high)


def limit_follower(
    own: tuple[float, float] | None,
    leader: tuple[float, float] | None,
    factor: float,
    offset: float,
) -> tuple[float, float] | None:
    """Return the limits of a joint whose position is factor · leader's position + offset.

    Its own limits count where its leader reaches them: they may be a copy of the leader's, with
    which the follower of a negative factor could not move.
    """
    if leader is None:
        return own
    ends = sorted(factor * end + offset for end in leader)
    reached = (ends[0], ends[1])
    if own is None:
        return reached
    common = (max(own[0], reached[0]), min(own[1], reached[1]))
    return common if common[0] < common[1] else reached


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
