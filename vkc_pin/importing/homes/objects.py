"""Writes what moves in a home as objects of a scene, with proposed attachments."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.homes.splitting import Thing
from vkc_pin.importing.objects.clean_up import add_missing_limits, load_surfaces, merge_fixed_links
from vkc_pin.importing.objects.description import Description, Joint, Link
from vkc_pin.importing.objects.pieces import Known, decompose_links
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot

__all__ = ["ImportedHomeObject", "write_object"]

_LIFT = 0.2  # [m]: how far a thing is lifted from where it stands, to try whether a hand holds it


@dataclass(frozen=True, eq=False)
class ImportedHomeObject:
    """Something in a home that moves.

    Attributes:
        name: Its name in the scene.
        free: Whether it can be carried.
        proposals: How good its attachments are, and which joints have none; those of what is
            carried are for lifting it.
        entry: It, as a scene's object.
        notes: What was changed.
    """

    name: str
    free: bool
    proposals: Proposals
    entry: dict[str, Any]
    notes: tuple[str, ...]

    def report(self) -> str:
        """Return what can be done with it, as text."""
        best = {
            joint: self.proposals.opening(joint)
            for joint in self.proposals.object.coordinates.names
        }
        said = []
        for joint, found in best.items():
            by = (
                f"by {found[0].attachment.name}"
                if found
                else f"by no hand: {self.proposals.because.get(joint, 'nothing fits')}"
            )
            said.append(f"carried {by}" if self.free else f"{joint} {by}")
        return f"{self.name}: {'; '.join(said)}"


def write_object(
    thing: Thing,
    robot: Robot,
    folder: Path,
    known: Known,
    *,
    stem: str,
    most: int,
    **clearances: float,
) -> ImportedHomeObject:
    """Write an object, and return what it is in a scene.

    What is carried is taken hold of as what slides upwards from where it stands.

    Args:
        thing: The thing.
        robot: Whose hand the attachments are for.
        folder: The scene's.
        known: Pieces of files that were cut before; its own are added.
        stem: Name of the object's folder and files, without extension.
        most: Attachments for one joint at most.
        clearances: As of `propose_attachments`.

    Raises:
        InputError: A mesh is concave, and CoACD is not installed.
    """
    description = merge_fixed_links(thing.description)
    if thing.free:
        description = _standing(description)
    description = add_missing_limits(description, load_surfaces(description))
    description = decompose_links(description, load_surfaces(description), known)
    address = f"objects/{stem}/{stem}.yaml"
    yaml, urdf = folder / address, (folder / address).with_suffix(".urdf")
    with tempfile.TemporaryDirectory() as scratch:
        tried = Path(scratch) / yaml.name if thing.free else yaml
        write_urdf(description, tried.with_suffix(".urdf"))
        write_description(tried, urdf.name, (), about=())
        proposals = propose_attachments(load_object(tried), robot, most=most, **clearances)
    if thing.free:
        write_urdf(_lifted(description), urdf)
    about = [f"Attachments as proposed for the hand of {proposals.hand.robot}, best first."]
    about += [f"No hand can move {joint}: {reason}." for joint, reason in proposals.because.items()]
    write_description(
        yaml,
        urdf.name,
        [item.description() for item in proposals.found],
        about=about,
        free=thing.free,
    )
    proposals = dataclasses.replace(
        proposals, object=dataclasses.replace(proposals.object, urdf=None)
    )  # its file does not stay
    entry = {"name": thing.name, "type": address, "position": list(thing.position)}
    return ImportedHomeObject(thing.name, thing.free, proposals, entry, description.notes)


def _standing(description: Description) -> Description:
    """Return a thing that is carried as one that slides upwards."""
    child = description.root
    base, up = f"{child}_stand", np.array([0.0, 0.0, 1.0])
    lift = Joint(
        name="lift",
        kind="prismatic",
        parent=base,
        child=child,
        placement=pin.SE3.Identity(),
        axis=up,
        limits=(0.0, _LIFT),
    )
    return dataclasses.replace(
        description, links={base: Link(base), **description.links}, joints={child: lift}
    )


def _lifted(description: Description) -> Description:
    """Return the thing without what it stands on."""
    ((child, _),) = description.joints.items()
    return dataclasses.replace(description, links={child: description.links[child]}, joints={})
