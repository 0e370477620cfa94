"""Prepares requested robots and objects; files are imported once."""

from __future__ import annotations

import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vkc_pin.benchmarks.robot_object_matrix.pairs import load_description
from vkc_pin.errors import InputError
from vkc_pin.importing.objects.object_import import ImportedObject, import_object
from vkc_pin.importing.robots.robot_import import import_robot
from vkc_pin.world.files.writing import check_name, write_atomically, write_folder_atomically
from vkc_pin.world.models.robot_file import find_robot, list_robots, load_robot

__all__ = ["DEFAULT", "Request", "parse_requests", "prepare_object", "prepare_robot"]

DEFAULT = "default"
"""The word that stands for all names that are there by default."""

_GIVEN = re.compile(r"(?:(?P<called>[A-Za-z]\w*)=)?(?P<path>[^#]+)(?:#(?P<link>.+))?")
_FILES = (".urdf", ".xml", ".mjcf", ".sdf")
_SAMPLES = 1000  # for pairs that need no check, as of robots that are loaded without an SRDF
_LEVEL = 0.5  # cosine of how steep an approach may be that tells where the front is


@dataclass(frozen=True)
class Request:
    """A requested robot or object.

    Attributes:
        called: Displayed name.
        path: Name, or path of a file or folder.
        link: Link of an object's file that is imported alone; None for all of it.
    """

    called: str
    path: str
    link: str | None = None

    @property
    def is_imported(self) -> bool:
        """Whether it is a file to import."""
        return self.path.lower().endswith(_FILES)


def parse_requests(texts: Sequence[str], field: str, default: Sequence[str]) -> list[Request]:
    """Parse requests: names and paths, each plain or as "name=...", with "#link" for one link.

    Args:
        texts: Requests.
        field: Name of the argument, for errors.
        default: Names that "default" stands for.

    Raises:
        InputError: A request is malformed, or there are none or two of one name.
    """
    found = list[Request]()
    for text in (one for given in texts for one in (default if given == DEFAULT else [str(given)])):
        match = _GIVEN.fullmatch(text)
        if match is None:
            raise InputError(
                "not a choice",
                field=field,
                expected="a name, a path, name=path or name=path#link",
                got=text,
            )
        called, path, link = match["called"], match["path"], match["link"]
        found.append(Request(called or link or _name(path), path, link))
    names = [one.called for one in found]
    if not names or len(set(names)) < len(names):
        raise InputError(
            "not a choice",
            field=field,
            expected="names, each once",
            got=" ".join(map(str, texts)) or "none",
        )
    return found


def prepare_robot(one: Request, folder: Path) -> str:
    """Return name or absolute path of a robot, imported into `folder` if its hand is unknown.

    Raises:
        InputError: There is no such robot, it cannot be imported, or its name is no file name.
    """
    mjcf = one.path.lower().endswith((".xml", ".mjcf"))
    made = folder / check_name(one.called, "robots")
    file = Path(one.path) if mjcf else find_robot(one.path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the doctor's report has them
        if not (made / "robot.yaml").is_file():
            if not mjcf and load_robot(one.path).touch_links:
                return one.path if one.path in list_robots() else str(file.resolve())
            import_robot(file, made, samples=_SAMPLES)
    return str(made.resolve())


def prepare_object(one: Request, folder: Path) -> str:
    """Return name or description file of an object; files are imported, their fronts towards -x.

    Raises:
        InputError: There is no such object, it cannot be imported, or its name is no file name.
    """
    if not one.is_imported:
        if one.link is not None:
            raise InputError(
                "only a link of a file can be imported",
                field="objects",
                expected=" ".join(_FILES),
                got=one.path,
            )
        load_description(one.path)
        return one.path
    name = check_name(one.called, "objects")
    made = folder / name / f"{name}.yaml"
    if not made.is_file():
        with write_folder_atomically(made.parent, force=True) as staging, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the report lists omissions
            imported = import_object(one.path, staging / "as_it_was", link=one.link)
            _face(imported)
            for file in (staging / "as_it_was").iterdir():
                file.rename(staging / (made.name if file == imported.file else file.name))
            (staging / "as_it_was").rmdir()
    return str(made)


def _name(path: str) -> str:
    """Return the default name: that of the file, or of its folder for robot.yaml."""
    file = Path(path) / "robot.yaml" if Path(path).is_dir() else Path(path)
    return (
        file.resolve().parent.name
        if file.name == "robot.yaml"
        else file.stem
        if len(file.parts) > 1 or file.suffix
        else path
    )


def _face(imported: ImportedObject) -> None:
    """Turn an object by quarter turns so that the best proposed hand approaches along x."""
    if not imported.proposals.found:
        return
    item, best = imported.proposals.object, imported.proposals.found[0].attachment
    closed = np.clip(0.0, item.lower, item.upper)
    x, y, _ = (item.link_placement(best.link, closed) * best.placement).rotation[:, 2].tolist()
    quarters = round(-float(np.arctan2(y, x)) / (np.pi / 2.0)) % 4
    if np.hypot(x, y) < _LEVEL or not quarters:
        return
    file = imported.file.with_suffix(".urdf")
    root = ElementTree.parse(file).getroot()
    front = "front"
    while root.find(f"link[@name='{front}']") is not None:
        front += "_"
    link, joint = (
        ElementTree.Element("link", name=front),
        ElementTree.Element("joint", name=front, type="fixed"),
    )
    ElementTree.SubElement(joint, "parent", link=front)
    ElementTree.SubElement(joint, "child", link=item.base_link)
    ElementTree.SubElement(joint, "origin", xyz="0 0 0", rpy=f"0 0 {quarters * np.pi / 2.0:.12g}")
    root.insert(0, link)
    root.append(joint)
    write_atomically(file, ElementTree.tostring(root, encoding="utf-8"))
