"""Reads and writes archives of plans, with size limits and validation of all content."""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    create_model,
    model_validator,
)
from pydantic.types import FailFast

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_finite_array
from vkc_pin.world.files.documents import (
    MAX_FIELDS,
    Document,
    parse_document,
    parse_json,
    read_bytes,
)
from vkc_pin.world.files.fields import Schema, make_validation_error
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.files.writing import write_atomically

FORMAT = 1
# Sizes of a file and of an unpacked part [bytes]: 200 000 waypoints of 25 coordinates.
_MAX_ARCHIVE, _MAX_MEMBER = 20_000_000, 40_000_000
# Parts of the archive, and of a motion with a curve: kind and number of axes of the array.
_ARRAYS = {"about": ("U", 0), "times": ("f", 1), "positions": ("f", 2)}
_CURVE = {"knot_times": ("f", 1), "knot_positions": ("f", 2), "knot_rates": ("f", 2)}
_PARTS = _ARRAYS | _CURVE
PlanStatus = Literal[
    "success",
    "infeasible",
    "not converged",
    "time limit",
    "evaluation limit",
    "interrupted",
    "rejected",
]
"""How planning ended. Other planners have words of their own, see `Plan.status`."""
_STATUS = r"^[a-z][a-z ]{0,39}$"
METRICS = (
    "planning_time",
    "build_time",
    "base_path_length",
    "base_path_length_l1",
    "arm_path_length",
    "clearance",
    "closure_error",
    "duration",
    "iterations",
    "rounds",
    "evaluations",
    "time_initialization",
    "time_coal",
    "time_casadi",
    "time_ipopt",
    "time_validation",
    "time_retiming",
    "torque",
)
"""Metrics of every plan; baselines have more."""

# Raised for damaged or encrypted zip archives, and for damaged arrays.
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError),
    *(ValueError, SyntaxError, TypeError, LookupError, OverflowError, MemoryError),
)

Text = Annotated[str, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0)]
# Perhaps infinite, for which datasets have null, but not NaN.
_from_null = BeforeValidator(lambda value: math.inf if value is None else value)
Distance = Annotated[float, Field(strict=True, gt=-math.inf), _from_null]
Measured = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Recorded = Annotated[bool, Field(strict=True)] | Annotated[float, Field(strict=True)]
Named = dict[str, Text]


def _is_finite(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def _check_folder(found: Named) -> Named:
    if found != {"package": "scenes"} and set(found) != {"relative", "absolute"}:
        raise make_validation_error(
            "no folder of a scene", 'package: "scenes", or relative and absolute'
        )
    return found


class _Phase(Schema):
    name: Text
    first: Count
    last: Count
    held: Named
    by: Named = Field(default_factory=dict)
    opening: Measured | None = None
    deviation: dict[str, Annotated[list[Finite], Field(min_length=6, max_length=6)]] | None = None


class MotionSchema(Schema):
    """A motion without its arrays, as in a saved plan."""

    names: Annotated[list[Text], FailFast()]
    robot_size: Count
    phases: Annotated[list[_Phase], FailFast()]


class _Violation(Schema):
    constraint: Text
    subject: Text
    waypoint: Count
    time: Finite
    amount: Distance  # infinite for a user constraint that overflows
    unit: Text
    detail: Text


class _Others(BaseModel):
    """Additional metrics."""

    model_config = ConfigDict(extra="allow")

    @model_validator(mode="after")
    def _check_numbers(self) -> Self:
        for name, value in (self.model_extra or {}).items():
            if isinstance(value, bool) or not _is_finite(value):
                raise make_validation_error(f"the metric {name!r} is none", "a finite number")
        return self


_LATER = ("evaluations", "time_retiming", "torque")  # missing in older files
_kinds: dict[str, Any] = {
    name: (Distance if name == "clearance" else Measured, 0.0 if name in _LATER else ...)
    for name in METRICS
}
_Metrics = create_model("_Metrics", __base__=_Others, **_kinds)


class _Bound(Schema):
    subject: Text
    kind: Text
    share: Measured
    begin: Finite
    end: Finite


class _Exemption(Schema):
    subject: Text
    distance: Finite
    reason: Text


class ReportSchema(Schema):
    """A validation report."""

    violations: Annotated[list[_Violation], FailFast()]
    clearance: Distance
    closure_error: Measured
    closure_angle: Measured
    clearances: Annotated[tuple[Distance, ...], FailFast()] = ()  # missing in older files
    states: Count
    notes: Annotated[list[Text], FailFast()]
    torque: Measured = 0.0  # these are missing in older files
    bounds: Annotated[tuple[_Bound, ...], FailFast()] = ()
    remarks: Annotated[tuple[Text, ...], FailFast()] = ()
    exemptions: Annotated[tuple[_Exemption, ...], FailFast()] = ()
    allowed: Annotated[tuple[Text, ...], FailFast()] = ()


class _About(Schema):
    """Scenes, steps, options and terms check their own parts when they are built."""

    format: int
    scene: dict[str, Any]
    folder: Annotated[Named, AfterValidator(_check_folder)]
    steps: Annotated[list[dict[str, Any]], FailFast()]
    options: dict[str, Any]
    trajectory: MotionSchema
    validation: ReportSchema
    status: Annotated[str, Field(strict=True, pattern=_STATUS)]
    metrics: _Metrics  # type: ignore[valid-type]
    seed: Count
    initialization: Text
    is_optimized: bool = True  # it is missing in older files
    history: Annotated[list[dict[str, Recorded]], FailFast()]
    terms: Annotated[list[dict[str, Any]], FailFast()] = Field(default_factory=list)


def write_archive(file: str | Path, about: Mapping[str, Any]) -> Path:
    """Write the archive of a plan atomically from its description; return the path.

    Numbers of the `trajectory` (see `Trajectory.to_dict`) are stored as separate arrays.
    """
    motion = dict(about["trajectory"])
    arrays = {name: np.array(motion.pop(name), float) for name in ("times", "positions")}
    arrays |= {
        f"knot_{name}": np.array(values, float) for name, values in motion.pop("curve", {}).items()
    }
    buffer, text = io.BytesIO(), json.dumps({"format": FORMAT, **about, "trajectory": motion})
    np.savez_compressed(buffer, allow_pickle=False, about=np.array(text), **arrays)
    return write_atomically(file, buffer.getvalue())


def read_archive(file: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the description in a saved plan, and its arrays "times", "positions" and "curve".

    Sizes are checked before anything is unpacked; pickles are not accepted.

    Raises:
        InputError: The file cannot be read, is not a saved plan, or is too large or invalid.
    """
    data = read_bytes(file, "plan", _MAX_ARCHIVE)
    try:
        if (parts := data.count(b"PK\x01\x02")) > 2 * len(_PARTS):  # before they are listed
            raise ValueError(f"{parts} parts")
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = sorted(name.removesuffix(".npy") for name in archive.namelist())
            if names not in (sorted(_ARRAYS), sorted(_PARTS)):
                raise ValueError(
                    f"its parts are {', '.join(names) or 'none'}, not {', '.join(sorted(_ARRAYS))}"
                )
            arrays = {
                info.filename.removesuffix(".npy"): _read_array(archive, info)
                for info in archive.infolist()
            }
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
    found: dict[str, Any] = {
        name: check_finite_array(array, name, file) for name, array in arrays.items()
    }
    knots = {name.removeprefix("knot_"): found.pop(name) for name in _CURVE if name in found}
    return parse_document(Document(about, file), _About).model_dump(), found | (
        {"curve": knots} if knots else {}
    )


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Any:
    """Return one part of an archive, whose header must match its size."""
    name = info.filename.removesuffix(".npy")
    kind, axes = _PARTS[name]
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by an unknown method")
    with archive.open(info) as packed:
        stream = io.BytesIO(packed.read(_MAX_MEMBER + 1))
    if (size := stream.getbuffer().nbytes) > _MAX_MEMBER:
        raise ValueError(f"{name} is larger than {_MAX_MEMBER:g} bytes")
    major, _ = np.lib.format.read_magic(stream)
    header = (
        np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    )
    shape, columns, dtype = header(stream)
    begin = stream.tell()
    if (
        dtype.kind != kind
        or len(shape) != axes
        or math.prod(shape) * dtype.itemsize != size - begin
        or size == begin
    ):
        raise ValueError(f"{name} is an array of {dtype} and shape {shape} in {size - begin} bytes")
    values = np.frombuffer(stream.getbuffer(), dtype, offset=begin)
    return (
        values[0]
        if kind == "U"
        else values.reshape(shape, order="F" if columns else "C").astype(float)
    )


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
