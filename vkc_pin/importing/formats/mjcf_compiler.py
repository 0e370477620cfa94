"""Compiles MJCF files with MuJoCo, without what geometry does not need."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vkc_pin.errors import InputError
from vkc_pin.utils.isolation import submit_isolated
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.utils.system import is_file
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.xml import parse_xml

NO_MASS = 1e-14
"""Mass [kg] that a compiled body has if its file states none, just above MuJoCo's minimum."""
_REDUCED = (
    "read without actuators, sensors, key frames, contact pairs and couplings, as MuJoCo "
    "rejects them"
)
_LISTED = 8  # missing textures in a note
# What MuJoCo 2 knew and later versions reject: settings that do not matter for geometry.
_SETTINGS = ("custom", "option", "size", "statistic", "visual")
_COMPILER_SETTINGS = ("convexhull", "exactmeshinertia")
# Orientations of an <inertial>, which MuJoCo 2 ignored beside `fullinertia`
_ORIENTATIONS = ("axisangle", "euler", "quat", "xyaxes", "zaxis")

_Repair = Callable[[Any, Path], list[str]]
"""A change of a `mujoco.MjSpec`, which returns notes."""


def compile_mjcf(file: Path) -> tuple[Any, list[str]]:
    """Return the compiled model (`mujoco.MjModel`) of an MJCF file, and notes.

    MuJoCo's compiler resolves includes, defaults, classes and units. Textures and skins are not
    read, masses may be missing, and visual meshes replace missing collision meshes of their body.

    Raises:
        InputError: MuJoCo is not installed, cannot read the file, or exceeds a limit; or meshes are
            missing that nothing can replace.
    """
    # The child process imports MuJoCo while this one does.
    fetch = submit_isolated(_compile, file.resolve(), file, program="MuJoCo", file=file)
    import_optional("mujoco", "import", purpose="an MJCF file", file=file)
    return fetch()


def _compile(path: Path, file: Path) -> tuple[Any, list[str]]:
    """Return model and notes of the file at an absolute `path`; messages name `file`.

    A file that MuJoCo rejects is compiled again, first with other meshes in place of missing ones,
    then without its dynamics, too.
    """
    import mujoco

    # MuJoCo would write warnings to MUJOCO_LOG.TXT.
    mujoco.set_mju_user_warning(lambda text: None)
    attempts: tuple[tuple[_Repair, ...], ...] = (
        (),
        (_replace_missing_meshes,),
        (_replace_missing_meshes, _remove_dynamics),
    )
    first_error = None
    for repairs in attempts:
        try:
            spec, notes = _parse(path)
            notes += _remove_looks(spec, file)
            for repair in repairs:
                notes += repair(spec, file)
            # Simulators that merge the file with another model give bodies their mass then.
            spec.compiler.boundmass = max(spec.compiler.boundmass, NO_MASS)
            spec.compiler.boundinertia = max(spec.compiler.boundinertia, NO_MASS)
            model = spec.compile()
        except InputError:
            raise
        except (ValueError, RuntimeError) as error:
            if "allocate memory" in str(error):
                raise MemoryError from error
            first_error = first_error or error
            continue
        if _remove_dynamics in repairs:
            notes.append(f"{_REDUCED} ({_join_lines(first_error)})")
        return model, notes
    problem = f"MuJoCo cannot read the file: {_join_lines(first_error)}"
    raise InputError(problem, file=file) from first_error


def _join_lines(error: Exception | None) -> str:
    """Return the message of an error in one line."""
    return " ".join(str(error).split())


def _parse(path: Path) -> tuple[Any, list[str]]:
    """Return the `mujoco.MjSpec` of a file, and a note if it was written for MuJoCo 2."""
    import mujoco

    try:
        return mujoco.MjSpec.from_file(str(path)), []
    except TypeError as error:
        raise InputError("MuJoCo needs a file name in UTF-8", file=path) from error
    except ValueError as error:
        try:
            spec = mujoco.MjSpec.from_string(_convert_from_mujoco_2(path))
        except (InputError, ValueError):
            raise error from None
        spec.modelfiledir = str(path.parent)
        return spec, [f"read without settings of MuJoCo 2 ({_join_lines(error)})"]


def _convert_from_mujoco_2(path: Path) -> str:
    """Return a file with its included files, without what later versions of MuJoCo reject.

    A class of defaults at the top level, which MuJoCo 2 added, becomes a class in "main".
    """
    root = _read_with_includes(path, path.parent, [])
    for inertial in root.iter("inertial"):
        if "fullinertia" in inertial.attrib:
            for name in _ORIENTATIONS:
                inertial.attrib.pop(name, None)
    for element in list(root):
        if element.tag in _SETTINGS:
            root.remove(element)
        elif element.tag == "compiler":
            for name in _COMPILER_SETTINGS:
                element.attrib.pop(name, None)
        elif element.tag == "default" and element.get("class", "main") != "main":
            main = ElementTree.Element("default")
            root[list(root).index(element)] = main
            main.append(element)
    return ElementTree.tostring(root, encoding="unicode")


def _read_with_includes(file: Path, folder: Path, done: list[Path]) -> ElementTree.Element:
    """Return the root of a file whose <include>, relative to `folder`, are replaced."""
    if file in done:
        raise InputError("a file is included twice", file=file)
    done.append(file)
    root = parse_xml(read_text(file, "MJCF"), file)
    for parent in list(root.iter()):
        for include in parent.findall("include"):
            address = include.get("file", "").replace("\\", "/")
            path = Path(os.path.normpath(folder / address))
            included = _read_with_includes(path, folder, done)
            place = list(parent).index(include)
            parent[place : place + 1] = list(included)
    return root


def _remove_looks(spec: Any, file: Path) -> list[str]:
    """Remove textures and skins; return a note about missing pictures."""
    missing = dict[str, None]()  # an ordered set
    for texture in spec.textures:
        for name in (texture.file, *texture.cubefiles):
            if name and not is_file(_find_file(spec, texture, name, "texturedir")):
                missing[name] = None
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for element in (*spec.textures, *spec.skins):
        spec.delete(element)
    if not missing:
        return []
    listed = ", ".join(list(missing)[:_LISTED])
    if len(missing) > _LISTED:
        listed += f", ... ({len(missing)})"
    return [f"missing textures, which only colour shapes: {listed}"]


def _replace_missing_meshes(spec: Any, file: Path) -> list[str]:
    """Remove geoms whose mesh is missing; if they collide, visual geoms of the body do instead.

    Returns:
        A note about each missing mesh.
    """
    missing = dict[str, Any]()  # meshes by name
    for mesh in spec.meshes:
        if mesh.file and not is_file(_find_file(spec, mesh, mesh.file, "meshdir")):
            missing[mesh.name or Path(mesh.file).stem] = mesh
    if not missing:
        return []
    notes = list[str]()
    lost = list[str]()
    for body in spec.bodies:
        geoms = list(body.geoms)
        gone = [geom for geom in geoms if geom.meshname in missing]
        others = [geom for geom in geoms if geom.meshname not in missing]
        for geom in gone:
            mesh_file = missing[geom.meshname].file
            # Those that collide instead of an earlier geom are visual no more.
            looks = [other for other in others if not _collides(other)]
            where = f"mesh '{mesh_file}' of body '{body.name}' does not exist"
            if not _collides(geom):
                notes.append(f"{where}: left out, it is only visual")
            elif looks:
                notes.append(f"{where}: its visual shapes collide instead")
                for other in looks:
                    other.contype = 1
                    other.conaffinity = 1
            else:
                lost.append(mesh_file)
            spec.delete(geom)
    if lost:
        raise InputError(
            "mesh files do not exist",
            file=file,
            expected="all collision meshes, or visual shapes to take instead",
            got=f"no {', '.join(dict.fromkeys(lost))}",
        )
    for mesh in missing.values():
        spec.delete(mesh)
    return notes


def _remove_dynamics(spec: Any, file: Path) -> list[str]:
    """Remove what may refer to missing elements, and let MuJoCo mend inertias."""
    spec.compiler.balanceinertia = True
    kinds = (spec.actuators, spec.sensors, spec.keys, spec.pairs, spec.excludes, spec.equalities)
    for elements in kinds:
        for element in elements:
            spec.delete(element)
    return []


def _collides(geom: Any) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _find_file(spec: Any, element: Any, address: str, folder: str) -> Path:
    """Return the file of an asset, which may lie in a `folder` of the compiler's settings."""
    name = Path(address).name if spec.strippath else address
    # Those of the file that holds the asset, which may be an included one.
    settings = getattr(element, "compiler", spec)
    return Path(spec.modelfiledir, getattr(settings, folder), name)
