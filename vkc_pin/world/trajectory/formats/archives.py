"""Reads and writes archives of plans, and limits the sizes of their parts."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_finite_array
from vkc_pin.world.files.documents import MAX_FIELDS, parse_json, read_bytes
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.files.writing import write_atomically

FORMAT = 1
_MAX_ARCHIVE = 20_000_000  # [bytes] of a file
_MAX_MEMBER = 40_000_000  # [bytes] of an unpacked part: 200 000 waypoints of 25 coordinates
# Parts of the archive, and of a motion with a curve: kind and number of axes of the array.
_ARRAYS = {"about": ("U", 0), "times": ("f", 1), "positions": ("f", 2)}
_CURVE = {"knot_times": ("f", 1), "knot_positions": ("f", 2), "knot_rates": ("f", 2)}
_PARTS = _ARRAYS | _CURVE
# Raised for damaged or encrypted zip archives, and for damaged arrays.
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError),
    *(ValueError, SyntaxError, TypeError, LookupError, OverflowError, MemoryError),
)


def write_archive(file: str | Path, about: Mapping[str, Any]) -> Path:
    """Write the archive of a plan atomically from its description; return the path.

    Numbers of the `trajectory` (see `Trajectory.to_dict`) are stored as separate arrays.
    """
    motion = dict(about["trajectory"])
    curve = motion.pop("curve", {})
    arrays = {name: np.array(motion.pop(name), float) for name in ("times", "positions")}
    for name, values in curve.items():
        arrays[f"knot_{name}"] = np.array(values, float)
    text = json.dumps({"format": FORMAT, **about, "trajectory": motion})
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, about=np.array(text), **arrays)
    return write_atomically(file, buffer.getvalue())


def read_archive(file: Path) -> Any:
    """Return the description in a saved plan, with the arrays of its trajectory.

    Sizes are checked before anything is unpacked; pickles are not accepted.

    Raises:
        InputError: The file cannot be read, is not a saved plan, or is too large.
    """
    data = read_bytes(file, "plan", _MAX_ARCHIVE)
    try:
        arrays = _read_arrays(data)
    except _DAMAGED as error:
        raise InputError(
            "not a saved plan", file=file, expected="a file written by Plan.save", got=error
        ) from error
    text = str(arrays.pop("about"))
    if text.count(",") > MAX_FIELDS:
        raise InputError(
            "the description has too many fields", file=file, expected=f"at most {MAX_FIELDS}"
        )
    about = parse_json(text, file)
    if isinstance(about, dict) and about.get("format") != FORMAT:
        raise InputError(
            "unknown format", file=file, field="format", expected=FORMAT, got=about.get("format")
        )
    checked = {name: check_finite_array(array, name, file) for name, array in arrays.items()}
    if isinstance(about, dict) and isinstance(about.get("trajectory"), dict):
        about["trajectory"] |= nest_knots(checked)
    return about


def nest_knots(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return arrays of a motion as in its data: those called `knot_<name>` are in its `curve`."""
    motion = dict[str, Any]()
    for name, values in arrays.items():
        if name.startswith("knot_"):
            motion.setdefault("curve", {})[name.removeprefix("knot_")] = values
        else:
            motion[name] = values
    return motion


def _read_arrays(data: bytes) -> dict[str, Any]:
    """Return all parts of an archive. Raises one of `_DAMAGED` if something else is in it."""
    parts = data.count(b"PK\x01\x02")
    if parts > 2 * len(_PARTS):  # before they are listed
        raise ValueError(f"{parts} parts")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = sorted(name.removesuffix(".npy") for name in archive.namelist())
        if names not in (sorted(_ARRAYS), sorted(_PARTS)):
            expected = ", ".join(sorted(_ARRAYS))
            raise ValueError(f"its parts are {', '.join(names) or 'none'}, not {expected}")
        return {
            info.filename.removesuffix(".npy"): _read_array(archive, info)
            for info in archive.infolist()
        }


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Any:
    """Return one part of an archive, whose header must match its size."""
    name = info.filename.removesuffix(".npy")
    kind, axes = _PARTS[name]
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by an unknown method")
    with archive.open(info) as packed:
        stream = io.BytesIO(packed.read(_MAX_MEMBER + 1))
    size = stream.getbuffer().nbytes
    if size > _MAX_MEMBER:
        raise ValueError(f"{name} is larger than {_MAX_MEMBER:g} bytes")
    major, _ = np.lib.format.read_magic(stream)
    if major == 1:
        header = np.lib.format.read_array_header_1_0(stream)
    else:
        header = np.lib.format.read_array_header_2_0(stream)
    shape, has_columns, dtype = header
    begin = stream.tell()
    content = size - begin
    is_expected = dtype.kind == kind and len(shape) == axes
    if not is_expected or content == 0 or math.prod(shape) * dtype.itemsize != content:
        raise ValueError(f"{name} is an array of {dtype} and shape {shape} in {content} bytes")
    values = np.frombuffer(stream.getbuffer(), dtype, offset=begin)
    if kind == "U":
        return values[0]
    return values.reshape(shape, order="F" if has_columns else "C").astype(float)


def serialize_folder(scene_folder: Path, plan: Path) -> dict[str, str]:
    """Describe a scene's folder: in the package, or by relative and absolute paths."""
    there = scene_folder.resolve()
    if there == find_resource_folder("scenes").resolve():
        return {"package": "scenes"}
    return {"relative": os.path.relpath(there, plan.resolve().parent), "absolute": str(there)}


def resolve_folder(data: Mapping[str, str], plan: Path) -> Path:
    """Return the folder described by `serialize_folder`."""
    if "package" in data:
        return find_resource_folder(data["package"])
    beside = plan.resolve().parent / data["relative"]
    return beside if beside.is_dir() else Path(data["absolute"])
