"""Reads occupancy maps of ROS: a `map.yaml` of map_server or Nav2, and its image."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pydantic
from numpy.typing import NDArray

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.files.documents import Document, parse_document, read_bytes, read_yaml
from vkc_pin.world.files.fields import Number, Positive, Vector3, make_validation_error
from vkc_pin.world.files.resources import check_path

MAX_CELLS = 10_000_000
"""Most cells of a map: 158 m by 158 m with cells of 50 mm."""

FREE = 0
OCCUPIED = 100
UNKNOWN = -1

_FORMATS = ("PPM", "PNG", "BMP")  # Pillow's names; PPM stands for PBM and PGM, too
_KNOWN_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # 8 bits a channel, or fewer
_LONG_MODES = ("I", "I;16", "I;16B", "I;16L")  # 16 bits, grey

_Fraction = Annotated[Number, pydantic.Field(ge=0.0, le=1.0)]


def _parse_flag(value: Any) -> Any:
    if isinstance(value, bool) or (isinstance(value, int | float) and value in (0, 1)):
        return bool(value)
    raise make_validation_error("wrong value", "0 or 1")


class _MapSchema(pydantic.BaseModel):
    """A `map.yaml`; programs add fields of their own to it."""

    model_config = pydantic.ConfigDict(extra="allow", frozen=True)

    image: str
    resolution: Positive
    origin: Vector3
    negate: Annotated[bool, pydantic.BeforeValidator(_parse_flag)]
    occupied_thresh: _Fraction
    free_thresh: _Fraction
    mode: Literal["trinary", "scale", "raw"] = "trinary"


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Square cells on the floor that are occupied, free or unknown.

    Attributes:
        resolution: Edge length of a cell [m].
        origin: Pose of the lower left corner of the lower left cell: x, y [m] and yaw [rad] in the
            world frame.
        values: Occupancy as `nav_msgs/OccupancyGrid` has it: 0 to 100, or -1 for unknown. Shape
            (rows, columns), from the bottom row along y, and along x of the map's frame.
        occupied: Whether a cell is occupied, of the same shape.
        free: Whether a cell is free. Cells that are neither are unknown.
    """

    resolution: float
    origin: tuple[float, float, float]
    values: NDArray[np.int8]
    occupied: Bools
    free: Bools

    @property
    def size(self) -> Floats:
        """Lengths along x and y of the map's frame [m]."""
        rows, columns = self.values.shape
        return self.resolution * np.array([columns, rows], float)


def read_occupancy_map(file: str | Path) -> OccupancyMap:
    """Read a map.

    Cells of value 100 are occupied, cells of value 0 are free. A value between them is unknown,
    except with `mode: raw`, where it is a percentage that the thresholds apply to.

    Args:
        file: The `map.yaml`. The path of its image is relative to its folder.

    Raises:
        InputError: A file cannot be read, a field is invalid, or the image is too large.
    """
    document = read_yaml(file)
    fields = parse_document(document, _MapSchema)
    if not fields.free_thresh < fields.occupied_thresh:
        raise document.make_error(
            ("free_thresh",),
            "the thresholds are out of order",
            expected=f"a number < occupied_thresh, which is {fields.occupied_thresh:g}",
            got=fields.free_thresh,
        )
    if fields.model_extra:
        names = ", ".join(fields.model_extra)
        warnings.warn(f"{file}: these fields are not used: {names}", stacklevel=2)
    grey, opacity = _read_image(document, fields.image)
    values = _compute_values(grey, opacity, fields)
    occupied = values == OCCUPIED
    free = values == FREE
    if fields.mode == "raw":
        occupied |= values > 100.0 * fields.occupied_thresh
        free |= (values >= 0) & (values < 100.0 * fields.free_thresh)
    return OccupancyMap(fields.resolution, fields.origin, values, occupied, free)


def _compute_values(shade: Floats, opacity: Floats | None, fields: _MapSchema) -> NDArray[np.int8]:
    """Return the occupancy of cells, as Nav2's `map_io` computes it.

    Both thresholds are exclusive.

    Args:
        shade: Brightness of each cell, the mean of its colours, from 0 to 1.
        opacity: Opacity of each cell from 0 to 1; None for images without it.
        fields: The `map.yaml`.
    """
    if fields.mode == "raw":
        grey = np.floor(255.0 * shade + 0.5)
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    if fields.mode == "trinary" and opacity is not None:
        # Opacity is averaged like a fourth colour.
        shade = (3.0 * shade + opacity) / 4.0
    occupancy = shade if fields.negate else 1.0 - shade
    values = np.full(shape=shade.shape, fill_value=UNKNOWN, dtype=np.int8)
    if fields.mode == "scale":
        span = fields.occupied_thresh - fields.free_thresh
        scaled = np.clip((occupancy - fields.free_thresh) / span, 0.0, 1.0)
        values = np.rint(100.0 * scaled).astype(np.int8)
    values[occupancy < fields.free_thresh] = FREE
    values[occupancy > fields.occupied_thresh] = OCCUPIED
    if fields.mode == "scale" and opacity is not None:
        values[opacity < 1.0] = UNKNOWN
    return values


def _read_image(document: Document, name: str) -> tuple[Floats, Floats | None]:
    """Return brightness and opacity of the pixels from 0 to 1, from the bottom row.

    The opacity is None for images without it. Both have the shape (rows, columns).
    """
    # Importing it takes 50 ms.
    from PIL import Image

    place = ("image",)
    assert document.file is not None
    with document.annotate_errors(place):
        file = document.file.parent / check_path(name, "image", "the name of an image")
    if not file.is_file():
        expected = f"a PGM or PNG file in {document.file.parent}"
        raise document.make_error(place, "there is no such image", expected=expected, got=name)
    data = read_bytes(file, "image")
    try:
        with warnings.catch_warnings():
            # Sizes are checked below.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=_FORMATS)
        columns, rows = image.size
        if rows * columns > MAX_CELLS:
            raise document.make_error(
                place,
                "the image is too large",
                expected=f"at most {MAX_CELLS} pixels",
                got=f"{columns} x {rows}",
            )
        image.load()
    except InputError:
        raise
    # Pillow raises these for damaged files.
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise document.make_error(
            place, "cannot read the image", expected="a PGM or PNG file", got=error
        ) from error
    if image.mode in _LONG_MODES:
        return np.flipud(np.asarray(image) / 65535.0), None
    if image.mode not in _KNOWN_MODES:
        raise document.make_error(
            place, "cannot read the image", expected="a grey or RGB image", got=image.mode
        )
    has_opacity = "A" in image.mode or "transparency" in image.info
    if image.mode in ("1", "L") and not has_opacity:
        return np.flipud(np.asarray(image.convert("L")) / 255.0), None
    pixels = np.asarray(image.convert("RGBA"))
    shade = pixels[..., :3].sum(axis=2, dtype=float) / (3.0 * 255.0)
    opacity = pixels[..., 3] / 255.0 if has_opacity else None
    return np.flipud(shade), None if opacity is None else np.flipud(opacity)
