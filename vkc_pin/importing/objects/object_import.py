"""Imports an object from a file of another program as a folder that scenes can use."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description
from vkc_pin.importing.formats.reading import FORMATS
from vkc_pin.importing.objects.clean_up import (
    compute_bounds,
    find_closed_positions,
    find_multiple_objects,
    load_surfaces,
    make_upright,
    merge_fixed_links,
    move_root,
    rename_for_scenes,
    scale_object,
)
from vkc_pin.importing.objects.limits import add_missing_limits
from vkc_pin.importing.objects.object_reading import WEIGHTLESS, read_object
from vkc_pin.importing.objects.pieces import PLACES_WORK, decompose_links, measure_links
from vkc_pin.importing.objects.writing import write_description, write_urdf
from vkc_pin.importing.pictures import plot_attachments
from vkc_pin.importing.progress import ImportProgress
from vkc_pin.importing.proposals.proposal import Proposals
from vkc_pin.importing.proposals.propose import propose_attachments
from vkc_pin.importing.scenes import locate_robot, make_object_scene, refer_to_robot, write_scene
from vkc_pin.importing.targets import check_source, check_target, get_origin_marker
from vkc_pin.options import Options
from vkc_pin.utils.arguments import (
    check_bool,
    check_choice,
    check_coordinate,
    check_instance,
    check_integer,
    check_text,
)
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.resources import check_path, choose_file_names
from vkc_pin.world.files.writing import write_folder_atomically
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.robot_file import load_robot

_COMMAND = "import-object"
# Generic file names, which do not name an object
_GENERAL = ("mobility", "model", "object", "scene", "index", "main")
# Plausible heights of an object [m]
_SMALL = 0.02
_LARGE = 3.5


@dataclass(frozen=True, eq=False)
class ImportedObject:
    """An imported object.

    Attributes:
        file: Description file for `load_object` and scenes.
        object: The object with its proposed attachments.
        proposals: Proposed attachments, and joints that have none.
        size: Length, width and height of the closed object [m], shape (3,).
        notes: Changes and omissions.
        picture: Image of the attachments.
        scene: Scene with the object and a robot in front of it; None if the robot finds no room.
    """

    file: Path
    object: ArticulatedObject
    proposals: Proposals
    size: Floats
    notes: tuple[str, ...]
    picture: Path
    scene: Path | None

    def summary(self) -> str:
        """Return a readable report."""
        pieces = len(self.object.collision.geometryObjects)
        joints = len(self.object.coordinates.names)
        noun = "joint" if joints == 1 else "joints"
        size = " × ".join(f"{length:.2f}" for length in self.size)
        lines = [f"{self.object.name}: {size} m, {joints} {noun}, {pieces} convex pieces"]
        lines += [f"  {note}" for note in self.notes]
        lines.append(f"attachments for the hand of {self.proposals.hand.robot}, best first:")
        lines.append(self.proposals.summary())
        return "\n".join(lines)


def import_object(  # noqa: PLR0913 - keyword options of a public call
    file: str | Path,
    folder: str | Path | None = None,
    *,
    height: float | None = None,
    scale: float | None = None,
    up: str = "z",
    link: str | None = None,
    robot: str | Path | Robot = "husky_ur5e",
    options: Options | None = None,
    most: int = 3,
    force: bool = False,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
) -> ImportedObject:
    """Import an object from a URDF, xacro, MJCF, SDF or USD file.

    Its shapes become convex pieces, fixed links are merged with their masses, and missing limits
    chosen. The origin is below the centre, at the height of the lowest point.
    Attachments are proposed for every joint. Long imports log their progress to the logger
    ``vkc_pin.importing``.

    Args:
        file: The file.
        folder: Output folder, new or empty; defaults to one named like the file.
        height: Height of the object [m]: objects of PartNet-Mobility have no size of their own.
        scale: Factor for the file's lengths, instead of `height`.
        up: Axis of the file that points up, "z" or "y".
        link: Import only this link and its descendants.
        robot: Robot whose hand the attachments are for.
        options: Options with the clearances of attachments.
        most: Largest number of attachments of one joint.
        force: Whether to replace a folder that an earlier import wrote.
        packages: Folders of packages by name; others are searched for around the file.
        arguments: Arguments of a xacro file.

    Raises:
        InputError: The file cannot be read or does not describe an object, the folder holds other
            files, or an argument is invalid.
        UnknownNameError: The link or robot is unknown, or the file refers to an unknown name.
    """
    path = check_path(file, "file", f"a {FORMATS} file")
    check_choice(up, ("y", "z"), "vertical axis", "up")
    if link is not None:
        check_text(link, "link", "the name of a link")
    _check_size(height, scale)
    check_integer(most, "most", low=1, high=100)
    options = Options() if options is None else check_instance(options, Options, "options")
    clearances = {"dist_safe": options.dist_safe, "grasp_clearance": options.grasp_clearance}
    loaded_robot = robot if isinstance(robot, Robot) else load_robot(robot)
    name = _choose_name(path, link)
    target = Path(name) if folder is None else check_path(folder, "folder", "a folder")
    check_source(path, f"a {FORMATS} file")
    check_target(target, _COMMAND, force=check_bool(force, "force"))
    description = _read_single_object(path, link, packages, arguments)
    description, size = _scale_to_size(make_upright(description, up), height, scale)
    description = _place_on_floor(description)
    if description.is_massless:
        description = description.add_notes(WEIGHTLESS)
    work = [measure_links([item], set()) for item in description.links.values()]
    progress = ImportProgress([*work, PLACES_WORK * len(description.joints)])
    description = decompose_links(description, load_surfaces(description), progress=progress)
    description = add_missing_limits(description)
    # `check_target` allowed replacing it
    with write_folder_atomically(target, force=True, source=path) as staging:
        yaml = staging / f"{name}.yaml"
        urdf = staging / f"{name}.urdf"
        picture = staging / "attachments.png"
        write_urdf(description, urdf)
        about = [f"Made of {path.name} {get_origin_marker(_COMMAND)}."]
        if link is not None and link != name:
            about.append(f"Name of the link: {link}")
        springs = description.joints.values()
        # Attachments are proposed for the loaded object, hence it is written twice.
        write_description(yaml, urdf.name, (), about=about, joints=springs)
        progress.begin("attachments")
        item = load_object(yaml)
        proposals = propose_attachments(item, loaded_robot, most=most, **clearances)
        about.append(f"Attachments as proposed for the hand of {proposals.hand.robot}, best first.")
        for joint, reason in proposals.because.items():
            about.append(f"No hand can open {joint}: {reason}.")
        found = [proposal.description() for proposal in proposals.found]
        write_description(yaml, urdf.name, found, about=about, joints=springs)
        plot_attachments(proposals, picture)
        scene = make_object_scene(yaml.name, proposals, size, locate_robot(robot), staging)
        if scene is not None:
            scene["robot"] = refer_to_robot(robot, target)
            write_scene(staging / "scene.yaml", path, scene, _COMMAND)
    # The files have moved.
    loaded = load_object(target / yaml.name)
    proposals = dataclasses.replace(proposals, object=dataclasses.replace(loaded, attachments={}))
    return ImportedObject(
        target / yaml.name,
        loaded,
        proposals,
        size,
        description.notes,
        target / picture.name,
        None if scene is None else target / "scene.yaml",
    )


def _read_single_object(
    path: Path,
    link: str | None,
    packages: Mapping[str, str | Path] | None,
    arguments: Mapping[str, str] | None,
) -> Description:
    """Return the object of a file, or one link of it with its descendants, without fixed joints."""
    description = read_object(path, packages=packages, arguments=arguments)
    if link is not None:
        description = description.extract_subtree(link)
    else:
        description = description.add_notes(*find_multiple_objects(description))
    description = rename_for_scenes(description.check_meshes())
    return merge_fixed_links(description)


def _check_size(height: float | None, scale: float | None) -> None:
    """Raise InputError unless at most one is given, a positive number."""
    for name, value in (("height", height), ("scale", scale)):
        if value is not None and check_coordinate(value, name) <= 0.0:
            raise InputError(
                f"`{name}` must be positive", field=name, expected="a number above 0", got=value
            )
    if height is not None and scale is not None:
        raise InputError(
            "`height` and `scale` exclude each other", field="height, scale", expected="one of them"
        )


def _choose_name(path: Path, link: str | None) -> str:
    """Return a name from the link, the file, or the folder of a file with a generic name."""
    if link:
        stem = link
    elif path.stem.lower() in _GENERAL:
        stem = path.resolve().parent.name
    else:
        stem = path.stem
    name = re.sub(r"[^A-Za-z0-9_]+", "_", stem).strip("_") or "object"
    if not name[0].isalpha():
        name = f"object_{name}"
    (name,) = choose_file_names([name])
    return name


def _scale_to_size(
    description: Description, height: float | None, scale: float | None
) -> tuple[Description, Floats]:
    """Return the object in its size, and the size [m]; implausible sizes are noted."""
    low, high = compute_bounds(description, load_surfaces(description))
    if not (high > low).all():
        raise InputError(
            "the object is flat", file=description.file, expected="shapes that enclose a volume"
        )
    factor = scale or 1.0
    if height is not None:
        factor = height / float(high[2] - low[2])
    size = factor * (high - low)
    if height is None and not _SMALL <= size[2] <= _LARGE:
        note = (
            f"the object is {size[2]:.3g} m high: "
            "if this is wrong, state its height (height) or the unit of the file (scale)"
        )
        description = description.add_notes(note)
    return scale_object(description, factor), size


def _place_on_floor(description: Description) -> Description:
    """Return the object with its root's frame on the floor, below its closed shape's centre."""
    closed = find_closed_positions(description)
    low, high = compute_bounds(description, load_surfaces(description), closed)
    middle = (low + high) / 2.0
    origin = np.array([middle[0], middle[1], low[2]])
    return move_root(description, pin.SE3(np.eye(3), -origin))
