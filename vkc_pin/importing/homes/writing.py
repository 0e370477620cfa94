"""Writes the parts of a home: objects with proposed attachments, and obstacles."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import Colour, Description, Joint, Link, Part
from vkc_pin.importing.homes.splitting import Home, HomeObject
from vkc_pin.importing.objects.clean_up import (
    choose_name,
    compute_bounds,
    load_surfaces,
    merge_fixed_links,
    move_root,
)
from vkc_pin.importing.objects.limits import add_missing_limits
from vkc_pin.importing.objects.pieces import MeshKeys, PieceCache, decompose_links, measure_links
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.importing.progress import ImportProgress
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.importing.targets import round_values
from vkc_pin.options import Options
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.scene.obstacles import FLOOR

_LIFT = 0.2  # [m] by which a free object is lifted to test whether a hand can hold it
# [m], and without unit: tolerance within which a visual and a collision shape coincide
_ALIKE = 1e-4


@dataclass(frozen=True, eq=False)
class ImportedHomeObject:
    """A movable object of a home.

    Attributes:
        name: Name in the scene.
        free: Whether it can be carried.
        proposals: Proposed attachments, and joints that have none; for free objects, those for
            lifting.
        entry: The scene's object entry.
        notes: Changes to the description.
    """

    name: str
    free: bool
    proposals: Proposals
    entry: dict[str, Any]
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Return a line about the attachments of the object."""
        parts = list[str]()
        for joint in self.proposals.object.coordinates.names:
            found = self.proposals.opening(joint)
            if found:
                by = f"by {found[0].attachment.name}"
            else:
                by = f"by no hand: {self.proposals.because.get(joint, 'no grasp fits')}"
            parts.append(f"carried {by}" if self.free else f"{joint} {by}")
        return f"{self.name}: {'; '.join(parts)}"


@dataclass(frozen=True, eq=False)
class HomeParts:
    """The written parts of a home.

    Attributes:
        objects: Movable objects, in the home's order.
        obstacles: The scene's obstacle entries.
        obstacle_links: Link in the file of each obstacle, by the name of the obstacle.
        notes: Changes to obstacles.
    """

    objects: tuple[ImportedHomeObject, ...]
    obstacles: list[dict[str, Any]]
    obstacle_links: Mapping[str, str]
    notes: tuple[str, ...]


def write_parts(
    home: Home, source: Path, robot: Robot, folder: Path, *, options: Options, most: int
) -> HomeParts:
    """Write the objects and obstacles of a home into the folder of a scene.

    Args:
        home: The divided home.
        source: Its file, for messages.
        robot: Robot for whose hand attachments are proposed.
        folder: Folder of the scene.
        options: Options with the clearances of attachments.
        most: Largest number of attachments of one joint.
    """
    cache: PieceCache = {}
    names = [item.name for item in home.objects]
    stems = choose_file_names(names)
    clearances = {"dist_safe": options.dist_safe, "grasp_clearance": options.grasp_clearance}
    progress = ImportProgress(measure_parts(home))
    objects = list[ImportedHomeObject]()
    for item, stem in zip(progress.follow(home.objects), stems, strict=True):
        objects.append(write_object(item, robot, folder, cache, stem=stem, most=most, **clearances))
    taken = {FLOOR, *names}
    obstacles, links, notes = write_obstacles(home, source, folder, taken, cache, progress)
    return HomeParts(tuple(objects), obstacles, links, tuple(notes))


def measure_parts(home: Home) -> list[float]:
    """Return the work of a home's objects, and then of its obstacles, for `ImportProgress`."""
    meshes = MeshKeys()
    work = [measure_links(item.description.links.values(), meshes) for item in home.objects]
    work += [measure_links([link], meshes) for _, link in _iterate_obstacle_links(home)]
    return work


def write_object(
    item: HomeObject,
    robot: Robot,
    folder: Path,
    cache: PieceCache,
    *,
    stem: str,
    most: int,
    **clearances: float,
) -> ImportedHomeObject:
    """Write an object, and return its entry in the scene.

    Attachments of a free object are proposed as if it slid upwards from its place.
    """
    description = merge_fixed_links(item.description)
    if item.free:
        description = _add_lift_joint(description)
    description = decompose_links(description, load_surfaces(description), cache)
    description = add_missing_limits(description)
    address = f"objects/{stem}/{stem}.yaml"
    yaml = folder / address
    urdf = yaml.with_suffix(".urdf")
    springs = description.joints.values()
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        trial = Path(scratch) / yaml.name if item.free else yaml
        write_urdf(description, trial.with_suffix(".urdf"))
        write_description(trial, urdf.name, (), about=(), joints=springs)
        proposals = propose_attachments(load_object(trial), robot, most=most, **clearances)
    if item.free:
        write_urdf(_remove_lift_joint(description), urdf)
    about = [f"Attachments as proposed for the hand of {proposals.hand.robot}, best first."]
    for joint, reason in proposals.because.items():
        about.append(f"No hand can move {joint}: {reason}.")
    found = [proposal.description() for proposal in proposals.found]
    write_description(yaml, urdf.name, found, about=about, joints=springs, free=item.free)
    # The trial file is temporary.
    without_file = dataclasses.replace(proposals.object, urdf=None)
    proposals = dataclasses.replace(proposals, object=without_file)
    entry = {"name": item.name, "type": address, "position": list(item.position)}
    return ImportedHomeObject(item.name, item.free, proposals, entry, description.notes)


def _add_lift_joint(description: Description) -> Description:
    """Return a free object as one that slides upwards."""
    child = description.root
    base = f"{child}_stand"
    lift = Joint(
        name="lift",
        kind="prismatic",
        parent=base,
        child=child,
        placement=pin.SE3.Identity(),
        axis=np.array([0.0, 0.0, 1.0]),
        limits=(0.0, _LIFT),
    )
    links = {base: Link(base), **description.links}
    return dataclasses.replace(description, links=links, joints={child: lift})


def _remove_lift_joint(description: Description) -> Description:
    """Return the object without its lift joint."""
    (child,) = description.joints
    return dataclasses.replace(description, links={child: description.links[child]}, joints={})


def write_obstacles(
    home: Home,
    source: Path,
    folder: Path,
    taken: set[str],
    cache: PieceCache,
    progress: ImportProgress,
) -> tuple[list[dict[str, Any]], dict[str, str], list[str]]:
    """Write the fixed parts of a home, and return the scene's obstacle entries, links and notes.

    Each piece of furniture is one obstacle, so that reports name it; so is each shape of the
    building. Primitive shapes are written into the scene itself. Others become a URDF with convex
    pieces, whose origin is on the floor below its centre. Links are those of the file, by the name
    of the obstacle.
    """
    entries = list[dict[str, Any]]()
    notes = list[str]()
    named = dict[str, Link]()
    sources = dict[str, str]()
    for source_link, link in _iterate_obstacle_links(home):
        name = choose_name(link.name, taken)
        named[name] = link
        sources[name] = source_link
    written = [name for name, link in named.items() if not _is_simple(link)]
    stems = dict(zip(written, choose_file_names(written), strict=True))
    for name, link in zip(named, progress.follow(named.values()), strict=True):
        if name not in stems:
            entries.append(_make_simple_entry(name, link))
            continue
        description = Description(source, {name: Link(name, link.visual, link.collision)}, {})
        low, high = compute_bounds(description, load_surfaces(description))
        x, y = ((low + high) / 2.0)[:2]
        origin = np.array([x, y, 0.0]).round(6)
        description = move_root(description, pin.SE3(np.eye(3), -origin))
        description = decompose_links(description, load_surfaces(description), cache)
        notes += description.notes
        address = f"obstacles/{stems[name]}/{stems[name]}.urdf"
        write_urdf(description, folder / address)
        position = round_values(origin)
        entries.append({"name": name, "type": "urdf", "file": address, "position": position})
    return entries, sources, notes


def _iterate_obstacle_links(home: Home) -> Iterator[tuple[str, Link]]:
    """Yield the links that become one obstacle each, after their link in the file."""
    for link in home.building:
        for number, part in enumerate(link.solid):
            colour = _find_colour(part, link.visual)
            shapes = (dataclasses.replace(part, colour=colour),)
            name = link.name if len(link.solid) == 1 else f"{link.name}_{number}"
            yield link.name, Link(part.name or name, shapes, shapes)
    for link in home.furniture:
        yield link.name, link


def _is_simple(link: Link) -> bool:
    """Return whether a link's collision geometry is one primitive shape."""
    return len(link.solid) == 1 and link.solid[0].kind != "mesh"


def _make_simple_entry(name: str, link: Link) -> dict[str, Any]:
    """Return the scene entry of a link that is a box, sphere, cylinder or capsule."""
    (part,) = link.solid
    size = [round(float(value), 6) for value in part.size]
    entry: dict[str, Any] = {"name": name, "type": part.kind}
    if part.kind == "box":
        entry["size"] = size
    else:
        # A sphere has no length.
        entry.update(zip(("radius", "length"), size, strict=False))
    entry["position"] = round_values(part.placement.translation)
    if not np.allclose(part.placement.rotation, np.eye(3), atol=1e-9):
        entry["rpy"] = round_values(pin.rpy.matrixToRpy(part.placement.rotation), 9)
    colour = _find_colour(part, link.visual)
    if colour is not None:
        entry["colour"] = [round(float(value), 4) for value in colour]
    return entry


def _find_colour(part: Part, visual: Iterable[Part]) -> Colour | None:
    """Return the colour of a shape, or of the visual shape at the same placement."""
    if part.colour is not None:
        return part.colour
    placement = part.placement.homogeneous
    for other in visual:
        if np.allclose(other.placement.homogeneous, placement, atol=_ALIKE):
            return other.colour
    return None
