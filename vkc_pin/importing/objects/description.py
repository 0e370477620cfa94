"""What a file says about an object, whatever its format: links with shapes, and the joints between them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.meshes import load_mesh

if TYPE_CHECKING:
    import trimesh

__all__ = ["WEIGHTLESS", "Colour", "Description", "Joint", "Link", "Part", "make_inertia"]

Colour = tuple[float, float, float, float]
WEIGHTLESS = "no mass is stated: torques of the arm leave weight and inertia out, physics assumes a density"  # said once
_SIDES = 48  # of a cylinder as triangles


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """A shape of a link.

    Attributes:
        name: What the file calls it; need not be unique.
        placement: In the frame of its link.
        kind: "box", "sphere", "cylinder", "capsule" or "mesh".
        size: As in `vkc_pin.world.files.urdf.UrdfShape`, [m]; scale of a mesh.
        file: The mesh's file, or None if it is given as triangles.
        triangles: The mesh, before it is scaled.
        colour: Red, green, blue, opacity, or None.
    """

    name: str
    placement: pin.SE3
    kind: str
    size: tuple[float, ...]
    file: Path | None = None
    triangles: trimesh.Trimesh | None = None
    colour: Colour | None = None

    def mesh(self) -> trimesh.Trimesh:
        """Return its surface in the frame of its link, [m].

        Raises:
            InputError: Its file cannot be read, or is empty.
        """
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


@dataclass(frozen=True, eq=False)
class Link:
    """A link: what it looks like, what collides, and what it weighs (nothing if no mass is stated), each in the link's frame."""

    name: str
    visual: tuple[Part, ...] = ()
    collision: tuple[Part, ...] = ()
    inertia: pin.Inertia = field(default_factory=pin.Inertia.Zero)

    @property
    def solid(self) -> tuple[Part, ...]:
        """What collides; what it looks like where the file says nothing about that."""
        return self.collision or self.visual

    def transform(self, placement: pin.SE3) -> Link:
        """Return the link as seen from a frame in which its own is at `placement`."""
        visual, collision = (
            tuple(replace(part, placement=placement * part.placement) for part in kind)
            for kind in (self.visual, self.collision)
        )
        return Link(self.name, visual, collision, placement.act(self.inertia))


@dataclass(frozen=True, eq=False, kw_only=True)
class Joint:
    """A joint; at zero, the child's frame is at `placement` in the parent's.

    Attributes:
        name: Its name.
        kind: "fixed", "revolute", "continuous" or "prismatic"; in homes also "floating".
        parent, child: Names of links.
        placement: Of the child's frame in the parent's.
        axis: Unit axis in the child's frame, shape (3,).
        limits: Lower and upper, [rad] or [m]; None if the file states none.
        velocity: Its limit, [rad/s] or [m/s]; None if the file states none.
        damping: [N·m·s/rad] or [N·s/m]; 0 if the file states none.
        friction: Coulomb's, [N·m] or [N]; 0 if the file states none.
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

    def compute_motion(self, value: float) -> pin.SE3:
        """Return the child's frame at a value, [rad] or [m], in its frame at zero."""
        if self.kind == "prismatic":
            return pin.SE3(np.eye(3), self.axis * value)
        return pin.SE3(pin.exp3(self.axis * value), np.zeros(3))


@dataclass(frozen=True, eq=False)
class Description:
    """What a file says, as one tree of links.

    Attributes:
        file: The file.
        links: By name.
        joints: By the name of their child.
        notes: What was changed or left out.
    """

    file: Path
    links: Mapping[str, Link]
    joints: Mapping[str, Joint]
    notes: tuple[str, ...] = ()

    @property
    def root(self) -> str:
        """The link that hangs on no joint."""
        return next(name for name in self.links if name not in self.joints)

    def compute_placements(self, values: Mapping[str, float] | None = None) -> dict[str, pin.SE3]:
        """Return the frames of the links in the root's frame, at values of joints by their names [rad] or [m]; others at zero."""
        found = {self.root: pin.SE3.Identity()}
        while len(found) < len(self.links):
            for child, joint in self.joints.items():
                if child not in found and joint.parent in found:
                    value = (values or {}).get(joint.name, 0.0)
                    found[child] = (
                        found[joint.parent] * joint.placement * joint.compute_motion(value)
                    )
        return found

    @property
    def is_massless(self) -> bool:
        """Whether no link has a mass."""
        return not any(link.inertia.mass > 0.0 for link in self.links.values())

    def subtree(self, link: str) -> set[str]:
        """Return a link and all that hang on it."""
        found, before = {link}, 0
        while len(found) > before:
            before = len(found)
            found |= {child for child, joint in self.joints.items() if joint.parent in found}
        return found


def make_inertia(mass: float, moments: Iterable[float], placement: pin.SE3) -> pin.Inertia:
    """Return what a link weighs, from what URDF and SDF state.

    Args:
        mass: [kg].
        moments: About the centre of mass [kg·m²], in the order of
            `vkc_pin.world.files.kinematic_tree.MOMENTS`.
        placement: Of the centre of mass, and of the axes of the moments, in the link's frame.

    Raises:
        InputError: The mass or a principal moment is negative.
    """
    xx, xy, xz, yy, yz, zz = moments
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    least = float(np.linalg.eigvalsh(tensor)[0])
    if mass < 0.0 or least < -1e-9 * max(abs(xx), abs(yy), abs(zz)):
        problem = "a mass below zero" if mass < 0.0 else "moments of inertia that no body has"
        raise InputError(problem, expected="0 or more", got=mass if mass < 0.0 else least)
    return placement.act(pin.Inertia(mass, np.zeros(3), tensor))
