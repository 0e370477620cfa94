"""Compiles MJCF files with MuJoCo, without what geometry does not need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vkc_pin.errors import InputError
from vkc_pin.utils.isolation import submit_isolated
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.utils.system import is_file

__all__ = ["NO_MASS", "compile_mjcf"]

NO_MASS = 1e-14
"""Mass [kg] that a compiled body has if its file states none, just above MuJoCo's minimum."""
_REDUCED = (
    "read without actuators, sensors, key frames, contact pairs and couplings, as MuJoCo "
    "rejects them"
)


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
            spec = mujoco.MjSpec.from_file(str(path))
            notes = _remove_looks(spec, file)
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
