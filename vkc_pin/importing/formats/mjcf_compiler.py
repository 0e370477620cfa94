"""Compiles MJCF files with MuJoCo, without what geometry does not need."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
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
# What MuJoCo 2 knew and later versions reject: settings that do not matter for geometry.
_SETTINGS = ("custom", "option", "size", "statistic", "visual")
_COMPILER_SETTINGS = ("convexhull", "exactmeshinertia")
# Orientations of an <inertial>, which MuJoCo 2 ignored beside `fullinertia`
_ORIENTATIONS = ("axisangle", "euler", "quat", "xyaxes", "zaxis")


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
    """Return model and notes of the file at an absolute `path`; messages name `file`."""
    import mujoco

    mujoco.set_mju_user_warning(lambda text: None)  # it would write MUJOCO_LOG.TXT
    first = None
    for repairs in (), (_replace_missing_meshes,), (_replace_missing_meshes, _remove_dynamics):
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
            first = first or error
            continue
        if _remove_dynamics in repairs:
            notes.append(f"{_REDUCED} ({' '.join(str(first).split())})")
        return model, notes
    raise InputError(
        f"MuJoCo cannot read the file: {' '.join(str(first).split())}", file=file
    ) from first


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
        return spec, [f"read without settings of MuJoCo 2 ({' '.join(str(error).split())})"]


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
            main = root[list(root).index(element)] = ElementTree.Element("default")
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
            name = include.get("file", "").replace("\\", "/")
            included = _read_with_includes(Path(os.path.normpath(folder / name)), folder, done)
            place = list(parent).index(include)
            parent[place : place + 1] = list(included)
    return root


def _remove_looks(spec: Any, file: Path) -> list[str]:
    """Remove textures and skins; return a note about missing pictures."""
    missing = [
        name
        for texture in spec.textures
        for name in (texture.file, *texture.cubefiles)
        if name and not is_file(_find_file(spec, texture, name, "texturedir"))
    ]
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for element in (*spec.textures, *spec.skins):
        spec.delete(element)
    return [f"missing textures, which only colour shapes: {_format_names(missing)}"] * bool(missing)


def _replace_missing_meshes(spec: Any, file: Path) -> list[str]:
    """Remove geoms whose mesh is missing; if they collide, visual geoms of the body do instead.

    Returns:
        A note about each missing mesh.
    """
    missing = {
        mesh.name or Path(mesh.file).stem: mesh
        for mesh in spec.meshes
        if mesh.file and not is_file(_find_file(spec, mesh, mesh.file, "meshdir"))
    }
    notes, lost = list[str](), list[str]()
    for body in spec.bodies if missing else ():
        geoms = list(body.geoms)
        gone = [geom for geom in geoms if geom.meshname in missing]
        others = [geom for geom in geoms if geom.meshname not in missing]
        for geom in gone:
            mesh_file, collides = missing[geom.meshname].file, geom.contype or geom.conaffinity
            looks = [other for other in others if not (other.contype or other.conaffinity)]
            where = f"mesh '{mesh_file}' of body '{body.name}' does not exist"
            if collides and not looks:
                lost.append(mesh_file)
            elif collides:
                notes.append(f"{where}: its visual shapes collide instead")
                for other in looks:
                    other.contype = other.conaffinity = 1
            else:
                notes.append(f"{where}: left out, it is only visual")
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
    for element in (element for kind in kinds for element in kind):
        spec.delete(element)
    return []


def _find_file(spec: Any, element: Any, address: str, folder: str) -> Path:
    """Return the file of an asset, which may lie in a `folder` of the compiler's settings."""
    name = Path(address).name if spec.strippath else address
    settings = getattr(element, "compiler", spec)  # of the file that holds the asset
    return Path(spec.modelfiledir, getattr(settings, folder), name)


def _format_names(names: list[str]) -> str:
    distinct = list(dict.fromkeys(names))
    return ", ".join(distinct[:8]) + (f", ... ({len(distinct)})" if len(distinct) > 8 else "")
