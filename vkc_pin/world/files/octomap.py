"""Reads the occupied cells of OctoMap files (.bt and .ot).

The root is a cube of 2^16 cells about the origin. Of each cube's eight children, bit 0 of the
number is the side along x, bit 1 along y, bit 2 along z.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats, Ints

_DEPTH = 16  # of OctoMap's trees
_MAX_CELLS = 5_000_000  # of the map's resolution
_MAX_HEADER_SIZE = 10_000  # [bytes]
_KINDS = {"# Octomap OcTree binary file": True, "# Octomap OcTree file": False}
# states of children in binary files
_OCCUPIED = 2
_INNER = 3
_Leaf = tuple[tuple[int, int, int], int]
"""Lowest cell of a cube, and its edge, in cells of the map's resolution."""


def read_octomap(content: bytes, file: Path) -> tuple[Floats, float]:
    """Return the centres of occupied cells, shape (n, 3) [m], and half of a cell's diagonal [m].

    Larger occupied cubes are divided into cells of the map's resolution. Cells of an .ot file are
    occupied if they are at least as probably occupied as free.

    Raises:
        InputError: The file is none of OctoMap's, is damaged, or has too many occupied cells.
    """
    header, separator, data = content[:_MAX_HEADER_SIZE].partition(b"\ndata\n")
    lines = header.decode("ascii", "replace").splitlines()
    is_binary = _KINDS.get(lines[0].strip()) if lines else None
    if is_binary is None or not separator:
        expected = " or ".join(_KINDS)
        raise InputError("not an OctoMap file", file=file, line=1, expected=expected)
    data = content[len(header) + len(separator) :]
    values = dict(line.split(maxsplit=1) for line in lines[1:] if len(line.split()) > 1)
    tree = values.get("id", "none").strip()
    if tree != "OcTree":
        raise InputError("another kind of tree", file=file, field="id", expected="OcTree", got=tree)
    try:
        resolution = float(values.get("res", "nan"))
    except ValueError:
        resolution = np.nan
    if not 1e-4 <= resolution <= 100.0:
        got = values.get("res")
        raise InputError(
            "invalid resolution", file=file, field="res", expected="a length [m]", got=got
        )
    cells = list[Ints]()
    count = 0
    try:
        leaves = _read_binary_leaves(data) if is_binary else _read_leaves(data)
        for lowest, edge in leaves:
            count += edge**3
            if count > _MAX_CELLS:
                expected = f"at most {_MAX_CELLS} of the map's resolution"
                raise InputError("too many occupied cells", file=file, expected=expected, got=count)
            offsets = np.indices((edge, edge, edge)).reshape(3, -1).T
            cells.append(offsets + lowest)
    except (IndexError, struct.error):
        expected = "a complete tree"
        raise InputError(
            "the file is incomplete", file=file, expected=expected, got=f"{len(data)} bytes"
        ) from None
    if not cells:
        raise InputError("no occupied cells", file=file, expected="an occupied cell")
    middle = 2 ** (_DEPTH - 1)
    centers = (np.concatenate(cells) - middle + 0.5) * resolution
    return centers, resolution * float(np.sqrt(3.0)) / 2.0


def _find_child(lowest: tuple[int, int, int], edge: int, number: int) -> tuple[int, int, int]:
    """Return the lowest cell of a child with a given edge."""
    x, y, z = lowest
    return x + edge * (number & 1), y + edge * (number >> 1 & 1), z + edge * (number >> 2 & 1)


def _read_binary_leaves(data: bytes) -> Iterator[_Leaf]:
    """Yield the occupied leaves of a .bt file.

    Each inner node has two bits for each child: free (1), occupied (2), inner (3), or unknown. The
    inner children follow in their order, each with all that is below it.
    """
    position = 0
    stack: list[_Leaf] = [((0, 0, 0), 2**_DEPTH)]
    while stack:
        lowest, edge = stack.pop()
        states = data[position] | data[position + 1] << 8
        position += 2
        half = edge // 2
        inner = list[_Leaf]()
        for number in range(8):
            state = states >> 2 * number & 3
            child = (_find_child(lowest, half, number), half)
            if state == _OCCUPIED:
                yield child
            elif state == _INNER:
                if half < 2:
                    raise IndexError
                inner.append(child)
        stack += reversed(inner)


def _read_leaves(data: bytes) -> Iterator[_Leaf]:
    """Yield the occupied leaves of an .ot file: of each node the log-odds, and one bit a child."""
    position = 0
    stack: list[_Leaf] = [((0, 0, 0), 2**_DEPTH)]
    while stack:
        lowest, edge = stack.pop()
        log_odds, children = struct.unpack_from("<fB", data, position)
        position += 5
        if not children and log_odds >= 0.0:
            yield lowest, edge
        half = edge // 2
        if children and not half:
            raise IndexError
        for number in reversed(range(8)):
            if children >> number & 1:
                stack.append((_find_child(lowest, half, number), half))
