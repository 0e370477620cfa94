"""Writes the movable parts of a home as objects of a scene, with proposed attachments."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.homes.splitting import HomeObject
from vkc_pin.importing.objects.clean_up import add_missing_limits, load_surfaces, merge_fixed_links
from vkc_pin.importing.objects.description import Description, Joint, Link
from vkc_pin.importing.objects.pieces import PieceCache, decompose_links
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot

__all__ = ["ImportedHomeObject", "write_object"]

_LIFT = 0.2  # [m] by which a free object is lifted to test whether a hand can hold it


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
        best = {
            joint: self.proposals.opening(joint)
            for joint in self.proposals.object.coordinates.names
        }
        parts = []
        for joint, proposals in best.items():
            by = (
                f"by {proposals[0].attachment.name}"
                if proposals
                else f"by no hand: {self.proposals.because.get(joint, 'no grasp fits')}"
            )
            parts.append(f"carried {by}" if self.free else f"{joint} {by}")
        return f"{self.name}: {'; '.join(parts)}"


def write_object(
    item: HomeObject,
    robot: Robot,
    folder: Path,
    known: PieceCache,
    *,
    stem: str,
    most: int,
    **clearances: float,
) -> ImportedHomeObject:
    """Write an object, and return its entry in the scene.

    Attachments of a free object are proposed as if it slid upwards from its place.

    Args:
        item: The object.
        robot: Robot whose hand the attachments are for.
        folder: Folder of the scene.
        known: Cache of pieces of mesh files; new ones are added.
        stem: Name of the object's folder and files, without extension.
        most: Largest number of attachments of one joint.
        clearances: Clearances as in `propose_attachments`.

    Raises:
        InputError: A mesh is concave, and CoACD is not installed.
    """
    description = merge_fixed_links(item.description)
    if item.free:
        description = _add_lift_joint(description)
    description = add_missing_limits(description, load_surfaces(description))
    description = decompose_links(description, load_surfaces(description), known)
    address = f"objects/{stem}/{stem}.yaml"
    yaml, urdf = folder / address, (folder / address).with_suffix(".urdf")
    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / yaml.name if item.free else yaml
        write_urdf(description, trial.with_suffix(".urdf"))
        write_description(trial, urdf.name, (), about=())
        proposals = propose_attachments(load_object(trial), robot, most=most, **clearances)
    if item.free:
        write_urdf(_remove_lift_joint(description), urdf)
    about = [f"Attachments as proposed for the hand of {proposals.hand.robot}, best first."]
    about += [f"No hand can move {joint}: {reason}." for joint, reason in proposals.because.items()]
    write_description(
        yaml,
        urdf.name,
        [proposal.description() for proposal in proposals.found],
        about=about,
        free=item.free,
    )
    # The trial file is temporary.
    proposals = dataclasses.replace(
        proposals, object=dataclasses.replace(proposals.object, urdf=None)
    )
    entry = {"name": item.name, "type": address, "position": list(item.position)}
    return ImportedHomeObject(item.name, item.free, proposals, entry, description.notes)


def _add_lift_joint(description: Description) -> Description:
    """Return a free object as one that slides upwards."""
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


def _remove_lift_joint(description: Description) -> Description:
    """Return the object without its lift joint."""
    ((child, _),) = description.joints.items()
    return dataclasses.replace(description, links={child: description.links[child]}, joints={})
